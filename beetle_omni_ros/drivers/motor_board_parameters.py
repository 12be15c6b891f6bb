"""Parameters of the link to the motor board; read from params/motor_board.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, kw_only=True)
class MotorBoardParameters:
    """Port, identities and times of the motor board's driver."""

    port: str = parameter(doc='serial port', read_only=True)
    baud: int = parameter(doc='of the port', unit='bit/s', low=9600, high=4000000, read_only=True)
    board_system: int = parameter(doc="board's MAVLink system id", low=1, high=255)
    board_component: int = parameter(doc="board's MAVLink component id", low=1, high=255)
    host_system: int = parameter(doc='our MAVLink system id', low=1, high=255)
    host_component: int = parameter(doc='our MAVLink component id', low=1, high=255)
    target_rate: float = parameter(doc='at which the newest target is sent again', unit='Hz',
                                   low=20, high=1000, read_only=True)
    heartbeat_rate: float = parameter(doc='of our heartbeats', unit='Hz', low=1, high=50)
    timesync_rate: float = parameter(doc='of time requests', unit='Hz', low=0.1, high=50)
    clock_drift: float = parameter(doc='bound of the clocks against each other', unit='s/s',
                                   low=0, high=0.01)
    clock_uncertainty_limit: float = parameter(doc='warn beyond', unit='s', low=1e-4, high=1)
    stamp_age_limit: float = parameter(doc='older targets are not sent', unit='s', low=0.01,
                                       high=1)
    silence: float = parameter(doc='without a packet the link is lost', unit='s', low=0.05,
                               high=5)
    reconnect_period: float = parameter(doc='between attempts to open the port', unit='s',
                                        low=0.01, high=60)
    acknowledge_timeout: float = parameter(doc='wait for an acknowledgement', unit='s', low=0.01,
                                           high=5)
    acknowledge_attempts: int = parameter(doc='times a command is sent', low=1, high=50)
    voltage_time_constant: float = parameter(doc='low pass before the thrust map', unit='s',
                                             low=0, high=5)
    cell_voltage_low: float = parameter(doc='smallest believed', unit='V', low=0, high=5)
    cell_voltage_high: float = parameter(doc='largest believed', unit='V', low=0, high=6)

    @classmethod
    def load(cls, path: str | Path | None = None) -> MotorBoardParameters:
        """Read a file; without a path, the shipped params/motor_board.yaml."""
        return schema.load(cls, path or share_path('params/motor_board.yaml'))
