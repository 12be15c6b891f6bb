"""A target that climbs or sinks with a limited speed while the attitude turns to level."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from beetle_omni_ros.control.base import Reference
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.safety.levelling import Way

UP = np.array([0.0, 0.0, 1.0])
BRAKE = 3.0     # [-] in the turn after the leap the robot falls anyway


def inclination(quaternion: np.ndarray) -> float:
    """Angle between the body's z axis and up [rad]."""
    return float(np.arccos(np.clip(rotations.matrix(quaternion)[2, 2], -1.0, 1.0)))


@dataclass(frozen=True)
class Ramp:
    """
    Moves vertically from a pose, and turns to another attitude meanwhile.

    It has the method ``at`` of a target, so a controller can follow it.

    Attributes:
        stamp: when it starts [s].
        position: (3,) start in world [m].
        way: of the attitude.
        wait: time before the vertical motion [s].
        climb: vertical distance, negative downwards, may be infinite [m].
        speed: of the vertical motion [m/s].
        acceleration: of the vertical motion [m/s^2].
        moving: whether it starts with its speed.
        leap: upward acceleration at the start [m/s^2] and its duration [s]; BRAKE times this
            deceleration follows.

    """

    stamp: float
    position: np.ndarray
    way: Way
    wait: float
    climb: float
    speed: float
    acceleration: float
    moving: bool = False
    leap: tuple[float, float] = (0.0, 0.0)

    @property
    def duration(self) -> float:
        """Duration until rest [s]."""
        return max(self.way.duration, self.wait + self._profile(0.0)[2])

    def at(self, time: float) -> Reference:
        """The reference at ``time``."""
        elapsed = max(0.0, time - self.stamp)
        way, speed, _ = self._profile(elapsed - self.wait)
        quaternion, rate = self.way.at(elapsed)
        sign = np.sign(self.climb)
        leapt, rising = self._leap(elapsed)
        return Reference(self.position + (leapt + sign * way) * UP, quaternion,
                         (rising + sign * speed) * UP, rate)

    def _leap(self, elapsed):
        """Height and speed of the leap."""
        acceleration, duration = self.leap
        if elapsed < duration:
            return 0.5 * acceleration * elapsed ** 2, acceleration * elapsed
        left = max(0.0, (1 + 1 / BRAKE) * duration - elapsed)
        top = 0.5 * acceleration * duration ** 2 * (1 + 1 / BRAKE)
        return top - 0.5 * BRAKE * acceleration * left ** 2, BRAKE * acceleration * left

    def _profile(self, elapsed):
        """Distance, speed and total time of a trapezoidal speed profile."""
        if self.moving:
            return max(0.0, elapsed) * self.speed, self.speed, abs(self.climb) / self.speed
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
