"""Touchdowns, and what they break."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.sim.parameters import CrashParameters
from beetle_omni_ros.sim.readings import Impact, Truth


class CrashWatch:
    """
    Looks at every tick of the truth.

    A robot that has flown breaks when it meets the floor too fast, or lies on it too inclined. One
    that was put down on its side and has not flown does not.

    Attributes:
        impact: the last touchdown, None before the first.
        broken: whether the robot broke.

    """

    def __init__(self, parameters: CrashParameters, tick: float):
        """``tick`` between two calls of :meth:`step` [s]."""
        self._limits, self._tick = parameters, tick
        self.reset()

    def reset(self) -> None:
        """A whole robot that has not flown."""
        self.impact: Impact | None = None
        self.broken = False
        self._airborne, self._flown = 0.0, False

    def step(self, before: Truth, contact: bool) -> None:
        """
        Take what a tick brought.

        Args:
            before: the state before the tick: in it the floor has not yet slowed the robot.
            contact: whether any part touches the floor after it.

        """
        if not contact:
            self._airborne += self._tick
            self._flown = self._flown or self._airborne >= self._limits.airborne_time
            return
        if self._airborne > 0:
            touch = _touch(before)
            if self._airborne >= self._limits.airborne_time:
                self.impact = touch
            self._break(touch.speed > self._limits.speed)
        self._break(np.cos(self._limits.inclination) > _up(before))
        self._airborne = 0.0

    def _break(self, hard):
        self.broken = self.broken or bool(hard and self._flown)


def _up(truth):
    """Cosine of the inclination."""
    x, y = truth.quaternion[0], truth.quaternion[1]
    return 1 - 2 * (x * x + y * y)


def _touch(truth):
    speed = float(np.linalg.norm(truth.velocity))
    up = rotations.matrix(truth.quaternion)[2, 2]
    return Impact(truth.stamp, speed, max(0.0, -float(truth.velocity[2])),
                  float(np.arccos(np.clip(up, -1.0, 1.0))))
