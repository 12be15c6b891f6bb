"""
A component: a part of the flight stack that reads topics and writes topics.

All rules stand in components: which message is fresh, which command is from the supervisor, when
a controller steps. A host gives the time and carries the messages. Two hosts exist: the loop in
one process (:mod:`.loop`) and a ROS node (:class:`beetle_omni_ros.ros.node.FlightNode`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
import math
import time
from typing import Any, Protocol

import numpy as np

from beetle_omni_ros.bags.messages import Diagnostic, MessageError
from beetle_omni_ros.bags.topics import Qos, topic_of
from beetle_omni_ros.control.base import error_text
from beetle_omni_ros.control.registry import loaded, snake_case
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.supervisor.interface import Answer

OK, WARN, ERROR = range(3)      # of diagnostic_msgs/DiagnosticStatus
DIAGNOSTICS_PERIOD = 1.0        # [s] between two reports of a component
SILENCE = 0.5           # [s] without a message after which an expected topic has ended
FUTURE = 0.05           # [s] ahead of the clock above which a stamp is refused
IDENTITY = 'supervisor/identity'
TEXT_LIMIT = 40         # characters of a foreign identity in an error message


class Distribution:
    """
    Quantiles of durations in constant memory: a histogram with 2 % wide bins.

    Attributes:
        count: number of durations.
        max: longest duration [s]; 0 without one.

    """

    EDGES = 1e-6 * 1.02 ** np.arange(1000)      # [s], up to 400 s
    PENDING = 1000      # durations that wait to be counted together, which is faster

    def __init__(self):
        self.count, self.max = 0, 0.0
        self._counts = np.zeros(len(self.EDGES) + 1, dtype=np.int64)
        self._pending: list[float] = []

    def add(self, seconds: float) -> None:
        """Count one duration [s]."""
        self.count, self.max = self.count + 1, max(self.max, seconds)
        self._pending.append(seconds)
        if len(self._pending) == self.PENDING:
            self._fill()

    def _fill(self):
        np.add.at(self._counts, np.searchsorted(self.EDGES, self._pending, 'right'), 1)
        self._pending.clear()

    def quantile(self, fraction: float) -> float:
        """Return a quantile [s], up to 2 % too large; NaN if nothing was counted."""
        if not self.count:
            return float('nan')
        self._fill()
        k = int(np.searchsorted(np.cumsum(self._counts), fraction * self.count))
        return float(min(self.EDGES[k] if k < len(self.EDGES) else self.max, self.max))

    def status(self, text: str, level: int = OK, **more: float) -> tuple[int, str, dict]:
        """Return median, 99th percentile, maximum [ms] and number as a diagnostic status."""
        return level, text, {
            'median_ms': 1e3 * self.quantile(0.5), 'p99_ms': 1e3 * self.quantile(0.99),
            'max_ms': 1e3 * self.max, 'count': self.count, **more}


@dataclass
class Input:
    """One topic that a component reads, with counts of its messages."""

    handle: Callable[..., Any]      # of an accepted value, of a target also its publication time
    expected: bool = True           # whether the end of the messages is an error
    max_age: float | None = None    # limit of the age of a stamp [s]; also refuses future stamps
    stamped: bool = True            # a text has no stamp, and is not counted
    qos: Qos | None = None          # quality of service in place of that of the table of topics
    received: int = 0
    reported: int = 0
    age: float = float('nan')
    seen: float | None = None           # elapsed() at the last good message
    rejected: Counter = field(default_factory=Counter)
    rejected_reported: int = 0
    last_refusal: str = ''

    @property
    def is_missing(self) -> bool:
        """Whether a message is expected and none has come yet."""
        return self.seen is None and self.expected and self.stamped


@dataclass
class Timer:
    """A periodic call."""

    period: float               # [s]
    call: Callable[[], None]
    steady: bool = False        # whether the steady clock counts, also if simulated time stands
    reset: Callable[[], None] = lambda: None    # begins a new period; set by the host


class Host(Protocol):
    """What runs a component. ``simulated``: time is simulated, publication times have no age."""

    simulated: bool

    def now(self) -> float:
        """Time of the stamps [s]."""

    def elapsed(self) -> float:
        """Time that is never set back [s]."""

    def publish(self, topic: str, value: Any, source: str) -> None:
        """Carry a value to the readers of its topic; ``source`` identifies a supervisor."""

    def log(self, severity: str, text: str) -> None:
        """Log a line, with a severity of :mod:`~beetle_omni_ros.supervisor.interface`."""

    def warn(self, kind: str, text: str) -> None:
        """Log a warning; the host may leave out repetitions of a kind."""


class Component:
    """
    Base of the components; a subclass declares its topics in its constructor.

    Attributes:
        name: name of its node.
        inputs: topic -> its input.
        outputs: topics that it writes.
        newest: topic -> newest value that it wrote by :meth:`update`.
        timers: periodic calls.
        services: name -> function that answers a request.
        host: what runs it; set by :meth:`attach`.

    """

    def __init__(self, name: str):
        self.name = name
        self.inputs: dict[str, Input] = {}
        self.outputs: list[str] = []
        self.newest: dict[str, Any] = {}
        self.timers: list[Timer] = []
        self.services: dict[str, Callable[[], Answer]] = {}
        self.host: Host
        self._identity = ''     # of the supervisor whose commands are executed
        self._reports: list[tuple[str, Callable[[], tuple[int, str, dict]]]] = [
            ('inputs', self._input_status)]
        self._compute, self._deadline, self._misses = Distribution(), math.inf, 0
        self._reported_at = 0.0

    # Declaration ------------------------------------------------------------------------------

    def reads(self, topic: str, handle: Callable[..., Any], *, max_age: float | None = None,
              expected: bool = True, qos: Qos | None = None) -> None:
        """Declare a topic of stamped values, see :class:`Input`."""
        self.inputs[topic] = Input(handle, expected, max_age, qos=qos)
        if topic == 'command':
            self.follows(IDENTITY, partial(setattr, self, '_identity'))

    def follows(self, topic: str, handle: Callable[[Any], Any]) -> None:
        """Declare a latched topic without stamps: a state, a text."""
        self.inputs[topic] = Input(handle, expected=False, stamped=False)

    def writes(self, *topics: str) -> None:
        """Declare topics that this component publishes."""
        self.outputs += topics

    def every(self, period: float, call: Callable[[], None], *, steady: bool = False) -> Timer:
        """Declare a periodic call [s]; return its timer."""
        self.timers.append(Timer(period, call, steady))
        return self.timers[-1]

    def report(self, name: str, source: Callable[[], tuple[int, str, dict]]) -> None:
        """Add a diagnostic status '<name>: <part>': (level, message, values)."""
        self._reports.append((name, source))

    def track_compute(self, deadline: float) -> None:
        """Report the CPU times of :meth:`took` against a deadline [s]."""
        self._deadline = deadline
        self.report('compute', lambda: self._compute.status(
            f'{self._misses} deadline misses', WARN if self._misses else OK,
            deadline_misses=self._misses))

    def attach(self, host: Host) -> None:
        """Give it a host, before the first message."""
        self.host = host
        self._reported_at = host.elapsed()
        self.start()

    def start(self) -> None:
        """Publish the first states; overridden by subclasses."""

    # Messages ---------------------------------------------------------------------------------

    def feed(self, topic: str, value: Any, source: str = '',
             published: float | None = None) -> None:
        """
        Receive one message, or refuse it, which is counted and logged.

        Args:
            topic: one of ``inputs``.
            value: value of the topic's class.
            source: frame_id of a command: the identity of its supervisor.
            published: time of publication [s], system time, nan if unknown; given for targets
                and passed to their handle.

        """
        entry = self.inputs[topic]
        if not entry.stamped:
            entry.handle(value)
            return
        host = self.host
        age = host.now() - value.stamp
        try:
            if topic == 'command':
                self._check_source(source)
            if (limit := entry.max_age) is not None and not -FUTURE <= age <= limit:
                raise MessageError('stale stamp' if age > 0 else 'stamp in the future')
            if published is None:
                entry.handle(value)
            else:
                entry.handle(value, published)
        except MessageError as error:
            self.reject(topic, str(error), error.kind)
            return
        entry.received += 1
        entry.age, entry.seen = age, host.elapsed()

    def send(self, topic: str, value: Any, source: str = '') -> None:
        """Publish a value of a topic that it writes."""
        if topic not in self.outputs:
            raise ParameterError(f"{self.name}: sends '{topic}', expected one that it writes: "
                                 + (', '.join(self.outputs) or 'none'))
        self.host.publish(topic, value, source)

    def update(self, topic: str, value: Any) -> bool:
        """Publish another text or object than the newest one; return whether it is another."""
        newest = self.newest.get(topic, self)
        if value is newest or isinstance(value, str) and value == newest:
            return False
        self.newest[topic] = value
        self.send(topic, value)
        return True

    def _check_source(self, source):
        """Refuse commands of a second publisher, once a supervisor has published its identity."""
        identity = self._identity
        if identity and source != identity:
            name = f"'{source[:TEXT_LIMIT]}'" if source else 'no identity'
            raise MessageError(
                f"2nd publisher: frame_id has {name}, expected '{identity[:TEXT_LIMIT]}'",
                'not from the supervisor')

    def reject(self, topic: str, reason: str, kind: str) -> None:
        """
        Count a refused message under ``kind``, and log it.

        Of an expected input only the first of a kind is logged, because its readings come by the
        hundred, and of old stamps only the first after an accepted message.
        """
        entry = self.inputs[topic]
        once = entry.expected or 'stamp' in kind
        if not (once and kind in entry.rejected) and (entry.received or 'stamp' not in kind):
            self.host.warn(f'{topic}: {kind}', f'{topic}: message refused, {reason}')
        entry.rejected[kind] += 1
        entry.last_refusal = reason

    # Health -----------------------------------------------------------------------------------

    def timed(self, function: Callable, *args):
        """Call ``function`` and, in real time, count its CPU time."""
        if self.host.simulated:
            return function(*args)
        begin = time.thread_time()
        result = function(*args)
        self.took(time.thread_time() - begin)
        return result

    def took(self, seconds: float) -> None:
        """Count a CPU time [s]."""
        self._compute.add(seconds)
        self._misses += seconds > self._deadline

    @property
    def missing(self) -> list[str]:
        """Expected topics without a message so far."""
        return [topic for topic, entry in self.inputs.items() if entry.is_missing]

    def diagnostics(self) -> list[Diagnostic]:
        """All statuses of this component."""
        statuses = []
        for part, source in self._reports:
            if part == 'compute' and not self._compute.count:
                continue
            level, text, values = source()
            statuses.append(Diagnostic(
                self.host.now(), f'{self.name}: {part}', level, text,
                {key: f'{value:.6g}' if isinstance(value, float) else str(value)
                 for key, value in values.items()}))
        return statuses

    def _input_status(self):
        level, faults, values, now = OK, [], {}, self.host.elapsed()
        passed, self._reported_at = max(now - self._reported_at, 1e-9), now
        for topic, entry in self.inputs.items():
            count = entry.rejected.total()
            if not entry.stamped and not count:
                continue
            values |= {f'{topic} rate_hz': (entry.received - entry.reported) / passed,
                       f'{topic} age_ms': 1e3 * entry.age, f'{topic} received': entry.received,
                       f'{topic} rejected': count,
                       **{f'{topic} rejected: {why}': n for why, n in entry.rejected.items()}}
            if entry.expected and entry.seen is not None and now - entry.seen > SILENCE:
                level = ERROR
                faults.append(f'{topic} silent for {now - entry.seen:.1f} s')
            if count > entry.rejected_reported:
                level = max(level, WARN)
                faults.append(f'{topic}: {count - entry.rejected_reported} rejected, '
                              f'{entry.last_refusal}')
            elif entry.is_missing:
                faults.append(f'waiting for {topic}')
            entry.reported, entry.rejected_reported = entry.received, count
        return level, '; '.join(faults) or 'all arriving', values


# --- components of others ----------------------------------------------------------------------

def component_class(reference: str) -> type[Component]:
    """
    Load a subclass of Component, whose constructor takes the robot.

    Raises:
        ParameterError: there is none at ``reference``, 'FILE.py:Class' or 'package.module:Class'.

    """
    kind = loaded(reference, 'component')
    if not (isinstance(kind, type) and issubclass(kind, Component)):
        raise ParameterError(f"component '{reference}': expected a subclass of Component, "
                             f'found {getattr(kind, "__name__", kind)}')
    return kind


def node_name(kind: type[Component]) -> str:
    """Name of the node of a component: 'wrench_observer_node' of WrenchObserver."""
    return f'{snake_case(kind.__name__)}_node'


def made(references: Iterable[str], robot: RobotParameters) -> list[Component]:
    """
    Components of references; their topics are those of the table or registered ones.

    Raises:
        ParameterError: see :func:`component_class`; the constructor raised an exception; unknown
            topic.

    """
    components = []
    for reference in references:
        try:
            components.append(component_class(reference)(robot))
        except ParameterError:
            raise
        except Exception as error:
            raise ParameterError(f"component '{reference}': building it raised "
                                 f'{error_text(error)}') from error
        for topic in (*components[-1].inputs, *components[-1].outputs):
            topic_of(topic)
    return components
