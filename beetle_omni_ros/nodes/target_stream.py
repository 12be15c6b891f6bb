"""What became of the targets for the motor board: cycles, missed ones, refusals, saturation."""

from __future__ import annotations

from collections import Counter

import numpy as np

from beetle_omni_ros.drivers.motor_board import Sent
from beetle_omni_ros.nodes.health import Distribution


class TargetStream:
    """
    Counts of a stream of targets that should have one in every period.

    Attributes:
        cycles: periods in which a target was to be written.
        missed: those of them that passed without one.
        unsent: reason -> targets that could not be sent.
        latency: from the publication of a command to the last byte of its target, once for each.
        latency_from: what its beginning is.
        age: of commands, by their stamp, as the last byte of their target is written: the latency
            of the whole loop, from the IMU sample on.
        command: (4,) normalised commands of the newest target.
        saturated: (4,) targets of each rotor beyond what the battery can give.

    """

    def __init__(self, period: float):
        """Expect a target every ``period`` [s]."""
        self._period = period
        self._last: float | None = None
        self.cycles = self.missed = 0
        self.unsent: Counter = Counter()
        self.latency, self.latency_from = Distribution(), 'no command yet'
        self.age = Distribution()
        self.command = np.zeros(4)
        self.saturated = np.zeros(4, dtype=int)

    def rest(self) -> None:
        """Nothing is to be written until the next target."""
        self._last = None

    def add(self, sent: Sent, now: float) -> None:
        """Take what became of a target at monotonic time ``now`` [s]."""
        if not sent.sent:
            self.unsent[sent.reason] += 1
            return
        if self._last is not None:
            # What lies nearer to one period than to two was in time.
            cycles = round((now - self._last) / self._period)
            self.cycles += cycles
            self.missed += max(cycles - 1, 0)
        self._last = now
        self.command = sent.command
        self.saturated += sent.saturated

    def answered(self, seconds: float, begin: str, age: float) -> None:
        """Take the latency [s] of one command, counted from ``begin``, and its age [s]."""
        self.latency.add(seconds)
        self.latency_from = begin
        self.age.add(age)
