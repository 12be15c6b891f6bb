"""What `beetle_omni check` calls well; read from params/check.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, kw_only=True)
class ServoLimits:
    """Of each servo and of the bus."""

    supply_fail_low: float = parameter(doc='fails below', unit='V', low=0, high=60)
    supply_low: float = parameter(doc='warns below', unit='V', low=0, high=60)
    supply_high: float = parameter(doc='fails above', unit='V', low=0, high=60)
    temperature_high: float = parameter(doc='warns above', unit='C', low=0, high=150)
    answer_loss: float = parameter(doc='share of missing answers, warns above', low=0, high=1)
    answer_loss_fail: float = parameter(doc='fails above', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class BatteryLimits:
    """Of each cell, at rest."""

    cell_fail_low: float = parameter(doc='fails below', unit='V', low=0, high=5)
    cell_low: float = parameter(doc='warns below', unit='V', low=0, high=5)
    cell_high: float = parameter(doc='fails above', unit='V', low=0, high=6)


@dataclass(frozen=True, kw_only=True)
class LinkLimits:
    """Of serial ports."""

    loss: float = parameter(doc='share of packets, warns above', low=0, high=1)
    loss_fail: float = parameter(doc='fails above', low=0, high=1)
    latency_timer: int = parameter(doc='fails above', unit='ms', low=1, high=255)


@dataclass(frozen=True, kw_only=True)
class TopicLimits:
    """Rates and ages of ROS topics; ages are those of the freshest message."""

    mocap_rate: float = parameter(doc='wanted', unit='Hz', low=1, high=2000)
    imu_rate: float = parameter(doc='wanted', unit='Hz', low=1, high=8000)
    joint_rate: float = parameter(doc='wanted', unit='Hz', low=1, high=2000)
    battery_rate: float = parameter(doc='wanted', unit='Hz', low=0.1, high=1000)
    rate_low: float = parameter(doc='share of the rate, warns below', low=0, high=1)
    rate_fail: float = parameter(doc='fails below', low=0, high=1)
    rate_high: float = parameter(doc='warns above', low=1, high=100)
    ahead: float = parameter(doc='stamps in the future fail beyond', unit='s', low=0, high=10)
    mocap_age: float = parameter(doc='warns above', unit='s', low=0, high=10)
    mocap_age_fail: float = parameter(doc='fails above', unit='s', low=0, high=10)
    imu_age: float = parameter(doc='warns above', unit='s', low=0, high=10)
    imu_age_fail: float = parameter(doc='fails above', unit='s', low=0, high=10)
    joint_age: float = parameter(doc='warns above', unit='s', low=0, high=10)
    joint_age_fail: float = parameter(doc='fails above', unit='s', low=0, high=10)
    battery_age: float = parameter(doc='warns above', unit='s', low=0, high=10)
    battery_age_fail: float = parameter(doc='fails above', unit='s', low=0, high=10)
    gap: float = parameter(doc='between two messages, warns above', unit='s', low=0, high=10)
    gravity_tolerance: float = parameter(doc='mean specific force at rest, warns beyond',
                                         unit='m/s^2', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class CheckLimits:
    """All of them."""

    servos: ServoLimits = parameter(doc='servos')
    battery: BatteryLimits = parameter(doc='battery')
    link: LinkLimits = parameter(doc='serial ports')
    topics: TopicLimits = parameter(doc='topics')

    @classmethod
    def load(cls, path: str | Path | None = None) -> CheckLimits:
        """Read a file; without a path, the shipped params/check.yaml."""
        return schema.load(cls, path or share_path('params/check.yaml'))
