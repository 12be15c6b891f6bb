"""Limits of `beetle_omni check`; read from params/check.yaml."""

from dataclasses import dataclass
from functools import partial

from beetle_omni_ros.robot.schema import parameter, ParameterFile

_share = partial(parameter, low=0, high=1)
_supply = partial(parameter, unit='V', low=0, high=60)


def _rate(topic, low, high):
    return parameter(doc=f'nominal rate of {topic}', unit='Hz', low=low, high=high)


def _age(topic, result):
    return parameter(doc=f'age of the freshest message of {topic}; {result} above', unit='s',
                     low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class ServoLimits:
    """Limits for each servo and for the bus."""

    supply_fail_low: float = _supply(doc='supply voltage of a servo; failure below')
    supply_low: float = _supply(doc='supply voltage of a servo; warning below')
    supply_high: float = _supply(doc='supply voltage of a servo; failure above')
    temperature_high: float = parameter(doc='temperature of a servo; warning above', unit='C',
                                        low=0, high=150)
    answer_loss: float = _share(doc='share of missing answers; warning above')
    answer_loss_fail: float = _share(doc='share of missing answers; failure above')


@dataclass(frozen=True, kw_only=True)
class BatteryLimits:
    """Voltage limits of a cell at rest."""

    cell_fail_low: float = parameter(doc='cell voltage; failure below', unit='V', low=0, high=5)
    cell_low: float = parameter(doc='cell voltage; warning below', unit='V', low=0, high=5)
    cell_high: float = parameter(doc='cell voltage; failure above', unit='V', low=0, high=6)


@dataclass(frozen=True, kw_only=True)
class LinkLimits:
    """Limits for serial ports."""

    loss: float = _share(doc='share of lost or corrupt packets; warning above')
    loss_fail: float = _share(doc='share of lost or corrupt packets; failure above')
    latency_timer: int = parameter(doc='latency timer of an FTDI adapter; failure above',
                                   unit='ms', low=1, high=255)


@dataclass(frozen=True, kw_only=True)
class TopicLimits:
    """Limits for the rates and ages of ROS topics."""

    mocap_rate: float = _rate('mocap/pose', 1, 2000)
    imu_rate: float = _rate('imu/data_raw', 1, 8000)
    joint_rate: float = _rate('joint_states', 1, 2000)
    battery_rate: float = _rate('battery_state', 0.1, 1000)
    rate_low: float = _share(doc='share of the nominal rate; warning below')
    rate_fail: float = _share(doc='share of the nominal rate; failure below')
    rate_high: float = parameter(doc='multiple of the nominal rate; warning above', low=1,
                                 high=100)
    ahead: float = parameter(doc='lead of a stamp over the clock of this computer; failure above',
                             unit='s', low=0, high=10)
    mocap_age: float = _age('mocap/pose', 'warning')
    mocap_age_fail: float = _age('mocap/pose', 'failure')
    imu_age: float = _age('imu/data_raw', 'warning')
    imu_age_fail: float = _age('imu/data_raw', 'failure')
    joint_age: float = _age('joint_states', 'warning')
    joint_age_fail: float = _age('joint_states', 'failure')
    battery_age: float = _age('battery_state', 'warning')
    battery_age_fail: float = _age('battery_state', 'failure')
    gap: float = parameter(doc='pause between two messages; warning above', unit='s', low=0,
                           high=10)
    gravity_tolerance: float = parameter(
        doc='difference between mean specific force at rest and gravity; warning above',
        unit='m/s^2', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class CheckLimits(ParameterFile, file='check.yaml'):
    """All limits of params/check.yaml."""

    servos: ServoLimits = parameter(doc='servos')
    battery: BatteryLimits = parameter(doc='battery')
    link: LinkLimits = parameter(doc='serial ports')
    topics: TopicLimits = parameter(doc='topics')
