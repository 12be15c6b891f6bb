"""Pose and velocities of base_link: the record that truth, estimates and states share."""

from dataclasses import dataclass

import numpy as np


@dataclass(slots=True, eq=False)
class BodyState:
    """
    Pose and velocities of base_link at one moment.

    Attributes:
        stamp: time [s].
        position: (3,) in world [m].
        velocity: (3,) in world [m/s].
        quaternion: (4,) body to world, (x, y, z, w), unit.
        angular_velocity: (3,) in base_link [rad/s].

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
