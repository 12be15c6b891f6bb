"""Outputs of the supervisor: events, answers to requests, and timeouts of sources."""

from math import inf
from typing import NamedTuple

INFO, WARNING, ERROR = 'info', 'warning', 'error'


class Event(NamedTuple):
    """An event for the log: time [s], severity, and one line with node and outcome."""

    stamp: float
    severity: str
    text: str


class Answer(NamedTuple):
    """The answer to a request: granted or not, with the reason."""

    ok: bool
    text: str

    def __bool__(self):
        """Whether the request was granted."""
        return self.ok


class Silence:
    """
    Time since the last message of a source.

    Time is counted in ticks of the supervisor, each of limited length. After a stall of the
    process or a change of the clock, messages in the queue are therefore processed before a source
    is treated as failed.

    Attributes:
        elapsed: [s], inf before the first message.
        silent: whether the silence is longer than ``limit`` [s].
        lost: whether there were messages, and are none now.

    """

    def __init__(self, limit: float):
        self.limit = limit
        self.elapsed, self.silent, self.lost, self._fresh = inf, True, False, False

    def reset(self) -> None:
        """A message arrived within the present tick."""
        self.elapsed, self.silent, self.lost, self._fresh = 0.0, False, False, True

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed; the tick with the message is not counted."""
        if not self._fresh:
            self.elapsed += dt
            self.silent = self.elapsed >= self.limit - 1e-9     # tolerance for rounding
            self.lost = self.silent and self.elapsed < inf
        self._fresh = False

    @property
    def text(self) -> str:
        """For messages: 'silent for 52 ms', or 'silent since the start'."""
        return 'silent since the start' if self.elapsed == inf else \
            f'silent for {1000 * self.elapsed:.0f} ms'
