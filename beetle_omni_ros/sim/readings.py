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
    """Motion at a touchdown, the first contact with the floor after flight."""

    stamp: float
    speed: float                    # of base_link [m/s]
    vertical_speed: float           # downward [m/s]
    inclination: float              # angle between base_link's z axis and the vertical [rad]


@dataclass(frozen=True, slots=True)
class Truth:
    """The true state."""

    stamp: float
    position: np.ndarray            # (3,) of base_link in world [m]
    velocity: np.ndarray            # (3,) of base_link's origin in world [m/s]
    quaternion: np.ndarray          # (4,) base_link to world, xyzw
    angular_velocity: np.ndarray    # (3,) in base_link [rad/s]
    tilt: np.ndarray                # (4,) [rad]
    tilt_velocity: np.ndarray       # (4,) [rad/s]
    thrust: np.ndarray              # (4,) present thrusts [N]
    contact: bool                   # whether any part touches the floor
    impact: Impact | None = None    # last touchdown
    broken: bool = False            # then rotors and servos do not work until reset


@dataclass(frozen=True, slots=True)
class Drive:
    """Inputs from actuators outside the simulator in one tick."""

    tilt: np.ndarray                # (4,) targets of the servos [rad]
    powered: Sequence[bool]         # (4,) whether a servo has torque
    thrust: np.ndarray              # (4,) targets of the rotors, within the battery's limit [N]


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
