"""Outputs of the supervisor: events, answers to requests, timeouts and ages of sources."""

from collections import deque
from math import inf, isfinite
from typing import NamedTuple

INFO, WARNING, ERROR = 'info', 'warning', 'error'
AGES = 30               # messages: 0.3 s of commands at 100 Hz; a queue after a stall holds ten
SOME = 5                # late ones, 50 ms: before the fastest detector names an actuator (60 ms)


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


class Lateness:
    """
    Ages of the last messages of a source [s], from the IMU sample that they answer to now.

    Attributes:
        age: the median, so that single late messages have no effect.
        late, partly: whether the median, or at least SOME ages, are above the limit.

    """

    def __init__(self, limit: float):
        self._limit, self._ages = limit, deque([0.0] * AGES, AGES)
        self.age, self.late, self.partly = 0.0, False, False

    def add(self, age: float) -> None:
        """Receive the age of a message [s], of no stamp 0."""
        self._ages.append(age if isfinite(age) else 0.0)
        ages, limit = sorted(self._ages), self._limit + 1e-6    # tolerance for rounding
        self.age = ages[AGES // 2]
        self.late, self.partly = self.age > limit, ages[-SOME] > limit

    @property
    def text(self) -> str:
        """For messages: 'late: median age 31 ms, at most 20 ms'."""
        return f'late: median age {1000 * self.age:.0f} ms, at most {1000 * self._limit:.0f} ms'
