"""
Recording of a flight.

:class:`LogRecorder` and :class:`~beetle_omni_ros.runs.bag.BagWriter` have the same interface, so
that a loop records into memory, onto disk, or both with :class:`Tee`.
"""

from array import array
from typing import Any

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.messages.topics import controller_of
from beetle_omni_ros.messages.values import Diagnostic
from beetle_omni_ros.runs.log import (
    Commands,
    COMPUTE_KEYS,
    COMPUTE_STATUS,
    FlightLog,
    RUN_STATUS,
    SERIES,
    SERIES_OF,
    WIDTHS,
)

CHANNELS = {series: tuple(channels.items()) for series, channels in SERIES.items()}


class Recorder:
    """
    Interface of recorders: :meth:`write` for every topic, and shorter calls for some.

    Attributes:
        keeps_covariances: whether the covariances of ``odom`` are recorded.

    """

    keeps_covariances = False

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """
        Record one value.

        Args:
            topic: name without namespace, see
                :func:`~beetle_omni_ros.messages.topics.topic_of`.
            value: value of the topic's class.
            received: time of recording [s]; default: the value's stamp. Required for text.

        """
        raise NotImplementedError

    def write_meta(self, meta: dict) -> None:
        """Add metadata of the flight: task, conditions, seed, robot, version."""
        raise NotImplementedError

    def write_target(self, target: Target, received=None) -> None:
        """Record a pose or trajectory target, valid from its stamp."""
        self.write('target_pose' if isinstance(target, PoseTarget) else 'target_trajectory',
                   target, received)

    def write_compute(self, t, controller: str, **times) -> None:
        """
        Record the CPU time of a controller's steps since its start, reported at ``t`` [s].

        ``times`` are median, p99, max [ms], deadline_misses, count.
        """
        self.write_diagnostic(t, f'{controller}_node: {COMPUTE_STATUS}',
                              {key: times[name] for key, name in COMPUTE_KEYS.items()})

    def write_diagnostic(self, t, name: str, values: dict, level: int = 0,
                         message: str = '') -> None:
        """Record one status such as 'ekf_node: estimator', with numbers or text as values."""
        self.write('diagnostics', [Diagnostic(t, name, int(level), message, {
            str(key): str(value) for key, value in values.items()})])


class LogRecorder(Recorder):
    """Collects a :class:`FlightLog`; see there for units and frames."""

    def __init__(self, meta: dict | None = None):
        self._rows = {name: array('d') for name in SERIES}  # flat: hours of flight fit
        self._requests: dict[str, array] = {}
        self._log = FlightLog(meta=dict(meta or {}))
        self._states: list[tuple[float, str]] = []

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Record one value; other topics than those of a log are ignored."""
        series = SERIES_OF.get(topic)
        if series:
            self._add(series, self._rows[series], value, received)
        elif controller_of(topic):
            rows = self._requests.setdefault(controller_of(topic), array('d'))
            self._add('command', rows, value, received)
        elif topic in ('target_pose', 'target_trajectory'):
            self._log.targets.append(value)
        elif topic == 'supervisor/state':
            self._states.append((received, value))
        elif topic == 'diagnostics':
            for entry in value:
                self._take(entry)

    def _add(self, series, rows, value, received):
        stamp = value.stamp
        if isinstance(stamp, np.ndarray) and stamp.ndim:
            self._add_all(series, rows, value, received)
            return
        row = [stamp]
        for channel, width in CHANNELS[series]:
            if not width:
                row.append(getattr(value, channel) if channel != 'received' else
                           stamp if received is None else received)
                continue
            part = getattr(value, channel)
            if isinstance(part, np.ndarray):
                row += part.tolist()    # floats are added faster than numpy's numbers
            else:
                row += [np.nan] * width if part is None else part
        if len(row) != WIDTHS[series]:
            raise ValueError(f'{series}: expected {WIDTHS[series]} values, found {len(row)}')
        rows.extend(row)

    def _add_all(self, series, rows, value, received):
        """Add a value whose fields are arrays over several messages."""
        count = len(value.stamp)
        parts = [value.stamp]
        for channel, width in SERIES[series].items():
            part = received if channel == 'received' else getattr(value, channel)
            parts.append(np.full((count, width), np.nan) if part is None else part)
        rows.frombytes(np.column_stack(parts).astype(float).tobytes())

    def write_meta(self, meta: dict) -> None:
        """Add metadata of the flight."""
        self._log.meta.update(meta)

    def _take(self, entry):
        values = entry.values
        node, _, kind = entry.name.rpartition(': ')
        if kind == RUN_STATUS:
            seed = values.get('seed', '')
            self.write_meta({**values, 'seed': int(seed)} if seed.isdigit() else values)
        elif kind == COMPUTE_STATUS and set(COMPUTE_KEYS) <= set(values):
            report = {name: int(values[key]) if name in ('deadline_misses', 'count')
                      else float(values[key]) for key, name in COMPUTE_KEYS.items()}
            name = node.rpartition('/')[2].removesuffix('_node')
            self._log.compute[name] = report
            self._log.compute_history.setdefault(name, []).append((entry.t, report))
        else:
            self._log.diagnostics.append(entry)

    def log(self) -> FlightLog:
        """Return the flight so far, each series sorted by time."""
        log = self._log
        for series, channels in SERIES.items():
            _unpack(log, series + '_', self._rows[series], channels, WIDTHS[series])
        log.requests = {name: _unpack(Commands(), '', rows, SERIES['command'], WIDTHS['command'])
                        for name, rows in self._requests.items()}
        log.targets = _in_order(log.targets)
        states = sorted(self._states, key=lambda entry: entry[0])
        log.state_t = np.array([t for t, _ in states], dtype=float)
        log.states = [state for _, state in states]
        log.diagnostics.sort(key=lambda entry: entry.t)
        return log


def _unpack(into, prefix, rows, channels, width):
    table = np.array(rows, dtype=float).reshape(-1, width)
    table = table[np.argsort(table[:, 0], kind='stable')]
    setattr(into, prefix + 't', table[:, 0].copy())
    column = 1
    for name, w in channels.items():
        values = table[:, column:column + w] if w else table[:, column]
        setattr(into, prefix + name, values.copy())
        column += max(1, w)
    return into


def _in_order(targets):
    """Sort by stamp; of several targets with the same stamp (latched topics), keep one."""
    kept: list[Target] = []
    for target in sorted(targets, key=lambda entry: entry.stamp):
        if kept and target.stamp == kept[-1].stamp and type(target) is type(kept[-1]):
            kept[-1] = target
        else:
            kept.append(target)
    return kept


class Tee(Recorder):
    """Records with several recorders."""

    def __init__(self, *recorders: Recorder):
        self._recorders = recorders
        self.keeps_covariances = any(recorder.keeps_covariances for recorder in recorders)

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Record one value."""
        for recorder in self._recorders:
            recorder.write(topic, value, received)

    def write_meta(self, meta: dict) -> None:
        """Add metadata of the flight."""
        for recorder in self._recorders:
            recorder.write_meta(meta)
