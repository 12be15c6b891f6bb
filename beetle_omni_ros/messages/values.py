"""Values in messages, independent of ROS. Stamps in seconds, SI units."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np


class MessageError(ValueError):
    """
    A message is unusable; the text gives the reason.

    Attributes:
        kind: category under which it is counted; default: the text. Needed if the text contains
            numbers or names.

    """

    def __init__(self, text: str, kind: str = ''):
        super().__init__(text)
        self.kind = kind or text


@dataclass(frozen=True)
class Odom:
    """
    Pose and velocities of base_link.

    Attributes:
        stamp: [s].
        position: (3,) in world [m].
        velocity: (3,) in world [m/s]; the message carries it in base_link.
        quaternion: (4,) body to world, xyzw.
        angular_velocity: (3,) in base_link [rad/s].
        pose_covariance: computes the (6, 6) of position (world) and small rotation (world axes)
            when the message is written, or None. Not read from messages.
        twist_covariance: the same of the twist in base_link.

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
    pose_covariance: Callable[[], np.ndarray] | None = None
    twist_covariance: Callable[[], np.ndarray] | None = None


@dataclass(frozen=True)
class Wrench:
    """External force in world (3,) [N] and torque in base_link (3,) [N m]."""

    stamp: float
    force: np.ndarray
    torque: np.ndarray


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic status: level 0 ok, 1 warning, 2 error, 3 stale; values as text."""

    t: float
    name: str
    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)
