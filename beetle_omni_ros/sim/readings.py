"""What the simulator hands out in a tick: readings and the truth. Seconds since reset."""

from __future__ import annotations

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
    A touchdown: how the robot moved when it first touched the floor after flight.

    Attributes:
        stamp: [s].
        speed: of base_link [m/s].
        vertical_speed: downward part of it [m/s].
        inclination: between base_link's z axis and up [rad].

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
        impact: the last touchdown, None before the first.
        broken: whether the robot broke; rotors and servos are dead then until reset.

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
    What actuators outside the simulator do in one tick.

    Attributes:
        tilt: (4,) angles that the servos drive to [rad].
        powered: (4,) whether a servo has torque.
        thrust: (4,) thrusts to which the rotors strive [N], as the battery allows.

    """

    tilt: np.ndarray
    powered: Sequence[bool]
    thrust: np.ndarray


@dataclass(frozen=True, slots=True)
class Frame:
    """
    What became available in one tick; None where nothing did.

    With a :class:`Drive`, joints and battery are what those devices measure: each tick, with bias
    and noise, neither late nor rounded, because they do that themselves.
    """

    time: float
    imu: ImuReading | None
    mocap: PoseReading | None
    joints: JointReading | None
    battery: BatteryReading | None
    truth: Truth
    rotors: RotorReading | None = None
