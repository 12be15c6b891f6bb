"""
The places where a hidden effect takes hold of a flight.

Every effect of :mod:`gap_data.effects` changes the true robot, or one or more of these. Hooks are
plain functions of floats, because they run a thousand times a simulated second.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

NOTHING = (0.0, 0.0, 0.0)


def direction(rng: np.random.Generator) -> np.ndarray:
    """A unit vector, uniform on the sphere."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


class Snapshot:
    """
    What hooks may look at, at one instant.

    Attributes:
        t: [s] since the flight began.
        position: (3,) [m] of base_link in world.
        quaternion: (4,) w x y z; rotation: nine floats, row by row, body to world.
        velocity_world, velocity: (3,) [m/s] of base_link, in world and in base_link.
        rate: (3,) [rad/s] in base_link.
        tilt, tilt_rate: (4,) [rad], [rad/s] of the rotors' axes.
        thrust, thrust_rate: (4,) [N], [N/s] before effects on the thrust.
        voltage: [V] of the pack.
        command: (4,) [N] as executed now.
        heat: (4,) [1] a motor's warmth, 0 cold, 1 after long hover.

    """

    __slots__ = ('t', 'position', 'quaternion', 'rotation', 'velocity_world', 'velocity', 'rate',
                 'tilt', 'tilt_rate', 'thrust', 'thrust_rate', 'voltage', 'command', 'heat',
                 'axes')


# (rotor, snapshot, thrust [N], axis (3,), velocity of the rotor (3,) in base_link) -> factor
GainHook = Callable[[int, Snapshot, float, tuple, tuple], float]
# the same -> force (3,) at the rotor and torque (3,), in base_link
WrenchHook = Callable[[int, Snapshot, float, tuple, tuple], tuple]
# snapshot -> force (3,) at base_link in world, torque (3,) in base_link
BodyHook = Callable[[Snapshot], tuple]
# (joint, angle [rad], rate [rad/s], snapshot) -> number
JointHook = Callable[[int, float, float, Snapshot], float]


@dataclass
class Hidden:
    """
    Every deviation from the described robot; without arguments there is none.

    Attributes:
        gains: of the rotors' thrust, multiplied.
        wrenches: at the rotors, added.
        body: wrenches at the body, added.
        tilt_errors: of the rotor's axis against the servo's shaft [rad], added.
        joint_torques: at the servo's shaft [N m], added.
        friction: dry friction of a joint [N m]: (joint, rate) -> size; None is none.
        rotor_poles: share of a rotor's lag that is a second lag in series.
        lag_asymmetry: the lag is longer by this share when thrust falls, shorter when it rises.
        thrust_ceiling: [N], None for none; ceiling_softness [N] of the corner.
        tilt_delay, thrust_delay: [s] of commands.
        joint_feedback_delay, mocap_delay, imu_delay: [s] hidden by the stamps.
        accelerometer_bias, gyroscope_bias, imu_position: (3,).
        imu_rotation, mocap_rotation: (3,) [rad] rotation vectors of the sensor's axes.
        slosh: for :func:`gap_data.mjcf.model_xml`.

    """

    gains: list[GainHook] = field(default_factory=list)
    wrenches: list[WrenchHook] = field(default_factory=list)
    body: list[BodyHook] = field(default_factory=list)
    tilt_errors: list[JointHook] = field(default_factory=list)
    joint_torques: list[JointHook] = field(default_factory=list)
    friction: Callable[[int, float], float] | None = None
    rotor_poles: float = 0.0
    lag_asymmetry: float = 0.0
    thrust_ceiling: float | None = None
    ceiling_softness: float = 0.0
    tilt_delay: float = 0.0
    thrust_delay: float = 0.0
    joint_feedback_delay: float = 0.0
    mocap_delay: float = 0.0
    imu_delay: float = 0.0
    accelerometer_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gyroscope_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    imu_position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    imu_rotation: np.ndarray = field(default_factory=lambda: np.zeros(3))
    mocap_rotation: np.ndarray = field(default_factory=lambda: np.zeros(3))
    slosh: dict | None = None
