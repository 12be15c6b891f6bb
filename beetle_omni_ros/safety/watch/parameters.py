"""Thresholds of all detectors; params/supervisor.yaml gives the reasons of their values."""

from __future__ import annotations

from dataclasses import dataclass

from beetle_omni_ros.robot.schema import group, parameter


@dataclass(frozen=True, kw_only=True)
class ContactLimits:
    """Detection of contact forces."""

    near_ground: float = parameter(
        0.3, doc='base_link at most this far above where it stood: the floor is in reach',
        unit='m', low=0.05, high=5)
    impact: float = parameter(
        2.0, doc='specific force beyond this times what the rotors can give is an impact', low=1,
        high=20)
    support: float = parameter(
        0.35, doc='force that the rotors do not explain, in weights: something carries it',
        low=0.05, high=2)
    bump: float = parameter(
        1.2, doc='change of the velocity by six MoCap poses, without an IMU', unit='m/s', low=0.1,
        high=20)
    time: float = parameter(0.15, doc='for this long', unit='s', low=0.01, high=2)
    filter: float = parameter(0.03, doc='time constant of forces', unit='s', low=0.005, high=1)


@dataclass(frozen=True, kw_only=True)
class RotorLimits:
    """Detection of a rotor with too little thrust."""

    share: float = parameter(0.5, doc='part of its thrust that is missing', low=0.1, high=1)
    least_thrust: float = parameter(1.5, doc='a rotor asked for less is not judged', unit='N',
                                    low=0.1, high=20)
    explained: float = parameter(
        0.6, doc='part of the squared residual wrench that the loss explains', low=0.1, high=1)
    force_noise: float = parameter(0.6, doc='of the residual, healthy', unit='m/s^2', low=0.01,
                                   high=20)
    torque_noise: float = parameter(6.0, doc='of the residual, healthy', unit='rad/s^2', low=0.1,
                                    high=100)
    least_evidence: float = parameter(
        3.0, doc='residual in standard deviations from which it is judged', low=1, high=1000)
    time: float = parameter(0.05, doc='for this long, where the ESC says so, too', unit='s',
                            low=0.005, high=1)
    time_alone: float = parameter(0.3, doc='for this long, by the wrench alone', unit='s',
                                  low=0.005, high=2)
    noticed: float = parameter(0.25, doc='part of the thrust missing by the ESC that supports it',
                               low=0.05, high=1)
    slip: float = parameter(0.4, doc="angle between the true thrust and the encoder's",
                            unit='rad', low=0.05, high=3)
    slip_time: float = parameter(0.3, doc='for this long', unit='s', low=0.005, high=1)
    speed_time: float = parameter(0.06, doc='for this long, by the ESC speed', unit='s', low=0.005,
                                  high=1)
    slope_window: float = parameter(
        0.5, doc='over which measured thrust is regressed on commanded thrust', unit='s', low=0.05,
        high=10)
    least_variation: float = parameter(
        1.0, doc='standard deviation of the commanded thrust from which it is judged', unit='N',
        low=0.05, high=10)
    excess: float = parameter(
        3.0, doc='thrust beyond the commanded one, and beyond it by `share`, of a rotor that does '
        'not follow', unit='N', low=0.1, high=20)
    deaf_time: float = parameter(0.3, doc='for this long', unit='s', low=0.005, high=5)
    least_slope: float = parameter(
        0.4, doc='slope below which a rotor does not follow its commands', low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class ServoLimits:
    """Detection of a joint that differs from its model."""

    error: float = parameter(0.25, doc='distance from the model', unit='rad', low=0.02, high=3)
    time: float = parameter(0.12, doc='for this long', unit='s', low=0.01, high=2)
    delay: float = parameter(0.025, doc='of commands and feedback together', unit='s', low=0,
                             high=0.2)
    spread: float = parameter(0.03, doc='by which that delay may differ', unit='s', low=0,
                              high=0.2)
    jump: float = parameter(
        0.5, doc='change between two readings beyond what the joint can turn', unit='rad',
        low=0.05, high=6)


@dataclass(frozen=True, kw_only=True)
class MocapLimits:
    """Detection of MoCap that contradicts estimate or gyroscope."""

    attitude: float = parameter(0.35, doc='jump of the attitude against the gyroscope',
                                unit='rad', low=0.05, high=3)
    distance: float = parameter(0.3, doc='of the position from the estimate, or from the pose '
                                'before', unit='m', low=0.02, high=10)
    displaced: int = parameter(30, doc='poses in a row after a jump of the position', low=1,
                               high=1000)
    lasting: int = parameter(10, doc='poses in a row that contradict the estimate', low=1,
                             high=1000)
    frozen: int = parameter(5, doc='poses equal to the last digit while the IMU moves', low=2,
                            high=1000)


@dataclass(frozen=True, kw_only=True)
class ImuLimits:
    """Detection of impossible IMU samples."""

    force_change: float = parameter(
        30.0, doc='change of the specific force of a lone sample that is not used', unit='m/s^2',
        low=1, high=2000)
    rate_change: float = parameter(
        3.0, doc='change of the angular rate, likewise', unit='rad/s', low=0.1, high=200)
    frozen: int = parameter(10, doc='samples in a row that are the same to the last digit', low=2,
                            high=10000)
    axis_frozen: int = parameter(40, doc='samples in a row in which one axis has the same value',
                                 low=2, high=10000)


@dataclass(frozen=True, kw_only=True)
class PackLimits:
    """Detection of a pack with which the robot cannot hold every attitude."""

    noise: float = parameter(0.02, doc='standard deviation of a reading', unit='V', low=1e-4,
                             high=1)
    load_error: float = parameter(
        0.1, doc='share by which the modelled load differs from the true one', low=0, high=1)
    discharge: float = parameter(
        0.03, doc='random walk of the rest voltage', unit='V/s^0.5', low=0, high=1)
    time: float = parameter(0.2, doc='for this long', unit='s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class Detection:
    """All detectors."""

    contact: ContactLimits = group(ContactLimits)
    rotor: RotorLimits = group(RotorLimits)
    servo: ServoLimits = group(ServoLimits)
    mocap: MocapLimits = group(MocapLimits)
    imu: ImuLimits = group(ImuLimits)
    battery: PackLimits = group(PackLimits)
