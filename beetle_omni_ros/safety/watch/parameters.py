"""Thresholds of all detectors; params/supervisor.yaml gives the reasons of their values."""

from dataclasses import dataclass

from beetle_omni_ros.robot.schema import group, parameter


@dataclass(frozen=True, kw_only=True)
class ContactLimits:
    """Detection of contact forces."""

    near_ground: float = parameter(
        0.3, doc='height of base_link above its standing height within which the floor is near',
        unit='m', low=0.05, high=5)
    impact: float = parameter(
        2.0, doc='ratio of specific force to the largest of the rotors above which there is an '
        'impact', low=1, high=20)
    support: float = parameter(
        0.35, doc='force not explained by the rotors, relative to the weight, above which the '
        'robot is supported', low=0.05, high=2)
    bump: float = parameter(
        1.2, doc='without IMU: change of the velocity, from six MoCap poses, that is an impact',
        unit='m/s', low=0.1, high=20)
    time: float = parameter(
        0.15, doc='duration of the support until it is detected', unit='s', low=0.01, high=2)
    filter: float = parameter(
        0.03, doc='time constant of the force filter', unit='s', low=0.005, high=1)


@dataclass(frozen=True, kw_only=True)
class RotorLimits:
    """Detection of a rotor with too little thrust."""

    share: float = parameter(
        0.5, doc='missing share of the thrust of a lost rotor', low=0.1, high=1)
    least_thrust: float = parameter(
        1.5, doc='smallest commanded thrust for a decision', unit='N', low=0.1, high=20)
    explained: float = parameter(
        0.6, doc='smallest share of the squared residual wrench that the loss explains', low=0.1,
        high=1)
    force_noise: float = parameter(
        0.6, doc='residual force of a healthy robot', unit='m/s^2', low=0.01, high=20)
    torque_noise: float = parameter(
        6.0, doc='residual torque of a healthy robot', unit='rad/s^2', low=0.1, high=100)
    least_evidence: float = parameter(
        3.0, doc='smallest residual for a decision, in these deviations', low=1, high=1000)
    time: float = parameter(
        0.05, doc='duration until detection if the ESC telemetry also shows a loss', unit='s',
        low=0.005, high=1)
    time_alone: float = parameter(
        0.3, doc='duration until detection by the wrench alone', unit='s', low=0.005, high=2)
    steady_share: float = parameter(
        0.35, doc='missing share of the thrust of a lost rotor, if the loss lasts', low=0.1,
        high=1)
    steady_filter: float = parameter(
        0.5, doc='time constant of the filter of a lasting loss', unit='s', low=0.05, high=10)
    steady_explained: float = parameter(
        0.8, doc='smallest share of the squared residual that a lasting loss explains', low=0.1,
        high=1)
    steady_evidence: float = parameter(
        2.0, doc='smallest residual of a lasting loss, in the deviations above', low=0.5,
        high=1000)
    steady_time: float = parameter(
        1.0, doc='duration of a lasting loss until detection', unit='s', low=0.05, high=10)
    noticed: float = parameter(
        0.25, doc='missing share of the thrust by ESC telemetry that confirms a loss', low=0.05,
        high=1)
    slip: float = parameter(
        0.4, doc='angle between the estimated thrust direction and that of the encoder',
        unit='rad', low=0.05, high=3)
    slip_time: float = parameter(
        0.3, doc='duration of the slip until detection', unit='s', low=0.005, high=1)
    speed_time: float = parameter(
        0.06, doc='duration until detection by the ESC speed', unit='s', low=0.005, high=1)
    slope_window: float = parameter(
        0.5, doc='window of the regression of measured on commanded thrust', unit='s', low=0.05,
        high=10)
    least_variation: float = parameter(
        1.0, doc='smallest standard deviation of the commanded thrust for a decision', unit='N',
        low=0.05, high=10)
    excess: float = parameter(
        3.0, doc='excess of the thrust over the command, also relative by `share`, of a rotor '
        'that does not follow', unit='N', low=0.1, high=20)
    deaf_time: float = parameter(
        0.3, doc='duration until a rotor that does not follow is detected', unit='s', low=0.005,
        high=5)
    least_slope: float = parameter(
        0.4, doc='slope below which a rotor does not follow its commands', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class ServoLimits:
    """Detection of a joint that differs from its model."""

    error: float = parameter(
        0.25, doc='difference between measured and modelled tilt', unit='rad', low=0.02, high=3)
    time: float = parameter(
        0.12, doc='duration of the difference until detection', unit='s', low=0.01, high=2)
    delay: float = parameter(
        0.025, doc='sum of the delays of commands and feedback', unit='s', low=0, high=0.2)
    spread: float = parameter(0.03, doc='uncertainty of this delay', unit='s', low=0, high=0.2)
    jump: float = parameter(
        0.5, doc='change between two readings beyond the possible motion of the joint', unit='rad',
        low=0.05, high=6)


@dataclass(frozen=True, kw_only=True)
class MocapLimits:
    """Detection of MoCap that contradicts estimate or gyroscope."""

    attitude: float = parameter(0.35, doc='jump of the attitude against the gyroscope',
                                unit='rad', low=0.05, high=3)
    distance: float = parameter(
        0.3, doc='jump of the position from the estimate, or from the previous pose', unit='m',
        low=0.02, high=10)
    displaced: int = parameter(
        30, doc='consecutive poses after a jump of the position', low=1, high=1000)
    lasting: int = parameter(
        10, doc='consecutive poses that contradict the estimate', low=1, high=1000)
    frozen: int = parameter(5, doc='consecutive equal poses while the IMU moves', low=2, high=1000)


@dataclass(frozen=True, kw_only=True)
class ImuLimits:
    """Detection of impossible IMU samples."""

    force_change: float = parameter(
        30.0, doc='change of the specific force of a single sample that is not used', unit='m/s^2',
        low=1, high=2000)
    rate_change: float = parameter(
        3.0, doc='change of the angular rate of a single sample that is not used', unit='rad/s',
        low=0.1, high=200)
    frozen: int = parameter(10, doc='consecutive equal samples', low=2, high=10000)
    axis_frozen: int = parameter(
        40, doc='consecutive samples with an equal value of one axis', low=2, high=10000)


@dataclass(frozen=True, kw_only=True)
class PackLimits:
    """Detection of a pack with which the robot cannot hold every attitude."""

    noise: float = parameter(0.02, doc='standard deviation of a reading', unit='V', low=1e-4,
                             high=1)
    load_error: float = parameter(0.1, doc='relative error of the modelled load', low=0, high=1)
    discharge: float = parameter(
        0.03, doc='random walk of the rest voltage', unit='V/s^0.5', low=0, high=1)
    time: float = parameter(0.2, doc='duration until detection', unit='s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class Detection:
    """All detectors."""

    contact: ContactLimits = group(ContactLimits)
    rotor: RotorLimits = group(RotorLimits)
    servo: ServoLimits = group(ServoLimits)
    mocap: MocapLimits = group(MocapLimits)
    imu: ImuLimits = group(ImuLimits)
    battery: PackLimits = group(PackLimits)
