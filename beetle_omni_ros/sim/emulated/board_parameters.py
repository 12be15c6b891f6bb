"""Parameters of the emulated motor board; read from params/emulated_board.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, kw_only=True)
class EmulatedBoardParameters:
    """Numbers of the firmware contract, and what the sensors of the emulated board show."""

    system: int = parameter(doc='MAVLink system id', low=1, high=255)
    component: int = parameter(doc='MAVLink component id', low=1, high=255)
    host_system: int = parameter(doc='system id that it obeys', low=1, high=255)
    host_component: int = parameter(doc='component id that it obeys', low=1, high=255)
    target_timeout: float = parameter(doc='then the rotors stop', unit='s', low=0.01, high=1)
    heartbeat_timeout: float = parameter(doc='then it disarms', unit='s', low=0.1, high=10)
    idle_timeout: float = parameter(doc='armed without target', unit='s', low=0.1, high=60)
    throttle_low_time: float = parameter(doc='no thrust asked before arming', unit='s', low=0,
                                         high=10)
    target_age_limit: float = parameter(doc='of a stamp', unit='s', low=0.01, high=10)
    target_future_limit: float = parameter(doc='of a stamp', unit='s', low=0, high=10)
    watchdog_time: float = parameter(doc='from hang to reset', unit='s', low=0.001, high=1)
    boot_time: float = parameter(doc='from reset to heartbeat', unit='s', low=0, high=10)
    arm_cell_voltage: float = parameter(doc='least for arming', unit='V', low=0, high=5)
    heartbeat_rate: float = parameter(doc='of HEARTBEAT', unit='Hz', low=1, high=50)
    battery_rate: float = parameter(doc='of BATTERY_STATUS', unit='Hz', low=1, high=200)
    rotor_rate: float = parameter(doc='of ESC_STATUS', unit='Hz', low=1, high=500)
    rotor_info_rate: float = parameter(doc='of ESC_INFO', unit='Hz', low=0.1, high=50)
    reception_rate: float = parameter(doc='of SYS_STATUS', unit='Hz', low=0.1, high=50)
    clock_start: float = parameter(doc='its clock at the start', unit='s', low=0, high=1e6)
    clock_drift: float = parameter(doc='of its clock', unit='s/s', low=-0.01, high=0.01)
    rpm_at_1_newton: float = parameter(doc='of a rotor', unit='1/min', low=1, high=1e5)
    idle_temperature: float = parameter(doc='of the ESCs', unit='C', low=-40, high=150)

    @classmethod
    def load(cls, path: str | Path | None = None) -> EmulatedBoardParameters:
        """Read a file; without a path, the shipped params/emulated_board.yaml."""
        return schema.load(cls, path or share_path('params/emulated_board.yaml'))
