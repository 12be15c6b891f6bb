"""Limits of `beetle_omni check`."""

from dataclasses import dataclass
from functools import partial

from beetle_omni_ros.robot.schema import group, parameter, ParameterFile

_share = partial(parameter, low=0, high=1)
_supply = partial(parameter, unit='V', low=0, high=60)


def _rate(default, topic, low, high):
    return parameter(default, doc=f'nominal rate of {topic}', unit='Hz', low=low, high=high)


def _age(default, topic, result):
    return parameter(default, doc=f'age of the freshest message of {topic}; {result} above',
                     unit='s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class ServoLimits:
    """Limits for each servo and for the bus."""

    supply_fail_low: float = _supply(6.5, doc='supply of a servo; failure below (its manual)')
    supply_low: float = _supply(10.5, doc='supply of a servo; warning below, it is weak')
    supply_high: float = _supply(12.6, doc='supply of a servo; failure above, its 12 V + 5 %')
    temperature_high: float = parameter(
        55.0, doc='temperature of a servo; warning above, at 70 it shuts down', unit='C', low=0,
        high=150)
    answer_loss: float = _share(0.01, doc='share of missing answers; warning above')
    answer_loss_fail: float = _share(0.1, doc='share of missing answers; failure above')


@dataclass(frozen=True, kw_only=True)
class BatteryLimits:
    """Voltage limits of a cell at rest."""

    cell_fail_low: float = parameter(
        3.5, doc='cell voltage; failure below', unit='V', low=0, high=5)
    cell_low: float = parameter(3.7, doc='cell voltage; warning below', unit='V', low=0, high=5)
    cell_high: float = parameter(4.25, doc='cell voltage; failure above', unit='V', low=0, high=6)


@dataclass(frozen=True, kw_only=True)
class LinkLimits:
    """Limits for serial ports."""

    loss: float = _share(0.01, doc='share of lost or corrupt packets; warning above')
    loss_fail: float = _share(0.1, doc='share of lost or corrupt packets; failure above')
    latency_timer: int = parameter(
        1, doc='latency timer of an FTDI adapter; failure above', unit='ms', low=1, high=255)


@dataclass(frozen=True, kw_only=True)
class TopicLimits:
    """Limits for the rates and ages of ROS topics."""

    mocap_rate: float = _rate(100.0, 'mocap/pose', 1, 2000)
    imu_rate: float = _rate(200.0, 'imu/data_raw', 1, 8000)
    joint_rate: float = _rate(200.0, 'joint_states', 1, 2000)
    battery_rate: float = _rate(10.0, 'battery_state', 0.1, 1000)
    rate_low: float = _share(0.95, doc='share of the nominal rate; warning below')
    rate_fail: float = _share(0.8, doc='share of the nominal rate; failure below')
    rate_high: float = parameter(
        1.2, doc='multiple of the nominal rate; warning above', low=1, high=100)
    ahead: float = parameter(
        0.001, doc='lead of a stamp over the clock of this computer; failure above', unit='s',
        low=0, high=10)
    mocap_age: float = _age(0.03, 'mocap/pose', 'warning')
    mocap_age_fail: float = _age(0.1, 'mocap/pose', 'failure')
    imu_age: float = _age(0.01, 'imu/data_raw', 'warning')
    imu_age_fail: float = _age(0.05, 'imu/data_raw', 'failure')
    joint_age: float = _age(0.02, 'joint_states', 'warning')
    joint_age_fail: float = _age(0.2, 'joint_states', 'failure')
    battery_age: float = _age(0.1, 'battery_state', 'warning')
    battery_age_fail: float = _age(2.0, 'battery_state', 'failure')
    gap: float = parameter(
        0.1, doc='pause between two messages; warning above', unit='s', low=0, high=10)
    gravity_tolerance: float = parameter(
        1.0, doc='difference between mean specific force at rest and gravity; warning above',
        unit='m/s^2', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class CheckLimits(ParameterFile, file='check.yaml'):
    """All limits."""

    servos: ServoLimits = group(ServoLimits, 'servos')
    battery: BatteryLimits = group(BatteryLimits, 'battery')
    link: LinkLimits = group(LinkLimits, 'serial ports')
    topics: TopicLimits = group(TopicLimits, 'topics')
