"""Outcome of a flight with a fault, from the true motion and the commanded thrust."""

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.sim.fault_lists import OutcomeLimits
from beetle_omni_ros.sim.readings import Impact, Truth

# Expected outcome -> outcomes that are equal or better.
BETTER = {'flies_on': ('flies_on', 'refused'), 'lands': ('flies_on', 'refused', 'lands'),
          'stops': ('flies_on', 'refused', 'lands', 'stops'), 'refused': ('refused',)}


@dataclass
class FlightWatch:
    """
    Follows a flight from the onset of its fault, tick by tick.

    Attributes:
        impacts: touchdowns.
        crash: time at which the robot broke [s], or None.
        overrun: longest time after the crash with motors still commanded [s].
        flyaway: whether it left the fence, or its place by too much.
        takeoffs: number of take-offs after it had lain on the floor.
        farthest: largest distance from the start [m].

    """

    limits: OutcomeLimits
    half_width: float
    height: float
    start: np.ndarray
    impacts: list[Impact] = field(default_factory=list)
    crash: float | None = None
    overrun: float = 0.0
    flyaway: bool = False
    takeoffs: int = 0
    farthest: float = 0.0
    _down: float = 0.0
    _floor: float | None = None

    def step(self, truth: Truth, thrust: float, tick: float) -> None:
        """
        Process one tick.

        Args:
            truth: true state.
            thrust: commanded thrust of all rotors together [N].
            tick: duration of the tick [s].

        """
        limits, place = self.limits, truth.position
        if truth.impact is not None and truth.impact not in self.impacts[-1:]:
            self.impacts.append(truth.impact)
        if truth.broken and self.crash is None:
            self.crash = truth.stamp
        if self.crash is not None and thrust > limits.idle_thrust:
            self.overrun = max(self.overrun, truth.stamp - self.crash)
        self.farthest = max(self.farthest, float(np.linalg.norm(place - self.start)))
        outside = max(abs(place[0]) - self.half_width, abs(place[1]) - self.half_width,
                      place[2] - self.height)
        self.flyaway = self.flyaway or bool(outside > limits.fence_margin) \
            or self.farthest > limits.distance
        self._rise(truth, tick)

    def _rise(self, truth, tick):
        """Count take-offs from the floor."""
        self._down = self._down + tick if truth.contact else 0.0
        if self._down >= self.limits.rest_time:
            self._floor = float(truth.position[2])
        if self._floor is not None and truth.position[2] > self._floor + self.limits.rise:
            self.takeoffs += 1
            self._floor = None

    @property
    def worst(self) -> Impact | None:
        """The fastest touchdown."""
        return max(self.impacts, key=lambda impact: impact.speed, default=None)

    def outcome(self, *, asked: bool, stopped: bool, refused: bool) -> str:
        """
        Outcome of the flight as one word.

        Args:
            asked: whether the robot still flew when the landing was commanded.
            stopped: whether the motors were off at the end.
            refused: whether a target was refused, as expected.

        Returns:
            'flies_on', 'refused', 'lands' or 'stops'; or an outcome that is never expected:
            'flyaway', 'takes off', 'crash, motors on', 'hard', 'tilted' or 'does not land'.

        """
        if self.flyaway:
            return 'flyaway'
        if self.takeoffs:
            return 'takes off'
        if self.crash is not None:
            late = self.overrun > self.limits.stop_time
            return 'crash, motors on' if late or not stopped else 'stops'
        if not stopped or self.worst is None:
            return 'does not land'
        if self.worst.speed > self.limits.impact_speed:
            return 'hard'
        if max(impact.inclination for impact in self.impacts) > self.limits.inclination:
            return 'tilted'
        if not asked:
            return 'lands'
        return 'refused' if refused else 'flies_on'


def as_expected(expected: str, outcome: str) -> bool:
    """Whether ``outcome`` is the expected one or better."""
    return outcome in BETTER[expected]
