"""A target that climbs or sinks at a limited speed while the attitude turns level."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np

from beetle_omni_ros.control.base import Reference
from beetle_omni_ros.robot import rotations

UP = np.array([0.0, 0.0, 1.0])


def inclination(quaternion: np.ndarray) -> float:
    """Angle between the body's z axis and up [rad]."""
    return float(np.arccos(np.clip(rotations.matrix(quaternion)[2, 2], -1.0, 1.0)))


def levelled(quaternion: np.ndarray) -> np.ndarray:
    """The level attitude that is the shortest turn away; from upside down, a half roll."""
    rotation = rotations.matrix(quaternion)
    axis = np.cross(rotation[:, 2], UP)
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        axis, length = rotation[:, 0], 1.0
    turn = rotations.exp(axis / length * inclination(quaternion))
    return rotations.normalized(rotations.multiply(turn, quaternion))


@dataclass(frozen=True)
class Ramp:
    """
    Moves vertically from a pose, after turning at a steady rate towards another attitude.

    It has the ``at`` of a target, so a controller follows it like any other.

    Attributes:
        stamp: when it starts [s].
        position: (3,) start in world [m].
        quaternion: (4,) start.
        goal: (4,) attitude at the end of the turn.
        rate: of the turn [rad/s].
        wait: time before the vertical motion [s].
        climb: vertical way, negative downwards, may be infinite [m].
        speed: of the vertical motion [m/s].
        acceleration: of the vertical motion [m/s^2].

    """

    stamp: float
    position: np.ndarray
    quaternion: np.ndarray
    goal: np.ndarray
    rate: float
    wait: float
    climb: float
    speed: float
    acceleration: float

    @property
    def turn_time(self) -> float:
        """Duration of the turn [s]."""
        return rotations.geodesic_angle(self.goal, self.quaternion) / self.rate

    @property
    def duration(self) -> float:
        """Until nothing moves any more [s]."""
        return max(self.turn_time, self.wait + self._profile(0.0)[2])

    def at(self, time: float) -> Reference:
        """The reference at ``time``."""
        elapsed = max(0.0, time - self.stamp)
        way, speed, _ = self._profile(elapsed - self.wait)
        turn = rotations.log(rotations.multiply(rotations.conjugate(self.quaternion), self.goal))
        total = self.turn_time
        share = 1.0 if total <= 0 else min(1.0, elapsed / total)
        sign = np.sign(self.climb)
        return Reference(
            self.position + sign * way * UP,
            rotations.multiply(self.quaternion, rotations.exp(share * turn)),
            sign * speed * UP, turn / total if share < 1.0 else np.zeros(3))

    def _profile(self, elapsed):
        """Way, speed and total time of a trapezoid of speed."""
        length, a = abs(self.climb), self.acceleration
        speed = min(self.speed, sqrt(length * a))
        rise = speed / a
        total = length / speed + rise if speed > 0 else 0.0
        if elapsed <= 0 or speed == 0:
            return 0.0, 0.0, total
        if elapsed < rise:
            return 0.5 * a * elapsed ** 2, a * elapsed, total
        if elapsed < total - rise:
            return speed * (elapsed - 0.5 * rise), speed, total
        if elapsed < total:
            left = total - elapsed
            return length - 0.5 * a * left ** 2, a * left, total
        return length, 0.0, total
