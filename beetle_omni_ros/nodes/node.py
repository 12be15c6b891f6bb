"""Base class of the package's nodes: parameters, checked inputs, commands, diagnostics."""

from bisect import bisect
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
import math
import time

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future

from beetle_omni_ros.messages.topics import Qos, topic_of
from beetle_omni_ros.messages.values import Diagnostic, MessageError
from beetle_omni_ros.nodes import parameters, wire
from beetle_omni_ros.nodes.graph import claim

OK, WARN, ERROR = range(3)      # of diagnostic_msgs/DiagnosticStatus
PERIOD = 1.0            # s between two diagnostics
SILENCE = 0.5           # s without a message after which an expected topic has ended
FUTURE = 0.05           # s ahead of the clock above which a stamp is refused
IDENTITY = 'supervisor/identity'
TEXT_LIMIT = 40         # characters of a foreign frame_id in an error message


class Distribution:
    """Quantiles of durations in constant memory: a histogram with 2 % wide bins."""

    EDGES = tuple(1e-6 * 1.02 ** k for k in range(1000))    # [s], up to 400 s

    def __init__(self):
        self.counts = np.zeros(len(self.EDGES) + 1, dtype=np.int64)
        self.count, self.max = 0, 0.0

    def add(self, seconds: float) -> None:
        """Count one duration [s]."""
        self.counts[bisect(self.EDGES, seconds)] += 1
        self.count += 1
        self.max = max(self.max, seconds)

    def quantile(self, fraction: float) -> float:
        """Return a quantile [s], up to 2 % too large; NaN if nothing was counted."""
        if not self.count:
            return float('nan')
        k = int(np.searchsorted(np.cumsum(self.counts), fraction * self.count))
        return min((*self.EDGES, self.max)[k], self.max)

    def status(self, text: str, level: int = OK, **more: float) -> tuple[int, str, dict]:
        """Return median, 99th percentile, maximum [ms] and number as a diagnostic status."""
        return level, text, {
            'median_ms': 1e3 * self.quantile(0.5), 'p99_ms': 1e3 * self.quantile(0.99),
            'max_ms': 1e3 * self.max, 'count': self.count, **more}


@dataclass
class Input:
    """Counts of one subscribed topic; if messages are ``expected``, their end is an error."""

    expected: bool
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
        return self.seen is None and self.expected


class FlightNode(Node):
    """
    A node with declared parameters, checked inputs and diagnostics.

    Every second it publishes on ``diagnostics``. An input that stops is an error; an input that
    has never come is not.

    Attributes:
        inputs: topic -> its counts.
        steady_clock: clock for timers that are independent of the flight.
        flight_clock: clock for timers of the flight; simulated time if ``use_sim_time`` is set.
        stop: future that ends the process; its exception is reported without a traceback.

    """

    def __init__(self, name: str, base: type | None = None, file: str | None = None,
                 file_key: str | None = None, on_change: Callable | None = None,
                 changeable: tuple[str, ...] = (), **more):
        """
        Claim the name (OSError if such a node runs), read the parameters, start diagnostics.

        The parameters are those of the class ``base``, ``file_key`` and ``more`` (name -> field).
        The arguments from ``file`` on are those of :func:`parameters.declare`.
        """
        super().__init__(name)
        domain, name = self.context.get_domain_id(), self.get_fully_qualified_name()
        self._claim = claim(f'{domain}{name}')
        if self._claim is None:
            raise OSError(f'{name} runs already (ROS domain {domain}); stop it first')
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        # Simulated time may stop, so timers of the flight must use it too.
        self.simulated = bool(self.get_parameter(parameters.CLOCK).value)
        self.flight_clock = self.get_clock() if self.simulated else self.steady_clock
        if file_key:
            more[file_key] = parameters.file_parameter('parameter file')
        self.parameters = parameters.declare(
            self, parameters.extended(f'{name}_parameters', base, more), file, file_key,
            on_change, changeable)
        self.inputs: dict[str, Input] = {}
        self.warn = wire.warner(self)
        self.stop = Future()
        self._supervisor_identity = ''
        self._diagnostics = wire.Publisher(self, 'diagnostics')
        self._reports = [('inputs', self._input_status)]
        self._compute, self._deadline, self._misses = Distribution(), math.inf, 0
        self._reported_at = self.elapsed()
        self.create_timer(PERIOD, self._publish_diagnostics, clock=self.steady_clock)
        self.get_logger().debug('started')      # the first call is slow: not during a flight

    def now(self) -> float:
        """ROS time [s]; the system's time costs a tenth of the call of rclpy."""
        return self.get_clock().now().nanoseconds * 1e-9 if self.simulated else time.time()

    def elapsed(self) -> float:
        """Return steady time, or simulated time if it is used [s]."""
        return self.now() if self.simulated else time.monotonic()

    def log_line(self, severity: str, text: str) -> None:
        """Log ``text`` with a severity of :mod:`~beetle_omni_ros.safety.events`."""
        # One call for each severity: rclpy ties a severity to the line of the call.
        logger = self.get_logger()
        if severity == 'error':
            logger.error(text)
        elif severity == 'warning':
            logger.warning(text)
        else:
            logger.info(text)

    def listen(self, topic: str, handle: Callable, *, qos: Qos | None = None,
               max_age: float | None = None, expected: bool = True) -> None:
        """
        Subscribe ``topic``; pass valid values to ``handle`` and count refused messages.

        Until a supervisor publishes its identity, every message of `command` is accepted. After
        that, only those whose frame_id is the newest identity are accepted. For targets ``handle``
        also gets the time of publication [s, system time, or nan]; it may raise MessageError.
        ``max_age`` is the limit of a stamp's age [s], which also refuses future stamps.
        """
        entry, counts = topic_of(topic), Input(expected)
        self.inputs[topic] = counts
        if topic == 'command':
            wire.subscribe(self, IDENTITY, partial(setattr, self, '_supervisor_identity'))

        def callback(data, *publication):
            try:
                message = wire.message(entry, data)
                if topic == 'command':
                    self._check_source(message.header.frame_id)
                value = entry.take(message)
                age = self.now() - value.stamp
                if max_age is not None and not -FUTURE <= age <= max_age:
                    raise MessageError('stale stamp' if age > 0 else 'stamp in the future')
                handle(value, *publication)
            except MessageError as error:
                self.reject(topic, str(error), error.kind)
                return
            counts.received += 1
            counts.age, counts.seen = age, self.elapsed()

        wire.subscribe_raw(self, topic, callback, qos)

    def _check_source(self, source):
        identity = self._supervisor_identity
        if identity and source != identity:
            name = f"'{source[:TEXT_LIMIT]}'" if source else 'no identity'
            raise MessageError(
                f"2nd publisher: frame_id has {name}, expected '{identity[:TEXT_LIMIT]}'",
                'not from the supervisor')

    def reject(self, topic: str, reason: str, kind: str) -> None:
        """
        Count a refused message under ``kind``, and log it, see :func:`.wire.warner`.

        Of an expected input only the first of a kind is logged, because its readings come by the
        hundred, and of old stamps only the first after an accepted message.
        """
        entry = self.inputs[topic]
        once = entry.expected or 'stamp' in kind
        if not (once and kind in entry.rejected) and (entry.received or 'stamp' not in kind):
            self.warn(f'{topic}: {kind}', f'{topic}: message refused, {reason}')
        entry.rejected[kind] += 1
        entry.last_refusal = reason

    def report(self, name: str, source: Callable[[], tuple[int, str, dict]]) -> None:
        """Add a diagnostic status '<node>: <name>': (level, message, values)."""
        self._reports.append((name, source))

    def track_compute(self, deadline: float) -> None:
        """Report the CPU times of :meth:`took` against a deadline [s]."""
        self._deadline = deadline
        self.report('compute', lambda: self._compute.status(
            f'{self._misses} deadline misses', WARN if self._misses else OK,
            deadline_misses=self._misses))

    def timed(self, function: Callable, *args):
        """Call ``function`` and count its CPU time."""
        begin = time.thread_time()
        result = function(*args)
        self.took(time.thread_time() - begin)
        return result

    def took(self, seconds: float) -> None:
        """Count a CPU time."""
        self._compute.add(seconds)
        self._misses += seconds > self._deadline

    def introduce(self) -> None:
        """Log in one line what the node does and which inputs are missing."""
        what = (type(self).__doc__ or '').strip().partition('\n')[0]
        waits = ', '.join(topic for topic, entry in self.inputs.items() if entry.is_missing)
        self.get_logger().info(f'{what} Waits for {waits}.' if waits else what)

    def close(self) -> None:
        """Release the resources of the node; overridden by subclasses."""

    def destroy_node(self) -> None:
        """Close, leave the graph, release the name."""
        self.close()
        super().destroy_node()
        self._claim.close()

    def _publish_diagnostics(self):
        found = []
        for part, source in self._reports:
            level, text, values = source()
            found.append(Diagnostic(
                self.now(), f'{self.get_name()}: {part}', level, text,
                {key: f'{value:.6g}' if isinstance(value, float) else str(value)
                 for key, value in values.items()}))
        self._diagnostics.publish(found)

    def _input_status(self):
        level, faults, values, now = OK, [], {}, self.elapsed()
        passed, self._reported_at = max(now - self._reported_at, 1e-9), now
        for topic, entry in self.inputs.items():
            count = entry.rejected.total()
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
