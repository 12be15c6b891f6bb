"""Rotors whose ESC reports less speed than the commanded thrust needs."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.robot.allocation import ROTORS
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.watch.parameters import RotorLimits

LEARNT = 1.0            # [s] over which each rotor's speed at a thrust is learnt
LONGEST = 0.2           # [s] between two reports that still count as one stretch


class SpeedWatch:
    """
    Thrust goes with the square of the speed; the factor of each rotor is learnt in flight.

    Args:
        limits: thresholds.
        robot: as believed.

    Attributes:
        lost: the rotor (0 to 3) that turns too slowly, or None.

    """

    def __init__(self, limits: RotorLimits, robot: RobotParameters):
        """See the class."""
        self._p, self._lag = limits, robot.rotors.time_constant
        self.reset()

    def reset(self) -> None:
        """Begin anew, with nothing learnt."""
        self._stamp = -np.inf
        self._thrust = np.zeros(ROTORS)
        self._factor = np.zeros(ROTORS)     # [N s^2/rad^2]
        self._learnt_for = np.zeros(ROTORS)
        self._for = np.zeros(ROTORS)
        self.lost: int | None = None

    def on_speeds(self, stamp: float, speed: np.ndarray, thrust: np.ndarray) -> None:
        """
        Take a report.

        Args:
            stamp: [s].
            speed: (4,) [rad/s], nan where the ESC is offline.
            thrust: (4,) commanded [N].

        """
        dt = stamp - self._stamp
        if dt <= 0:
            return
        self._stamp = stamp
        if dt > LONGEST:
            self._thrust = np.array(thrust, dtype=float)
            return
        self._thrust += -np.expm1(-dt / self._lag) * (thrust - self._thrust)
        square = np.asarray(speed, dtype=float)**2
        judged = np.isfinite(square) & (self._thrust > self._p.least_thrust)
        known = judged & (self._learnt_for >= LEARNT)
        slow = known & (self._factor * square < (1 - self._p.share) * self._thrust)
        self._for = np.where(slow, self._for + dt, 0.0)
        self.lost = int(np.argmax(self._for)) if self._for.max() >= self._p.speed_time else None
        learn = judged & ~slow & (square > 0)
        ratio = np.divide(self._thrust, square, out=np.zeros(ROTORS), where=learn)
        gain = np.minimum(1.0, dt / np.maximum(self._learnt_for, dt))
        gain = np.maximum(gain, min(1.0, dt / LEARNT))
        self._factor = np.where(learn, self._factor + gain * (ratio - self._factor), self._factor)
        self._learnt_for = np.where(learn, self._learnt_for + dt, self._learnt_for)
