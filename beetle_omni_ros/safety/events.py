"""Outputs of the supervisor: events, answers to requests, and timeouts of sources."""

from dataclasses import dataclass
from math import inf

INFO, WARNING, ERROR = 'info', 'warning', 'error'
KEPT = 1000   # events; a flight has tens


@dataclass(frozen=True)
class Event:
    """
    An event for the log of the operator.

    Attributes:
        stamp: when [s].
        severity: 'info', 'warning' or 'error'.
        text: one line that names the responsible node and the outcome.

    """

    stamp: float
    severity: str
    text: str


@dataclass(frozen=True)
class Answer:
    """The answer to a request: granted or not, with the reason."""

    ok: bool
    text: str

    def __bool__(self):
        """Whether the request was granted."""
        return self.ok


class EventLog(list):
    """A list of events that drops the oldest ones and does not repeat itself."""

    def __init__(self, quiet_time: float):
        """``quiet_time``: a keyed event is added at most once in this time [s]."""
        super().__init__()
        self._quiet_time = quiet_time
        self._said: dict[str, float] = {}

    def say(self, stamp: float, severity: str, text: str, key: str | None = None) -> None:
        """Add one event; with a ``key``, not again within the quiet time."""
        if key is not None:
            if abs(stamp - self._said.get(key, -inf)) < self._quiet_time:
                return
            self._said[key] = stamp
        self.append(Event(stamp, severity, text))
        if len(self) > KEPT:
            del self[0]


class Silence:
    """
    Time since the last message of a source.

    Time is counted in ticks of the supervisor, each at most ``tick`` long. After a stall of the
    process or a change of the clock, messages in the queue are therefore processed before a source
    is treated as failed.
    """

    def __init__(self, limit: float):
        """``limit``: longer silence is a fault [s]."""
        self.limit = limit
        self.elapsed = inf   # no message yet
        self._just_reset = False

    def reset(self) -> None:
        """A message arrived within the present tick."""
        self.elapsed = 0.0
        self._just_reset = True

    def tick(self, dt: float) -> None:
        """``dt`` seconds passed; the tick with the message is not counted."""
        if not self._just_reset:
            self.elapsed += dt
        self._just_reset = False

    @property
    def from_the_start(self) -> bool:
        """Whether no message has arrived yet."""
        return self.elapsed == inf

    @property
    def silent(self) -> bool:
        """Whether the silence is a fault, with a tolerance for rounding."""
        return self.elapsed >= self.limit - 1e-9

    @property
    def text(self) -> str:
        """For messages: 'silent for 52 ms', or 'silent since the start'."""
        if self.from_the_start:
            return 'silent since the start'
        return f'silent for {1000 * self.elapsed:.0f} ms'
