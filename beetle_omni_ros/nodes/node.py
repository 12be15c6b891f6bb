"""Base class of the package's nodes: parameters, checked inputs, commands, diagnostics."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
import math
import time
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from beetle_omni_ros.messages.topics import Qos, TARGETS, topic_of
from beetle_omni_ros.messages.values import Diagnostic, MessageError
from beetle_omni_ros.nodes import parameters, wire
from beetle_omni_ros.nodes.graph import claim
from beetle_omni_ros.nodes.parameters import file_parameter

OK, WARN, ERROR = range(3)   # of diagnostic_msgs/DiagnosticStatus
PERIOD = 1.0            # s between two diagnostics
FUTURE = 0.05           # s ahead of the clock above which a stamp is refused
IDENTITY = 'supervisor/identity'
TEXT_LIMIT = 40         # characters of a foreign frame_id in an error message


class FlightNode(Node):
    """
    A node with declared parameters, checked inputs and diagnostics.

    Attributes:
        steady_clock: clock for timers that are independent of the flight.
        flight_clock: clock for timers of the flight; simulated time if ``use_sim_time`` is set.

    """

    def __init__(self, name: str, base: type | None = None, file: str | None = None,
                 file_key: str | None = None, on_change: Callable | None = None,
                 changeable: tuple[str, ...] | None = None,
                 completed: Callable[[dict, bool], dict] | None = None, **more):
        """
        Claim the name, read the parameters, start diagnostics.

        The parameters are those of the class ``base``, ``file_key`` and ``more`` (name -> field).
        The arguments from ``file`` on are those of :func:`parameters.declare`.

        Raises:
            ParameterError: unusable parameters.
            OSError: a node of this name runs already.

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
            more[file_key] = file_parameter('parameter file')
        self.parameters = parameters.declare(
            self, parameters.extended(f'{name}_parameters', base, more), file, file_key,
            on_change, changeable, completed)
        self._supervisor_identity = ''
        self.health = Health(self)
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

    def publisher(self, topic: str) -> wire.Publisher:
        """Make the publisher of a topic."""
        return wire.Publisher(self, topic)

    def follow(self, topic: str, handle: Callable[[Any], None]) -> None:
        """Pass the values of a latched topic to ``handle``, without checks of age."""
        wire.subscribe(self, topic, handle)

    def listen(self, topic: str, handle: Callable, *, qos: Qos | None = None,
               max_age: float | None = None, stale_after: float | None = 0.5) -> None:
        """
        Subscribe ``topic``; pass valid values to ``handle`` and count refused messages.

        Until a supervisor publishes its identity, every message of `command` is accepted. After
        that, only those whose frame_id is the newest identity are accepted.

        Args:
            topic: relative name in the table of topics.
            handle: called with each value, and for targets with the time of publication [s,
                system time, or nan]; may raise MessageError to refuse it.
            qos: quality of service; default: the table's, any for targets.
            max_age: limit of a stamp's age [s], also refuses future stamps; None: no check.
            stale_after: silence after a message that is an error [s]; None: never.

        """
        entry, counts = topic_of(topic), Input(stale_after)
        self.health.inputs[topic] = counts
        if topic == 'command':
            self.follow(IDENTITY, partial(setattr, self, '_supervisor_identity'))

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
                self.health.rejected(topic, str(error), error.kind)
                return
            counts.received += 1
            counts.age, counts.seen = age, self.elapsed()

        if topic in TARGETS:
            wire.subscribe_any(self, topic, callback)
        else:
            wire.subscribe_raw(self, topic, callback, qos)

    def _check_source(self, source):
        identity = self._supervisor_identity
        if identity and source != identity:
            name = f"'{source[:TEXT_LIMIT]}'" if source else 'no identity'
            raise MessageError(
                f"2nd publisher: frame_id has {name}, expected '{identity[:TEXT_LIMIT]}'",
                'not from the supervisor')

    def timed(self, function: Callable, *args):
        """Call ``function`` and count its CPU and wall time."""
        cpu, wall = time.thread_time(), time.perf_counter()
        result = function(*args)
        self.health.computed(time.thread_time() - cpu, time.perf_counter() - wall)
        return result

    def introduce(self) -> None:
        """Log in one line what the node does and which inputs are missing."""
        what = (type(self).__doc__ or '').strip().partition('\n')[0]
        waits = ', '.join(topic for topic, entry in self.health.inputs.items()
                          if entry.seen is None and entry.stale_after is not None)
        self.get_logger().info(f'{what} Waits for {waits}.' if waits else what)

    def close(self) -> None:
        """Release the resources of the node; overridden by subclasses."""

    def destroy_node(self) -> None:
        """Close, leave the graph, release the name."""
        self.close()
        super().destroy_node()
        if self._claim:
            self._claim.close()


# --- diagnostics ------------------------------------------------------------------------------

class Distribution:
    """Quantiles of durations in constant memory: a histogram with 2 % wide bins."""

    LOW, RATIO, BINS = 1e-6, 1.02, 1000     # 1 us to 400 s

    def __init__(self):
        self.counts = np.zeros(self.BINS, dtype=np.int64)
        self.count, self.max = 0, 0.0

    def add(self, seconds: float) -> None:
        """Count one duration [s]."""
        k = int(math.log(max(seconds, self.LOW) / self.LOW) / math.log(self.RATIO))
        self.counts[min(k, self.BINS - 1)] += 1
        self.count += 1
        self.max = max(self.max, seconds)

    def quantile(self, fraction: float) -> float:
        """Return a quantile [s], accurate to 1 %; NaN if nothing was counted."""
        if not self.count:
            return float('nan')
        k = int(np.searchsorted(np.cumsum(self.counts), fraction * self.count))
        return min(self.LOW * self.RATIO ** (k + 0.5), self.max)

    def status(self, text: str, level: int = OK, **more: float) -> tuple[int, str, dict]:
        """Return median, 99th percentile, maximum [ms] and number as a diagnostic status."""
        return level, text, {
            'median_ms': 1e3 * self.quantile(0.5), 'p99_ms': 1e3 * self.quantile(0.99),
            'max_ms': 1e3 * self.max, 'count': self.count, **more}


@dataclass
class Input:
    """Counts of one subscribed topic; silence of ``stale_after`` [s] is an error, None never."""

    stale_after: float | None
    received: int = 0
    reported: int = 0
    age: float = float('nan')
    seen: float | None = None           # elapsed() at the last good message
    rejected: Counter = field(default_factory=Counter)
    rejected_reported: int = 0
    last_refusal: str = ''


class Health:
    """
    Collects counts and status values and publishes them on ``diagnostics`` once a second.

    An input that stops is an error; an input that has never come is not.
    """

    def __init__(self, node: FlightNode):
        self._node = node
        self.inputs: dict[str, Input] = {}
        self._compute: Distribution | None = None
        self._deadline = float('inf')
        self._misses = 0
        self._wall_max = 0.0
        self._extra = []
        self._publisher = wire.Publisher(node, 'diagnostics')
        node.create_timer(PERIOD, self._publish, clock=node.steady_clock)
        self._last = node.elapsed()

    def rejected(self, topic: str, reason: str, kind: str = '') -> None:
        """
        Count a refused message under ``kind``, or under its reason; log the first of a kind.

        Old stamps before the first accepted message are not logged.
        """
        entry, kind = self.inputs[topic], kind or reason
        if kind not in entry.rejected and (entry.received or 'stamp' not in kind):
            self._node.get_logger().warning(f'{topic}: message refused, {reason}')
        entry.rejected[kind] += 1
        entry.last_refusal = reason

    def track_compute(self, deadline: float) -> None:
        """Report compute times against a ``deadline`` [s] under '<node>: compute'."""
        self._compute, self._deadline = Distribution(), deadline

    def computed(self, cpu: float, wall: float) -> None:
        """Count one cycle: CPU time and wall time [s]."""
        self._compute.add(cpu)
        self._misses += cpu > self._deadline
        self._wall_max = max(self._wall_max, wall)

    def report(self, name: str, source) -> None:
        """Add a status '<node>: <name>'; ``source()`` returns (level, message, values)."""
        self._extra.append((name, source))

    def _publish(self):
        statuses = [('inputs', self._input_status)] if self.inputs else []
        if self._compute is not None:
            statuses.append(('compute', self._compute_status))
        statuses = [*statuses, *self._extra] or [('node', lambda: (OK, 'running', {}))]
        stamp, name = self._node.now(), self._node.get_name()
        found = [(part, *source()) for part, source in statuses]
        self._publisher.publish([Diagnostic(stamp, f'{name}: {part}', level, text, texts(values))
                                 for part, level, text, values in found])

    def _input_status(self):
        level, faults, values, now = OK, [], {}, self._node.elapsed()
        passed, self._last = max(now - self._last, 1e-9), now
        for topic, entry in self.inputs.items():
            count = entry.rejected.total()
            values |= {f'{topic} rate_hz': (entry.received - entry.reported) / passed,
                       f'{topic} age_ms': 1e3 * entry.age, f'{topic} received': entry.received,
                       f'{topic} rejected': count,
                       **{f'{topic} rejected: {why}': n for why, n in entry.rejected.items()}}
            if entry.seen is not None and entry.stale_after is not None \
                    and now - entry.seen > entry.stale_after:
                level = ERROR
                faults.append(f'{topic} silent for {now - entry.seen:.1f} s')
            if count > entry.rejected_reported:
                level = max(level, WARN)
                faults.append(f'{topic}: {count - entry.rejected_reported} rejected, '
                              f'{entry.last_refusal}')
            elif entry.seen is None and entry.stale_after is not None:
                faults.append(f'waiting for {topic}')
            entry.reported, entry.rejected_reported = entry.received, count
        return level, '; '.join(faults) or 'all arriving', values

    def _compute_status(self):
        return self._compute.status(
            f'{self._misses} deadline misses', WARN if self._misses else OK,
            deadline_misses=self._misses, wall_max_ms=1e3 * self._wall_max)


def texts(values: dict) -> dict[str, str]:
    """Return the values of a status as text, floats with six digits."""
    return {key: f'{value:.6g}' if isinstance(value, float) else str(value)
            for key, value in values.items()}
