"""
What an operator may set of the supervisor.

Limits that follow from the robot, its sensors and noise are constants beside their check, with
unit and reason.
"""

from dataclasses import dataclass

from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.schema import group, parameter, ParameterFile


@dataclass(frozen=True, kw_only=True)
class CommandLimits:
    """When a controller loses and gets control."""

    timeout: float = parameter(
        0.05, doc='time without a valid command of the active controller until the fallback',
        unit='s', low=0.01, high=1)
    return_after: float = parameter(
        0.5, doc='time of valid commands before a controller gets control', unit='s', low=0.05,
        high=60)


@dataclass(frozen=True, kw_only=True)
class TakeoffParameters:
    """Climb to the height where the selected controller takes over."""

    height: float = parameter(1.0, doc='height of base_link in world', unit='m', low=0.1, high=20)
    speed: float = parameter(0.5, doc='climb speed', unit='m/s', low=0.05, high=5)


@dataclass(frozen=True, kw_only=True)
class LandingParameters:
    """The descent."""

    speed: float = parameter(0.3, doc='descent speed', unit='m/s', low=0.05, high=3)


@dataclass(frozen=True, kw_only=True)
class BatteryLimits:
    """Voltage of a cell, under load."""

    arm: float = parameter(3.5, doc='smallest voltage for arming', unit='V', low=2.5, high=4.4)
    warn: float = parameter(
        3.4, doc='a lower voltage gives a warning', unit='V', low=2.5, high=4.4)
    land: float = parameter(
        3.2, doc='a lower voltage starts a landing', unit='V', low=2.0, high=4.4)


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """Flight envelope, without attitude, because any attitude is legal."""

    half_width: float = parameter(
        20.0, doc='largest |x| and |y| in world; beyond it the robot lands', unit='m', low=0.5,
        high=1000)
    height: float = parameter(
        20.0, doc='largest z in world; beyond it the robot lands', unit='m', low=0.5, high=1000)
    fallback_time: float = parameter(
        30.0, doc='longest fallback until landing', unit='s', low=1, high=3600)
    mocap_patience: float = parameter(
        1.5, doc='time without raw MoCap until landing', unit='s', low=0.1, high=60)


@dataclass(frozen=True, kw_only=True)
class SupervisorParameters(ParameterFile, file='supervisor.yaml'):
    """All parameters of the supervisor."""

    controller: str = parameter(registry.DEFAULT, doc='the active controller, also in flight')
    commands: CommandLimits = group(CommandLimits)
    takeoff: TakeoffParameters = group(TakeoffParameters)
    landing: LandingParameters = group(LandingParameters)
    battery: BatteryLimits = group(BatteryLimits)
    envelope: Envelope = group(Envelope)
