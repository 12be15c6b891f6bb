"""Detection of touchdowns and of crashes that break the robot."""

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.sim.parameters import CrashParameters
from beetle_omni_ros.sim.readings import Impact, Truth


class CrashWatch:
    """
    Checks the true state once in each ``tick`` [s].

    A robot that has flown breaks if its first contact is too fast, or a contact too inclined. A
    robot that has not flown does not break, so it may be placed on its side.

    Attributes:
        impact: last touchdown, None before the first.
        broken: whether the robot is broken.

    """

    def __init__(self, parameters: CrashParameters, tick: float):
        self._limits, self._tick = parameters, tick
        self.reset()

    def reset(self) -> None:
        """Start with an intact robot that has not flown."""
        self.impact: Impact | None = None
        self.broken = False
        self._airborne, self._flown = 0.0, False

    def step(self, before: Truth, contact: bool) -> None:
        """
        Update after a tick.

        Args:
            before: state before the tick, in which the floor has not slowed the robot yet.
            contact: whether any part touches the floor after the tick.

        """
        if not contact:
            self._airborne += self._tick
            self._flown = self._flown or self._airborne >= self._limits.airborne_time
            return
        vertical = rotations.up(before.quaternion)[2]   # cosine of the inclination
        breaks = vertical < np.cos(self._limits.inclination)
        if self._airborne > 0:
            speed = float(np.linalg.norm(before.velocity))
            breaks = breaks or speed > self._limits.speed
            if self._airborne >= self._limits.airborne_time:
                self.impact = Impact(before.stamp, speed, max(0.0, -float(before.velocity[2])),
                                     float(np.arccos(np.clip(vertical, -1.0, 1.0))))
        self.broken = self.broken or bool(self._flown and breaks)
        self._airborne = 0.0
