"""Diagnostics of one node: rates, ages, rejected messages, compute times, faults."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from beetle_omni_ros.messages.values import Diagnostic
from beetle_omni_ros.nodes import wire

OK, WARN, ERROR, STALE = range(4)   # of diagnostic_msgs/DiagnosticStatus
PERIOD = 1.0            # s between two diagnostics
REPEAT = 1.0            # s between two log lines about refusals of one kind
KINDS = 20              # kinds of refusals that are counted separately for each topic


class Distribution:
    """Quantiles of durations in constant memory: a histogram with 2 % wide bins."""

    LOW, RATIO, BINS = 1e-6, 1.02, 1000     # 1 us to 400 s

    def __init__(self):
        self.counts = np.zeros(self.BINS, dtype=np.int64)
        self.count, self.max = 0, 0.0

    def add(self, seconds: float) -> None:
        """Count one duration [s]."""
        k = int(np.log(max(seconds, self.LOW) / self.LOW) / np.log(self.RATIO))
        self.counts[min(k, self.BINS - 1)] += 1
        self.count += 1
        self.max = max(self.max, seconds)

    def quantile(self, fraction: float) -> float:
        """Return a quantile [s], accurate to 1 %; NaN if nothing was counted."""
        if not self.count:
            return float('nan')
        k = int(np.searchsorted(np.cumsum(self.counts), fraction * self.count))
        return min(self.LOW * self.RATIO ** (k + 0.5), self.max)

    def milliseconds(self, prefix: str = '') -> dict[str, float]:
        """Return median, 99th percentile and maximum [ms] under their keys in diagnostics."""
        return {f'{prefix}median_ms': 1e3 * self.quantile(0.5),
                f'{prefix}p99_ms': 1e3 * self.quantile(0.99), f'{prefix}max_ms': 1e3 * self.max}


@dataclass
class Input:
    """Counts of one subscribed topic."""

    stale_after: float | None
    received: int = 0
    reported: int = 0
    age: float = float('nan')
    seen: float | None = None           # elapsed() at the last good message
    rejected: Counter = field(default_factory=Counter)
    rejected_reported: int = 0
    last_refusal: str = ''
    logged: dict = field(default_factory=dict)      # kind -> elapsed() of its last line


class Health:
    """
    Collects counts and status values and publishes them on ``diagnostics`` once a second.

    An input that stops is an error; an input that has never come is not.
    """

    def __init__(self, node: Node):
        self._node = node
        self._inputs: dict[str, Input] = {}
        self._compute: Distribution | None = None
        self._deadline = float('inf')
        self._misses = 0
        self._wall_max = 0.0
        self._extra = []
        self._publisher = wire.Publisher(node, 'diagnostics')
        self._timer = node.create_timer(PERIOD, self._publish,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._last = node.elapsed()

    def watch(self, topic: str, stale_after: float | None) -> None:
        """Report ``topic``; silence of ``stale_after`` [s] after a message is an error."""
        self._inputs[topic] = Input(stale_after)

    def received(self, topic: str, age: float) -> None:
        """Count an accepted message whose stamp is ``age`` [s] old."""
        entry = self._inputs[topic]
        entry.received += 1
        entry.age = age
        first, entry.seen = entry.seen is None, self._node.elapsed()
        if first and entry.stale_after is not None and not self.waits_for():
            self._node.get_logger().info('all required inputs have arrived')

    def waits_for(self) -> list[str]:
        """Return the required topics without a message so far."""
        return [topic for topic, entry in self._inputs.items()
                if entry.seen is None and entry.stale_after is not None]

    def rejected(self, topic: str, reason: str, kind: str = '') -> None:
        """
        Count a refused message under ``kind``, or under its reason.

        The first message of a kind is logged, except old stamps before the first accepted message.
        If reasons differ within a kind, at most one a second is logged.
        """
        entry = self._inputs[topic]
        kind, detailed = kind or reason, bool(kind) and kind != reason
        if kind not in entry.rejected and len(entry.rejected) >= KINDS:
            kind, detailed = 'other reasons', True
        if self._is_news(entry, kind, detailed):
            self._node.get_logger().warning(f'{topic}: message refused, {reason}')
        entry.rejected[kind] += 1
        entry.last_refusal = reason if detailed else ''

    def _is_news(self, entry, kind, detailed):
        if not detailed:
            return kind not in entry.rejected and (entry.received or 'stamp' not in kind)
        now = self._node.elapsed()
        before = entry.logged.get(kind)
        if before is not None and 0 <= now - before < REPEAT:
            return False
        entry.logged[kind] = now
        return True

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
        now = self._node.elapsed()
        statuses = [self._input_status(now)] if self._inputs else []
        if self._compute is not None:
            statuses.append(self._compute_status())
        statuses += [self._status(name, *source()) for name, source in self._extra]
        self._last = now
        self._publisher.publish(statuses or [self._status('node', OK, 'running', {})])

    def _input_status(self, now):
        level, faults, values = OK, [], {}
        for topic, entry in self._inputs.items():
            passed = max(now - self._last, 1e-9)
            values[f'{topic} rate_hz'] = (entry.received - entry.reported) / passed
            values[f'{topic} age_ms'] = 1e3 * entry.age
            values[f'{topic} received'] = entry.received
            values[f'{topic} rejected'] = entry.rejected.total()
            for reason, count in entry.rejected.items():
                values[f'{topic} rejected: {reason}'] = count
            silent = entry.seen is not None and entry.stale_after is not None \
                and now - entry.seen > entry.stale_after
            if silent:
                level = ERROR
                faults.append(f'{topic} silent for {now - entry.seen:.1f} s')
            if entry.rejected.total() > entry.rejected_reported:
                level = max(level, WARN)
                new = entry.rejected.total() - entry.rejected_reported
                faults.append(f'{topic}: {new} rejected' + (
                    f', {entry.last_refusal}' if entry.last_refusal else ''))
            elif entry.seen is None and entry.stale_after is not None:
                faults.append(f'waiting for {topic}')
            entry.reported = entry.received
            entry.rejected_reported = entry.rejected.total()
        return self._status('inputs', level, '; '.join(faults) or 'all arriving', values)

    def _compute_status(self):
        times = self._compute
        values = {**times.milliseconds(), 'deadline_misses': self._misses,
                  'count': times.count, 'wall_max_ms': 1e3 * self._wall_max}
        level = WARN if self._misses else OK
        return self._status('compute', level, f'{self._misses} deadline misses', values)

    def _status(self, name, level, text, values):
        return Diagnostic(self._node.get_clock().now().nanoseconds * 1e-9,
                          f'{self._node.get_name()}: {name}', level, text, texts(values))


def texts(values: dict) -> dict[str, str]:
    """Return the values of a status as text, floats with six digits."""
    return {key: f'{value:.6g}' if isinstance(value, float) else str(value)
            for key, value in values.items()}
