"""Inputs and outputs of the simulator in a tick. Times are seconds since reset."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.robot.readings import (
    BatteryReading,
    ImuReading,
    JointReading,
    PoseReading,
    RotorReading,
)


@dataclass(frozen=True, slots=True)
class Impact:
    """
    Motion at a touchdown, the first contact with the floor after flight.

    Attributes:
        stamp: [s].
        speed: speed of base_link [m/s].
        vertical_speed: downward component of the velocity [m/s].
        inclination: angle between base_link's z axis and the vertical [rad].

    """

    stamp: float
    speed: float
    vertical_speed: float
    inclination: float


@dataclass(frozen=True, slots=True)
class Truth:
    """
    The true state.

    Attributes:
        stamp: [s].
        position: (3,) of base_link in world [m].
        velocity: (3,) of base_link's origin in world [m/s].
        quaternion: (4,) base_link to world, xyzw.
        angular_velocity: (3,) in base_link [rad/s].
        tilt: (4,) [rad].
        tilt_velocity: (4,) [rad/s].
        thrust: (4,) present thrusts [N].
        contact: whether any part touches the floor.
        impact: last touchdown, None before the first.
        broken: whether the robot is broken; then rotors and servos do not work until reset.

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
    tilt: np.ndarray
    tilt_velocity: np.ndarray
    thrust: np.ndarray
    contact: bool
    impact: Impact | None = None
    broken: bool = False


@dataclass(frozen=True, slots=True)
class Drive:
    """
    Inputs from actuators outside the simulator in one tick.

    Attributes:
        tilt: (4,) targets of the servos [rad].
        powered: (4,) whether a servo has torque.
        thrust: (4,) targets of the rotors, within the limit of the battery [N].

    """

    tilt: np.ndarray
    powered: Sequence[bool]
    thrust: np.ndarray


@dataclass(frozen=True, slots=True)
class Frame:
    """
    Readings that arrive in one tick, or None, and the true state.

    With a :class:`Drive`, joints and battery are inputs of the devices' sensors. They arrive in
    each tick, with bias and noise, without latency and rounding, which the devices add.
    """

    time: float
    imu: ImuReading | None
    mocap: PoseReading | None
    joints: JointReading | None
    battery: BatteryReading | None
    truth: Truth
    rotors: RotorReading | None = None
