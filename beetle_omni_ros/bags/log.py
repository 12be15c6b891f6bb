"""
One flight as numpy arrays, its recording, and the motion and errors in it.

Times are float seconds on the flight's clock, ROS time in the graph. A loop records into memory
(:class:`LogRecorder`), onto disk (:class:`~beetle_omni_ros.bags.bag_writer.BagWriter`), or both
(:class:`Recorder`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from beetle_omni_ros.bags.messages import Diagnostic
from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.mode import FALLBACK, Mode

_BODY = {'position': 3, 'quaternion': 4, 'velocity': 3, 'angular_velocity': 3}
_COMMAND = {'tilt': 4, 'thrust': 4}
SERIES = {
    'truth': ('ground_truth/odom', _BODY),
    'odom': ('odom', _BODY),
    'imu': ('imu/data_raw', {'specific_force': 3, 'angular_velocity': 3}),
    'mocap': ('mocap/pose', {'position': 3, 'quaternion': 4}),
    'joint': ('joint_states', {'position': 4, 'velocity': 4, 'effort': 4}),
    'battery': ('battery_state', {'voltage': 0, 'current': 0}),
    'command': ('command', _COMMAND),
    'wrench': ('disturbance', {'force': 3, 'torque': 3}),
}
"""Series of a log -> its topic, and channel -> width, 0 for a scalar; each has `received`, too."""

CHANNELS = dict(SERIES.values())
"""Topic -> channels of its series."""

META_KEY = 'beetle_omni'    # a flight's metadata in custom_data of metadata.yaml
COMPUTE_STATUS = 'compute'  # diagnostic status '<name>_node: compute'
SUPERVISOR_STATUS, FAULT_KEY = 'supervisor_node: supervisor', 'fault.'
COMPUTE_KEYS = {'median_ms': 'median', 'p99_ms': 'p99', 'max_ms': 'max',
                'deadline_misses': 'deadline_misses', 'count': 'count'}
"""Diagnostic key -> key in ``FlightLog.compute``; the times are CPU milliseconds."""
# [s] tolerance of a window's edges. Stamps are integer nanoseconds in a bag and floats in memory,
# where UNIX time has a resolution of 0.24 us.
EDGE = 1e-5
TOGETHER = 1000     # values that a log converts to rows together
SAME_TIME = 2.5e-3  # [s] between stamps of an estimate and of the truth that are compared


class Series(SimpleNamespace):
    """
    Values of one topic in the order of their stamps.

    Attributes:
        t: (N,) stamps [s]; one array of N rows for each channel of SERIES stands beside it.
        received: (N,) times of recording [s].

    """

    t: np.ndarray
    received: np.ndarray

    def __len__(self):
        return len(self.t)

    def window(self, begin: float, end: float) -> slice:
        """Slice of the samples from ``begin`` to ``end`` [s], both included."""
        return slice(int(np.searchsorted(self.t, begin - EDGE, side='left')),
                     int(np.searchsorted(self.t, end + EDGE, side='right')))

    def covers(self, begin: float, end: float) -> bool:
        """Whether the first and last sample in the window are within 0.1 s of its edges."""
        times = self.t[self.window(begin, end)]
        return len(times) > 0 and times[0] <= begin + 0.1 and times[-1] >= end - 0.1


@dataclass
class FlightLog:
    """
    One flight. An absent topic is an empty series.

    Attributes:
        truth, odom: simulated truth and estimate: ``t`` (N,) [s], ``position`` (N, 3) in world
            [m], ``quaternion`` (N, 4) body to world (x, y, z, w), ``velocity`` (N, 3) in world
            [m/s], ``angular_velocity`` (N, 3) in base_link [rad/s].
        imu: ``specific_force`` (N, 3) [m/s^2], ``angular_velocity`` (N, 3) [rad/s].
        mocap: measured ``position`` and ``quaternion`` at the times of capture.
        joint: ``position``, ``velocity``, ``effort`` (N, 4) [rad], [rad/s], [N m]; NaN where the
            message had none.
        battery: ``voltage`` [V] and ``current`` [A], negative discharging (N,).
        command: commands to the actuators: ``t`` stamp of the answered estimate, ``tilt`` (M, 4)
            [rad], ``thrust`` (M, 4) [N].
        wrench: external ``force`` in world [N] and ``torque`` in base_link [N m], each valid until
            the next.
        requests: controller -> its commands, before the supervisor.
        targets: pose and trajectory targets in the order of their stamps.
        state_t, states: (S,) times and the supervisor's states.
        compute_history: controller, or another node's name without '_node' -> list of (t, report):
            median, p99, max [ms], deadline_misses, count (cumulative); ``compute`` has the newest.
        diagnostics: every other status, in the order of time.
        meta: task, conditions, seed, robot, version, if known.
        warnings: problems found while reading, one line each.
        source: folder or file of the bag, '' in memory.

    """

    truth: Series
    odom: Series
    imu: Series
    mocap: Series
    joint: Series
    battery: Series
    command: Series
    wrench: Series
    requests: dict[str, Series]
    targets: list[Target]
    state_t: np.ndarray
    states: list[Mode]
    compute_history: dict[str, list[tuple[float, dict]]]
    diagnostics: list[Diagnostic]
    meta: dict
    warnings: list[str] = field(default_factory=list)
    source: str = ''

    @property
    def begin(self) -> float:
        """Time of the first target [s]; without one, that of :attr:`start`."""
        return self.targets[0].stamp if self.targets else self.start

    @property
    def start(self) -> float:
        """Earliest time in any series [s]; 0 for an empty log."""
        return min((times[0] for times in self._times()), default=0.0)

    @property
    def end(self) -> float:
        """Latest time in any series [s]; 0 for an empty log."""
        return max((times[-1] for times in self._times()), default=0.0)

    def _times(self):
        return [times for times in (*(getattr(self, name).t for name in SERIES), self.state_t)
                if len(times)]

    @property
    def compute(self) -> dict[str, dict]:
        """Newest report of each entry of ``compute_history``."""
        return {name: reports[-1][1] for name, reports in self.compute_history.items()}

    def controllers(self) -> list[str]:
        """Return the names of the controllers that flew, in this order."""
        return list(dict.fromkeys(name for _, name in self.active_controller() if name))

    def named_faults(self) -> dict[str, float]:
        """Return the supervisor's fault names -> time of the first report [s], by time."""
        named: dict[str, float] = {}
        for t, state in zip(self.state_t, self.states, strict=True):
            if state.fault:
                named.setdefault(state.fault, float(t))
        for entry in self.diagnostics:
            if entry.name.endswith(SUPERVISOR_STATUS):
                for key in entry.values:
                    if key.startswith(FAULT_KEY):
                        name = key.removeprefix(FAULT_KEY)
                        named[name] = min(named.get(name, entry.t), entry.t)
        return dict(sorted(named.items(), key=lambda item: item[1]))

    def active_controller(self) -> list[tuple[float, str | None]]:
        """
        Return the changes of the active controller.

        Returns:
            (t, name) in the order of time; None while no controller flew (on the ground, during
            take-off and landing). A fallback counts for the controller that it replaced.

        """
        if not self.states:
            only = next(iter(self.requests)) if len(self.requests) == 1 else 'unknown'
            return [(self.start, self.meta.get('controller', only))]
        changes: list[tuple[float, str | None]] = []
        for t, state in zip(self.state_t, self.states, strict=True):
            active = state.controller or None
            if state.state == FALLBACK and changes:
                active = changes[-1][1]
            if not changes or changes[-1][1] != active:
                changes.append((float(t), active))
        return changes


class Recorder:
    """Interface of recorders; by itself it passes everything on to others."""

    _others: tuple[Recorder, ...] = ()

    def __init__(self, *others: Recorder):
        self._others = others

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """
        Record one value.

        Args:
            topic: name without namespace, see
                :func:`~beetle_omni_ros.bags.topics.topic_of`.
            value: value of the topic's class.
            received: time of recording [s]; default: the value's stamp. Required for text.

        """
        for other in self._others:
            other.write(topic, value, received)

    def write_meta(self, meta: dict) -> None:
        """Add metadata of the flight: task, conditions, seed, robot, version."""
        for other in self._others:
            other.write_meta(meta)

    def close(self) -> None:
        """End the recording."""
        for other in self._others:
            other.close()


class LogRecorder(Recorder):
    """Collects a :class:`FlightLog`; see there for units and frames."""

    def __init__(self, meta: dict | None = None):
        # topic -> its (N, W) rows of stamp and channels, and the values that are no rows yet
        self._rows: dict[str, list[np.ndarray]] = defaultdict(list)
        self._pending: dict[str, list] = defaultdict(list)
        self._targets: list[Target] = []
        self._states: list[tuple[float, Mode]] = []
        self._history: dict[str, list[tuple[float, dict]]] = defaultdict(list)
        self._diagnostics: list[Diagnostic] = []
        self._meta = dict(meta or {})

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Record one value; other topics than those of a log are ignored."""
        if channels_of(topic) is None:
            self._add_event(topic, value, received)
        else:
            pending = self._pending[topic]
            pending.append((value, value.stamp if received is None else received))
            if len(pending) == TOGETHER:
                self._add_rows(topic)

    def _add_rows(self, topic):
        """Convert the pending values of a topic together, which is faster."""
        values, received = zip(*self._pending.pop(topic), strict=True)
        columns = [[value.stamp for value in values]]
        for name, width in channels_of(topic).items():
            parts = [getattr(value, name) for value in values]
            columns.append([[np.nan] * width if part is None else part for part in parts])
        self.write_rows(topic, [*columns, received])

    def write_rows(self, topic: str, columns: Sequence) -> None:
        """Record N values of a topic: stamps, channels and times of recording, each N rows."""
        self._rows[topic].append(np.column_stack(columns).astype(float))

    def _add_event(self, topic, value, received):
        """Add a target, a state of the supervisor or diagnostics."""
        if topic in ('target_pose', 'target_trajectory'):
            self._targets.append(value)
        elif topic == 'supervisor/state':
            self._states.append((received, Mode(value)))
        elif topic == 'diagnostics':
            for entry in value:
                node, _, kind = entry.name.rpartition(': ')
                if kind == COMPUTE_STATUS and set(COMPUTE_KEYS) <= set(entry.values):
                    name = node.rpartition('/')[2].removesuffix('_node')
                    self._history[name].append((entry.t, {
                        key: (int if key in ('deadline_misses', 'count') else float)(
                            entry.values[given]) for given, key in COMPUTE_KEYS.items()}))
                else:
                    self._diagnostics.append(entry)

    def write_meta(self, meta: dict) -> None:
        """Add metadata of the flight."""
        self._meta.update(meta)

    def log(self) -> FlightLog:
        """Return the flight so far, each series sorted by time."""
        # A latched topic repeats its target: of equal stamps, the last one is kept.
        targets = list({(target.stamp, type(target)): target for target in sorted(
            self._targets, key=lambda target: target.stamp)}.values())
        states = sorted(self._states, key=lambda entry: entry[0])
        for topic in list(self._pending):
            self._add_rows(topic)
        return FlightLog(
            **{name: _series(self._rows.get(topic, ()), channels)
               for name, (topic, channels) in SERIES.items()},
            requests={topic.removesuffix('/command'): _series(rows, _COMMAND)
                      for topic, rows in self._rows.items() if topic not in CHANNELS},
            targets=targets, state_t=np.array([t for t, _ in states], dtype=float),
            states=[state for _, state in states], compute_history=dict(self._history),
            diagnostics=sorted(self._diagnostics, key=lambda entry: entry.t), meta=self._meta)


def channels_of(topic: str) -> dict[str, int] | None:
    """Return the channels of the series of a topic; None for events."""
    return CHANNELS.get(topic) or (_COMMAND if topic.endswith('/command') else None)


def _series(rows, channels):
    """Sort rows by time into 't' and the channels."""
    widths = {'t': 0, **channels, 'received': 0}
    ends = np.cumsum([max(1, width) for width in widths.values()])
    table = np.concatenate([np.zeros((0, ends[-1])), *rows])
    table = table[np.argsort(table[:, 0], kind='stable')]
    return Series(**{name: (table[:, end - width:end] if width else table[:, end - 1]).copy()
                     for (name, width), end in zip(widths.items(), ends, strict=True)})


def motion(log: FlightLog) -> Series:
    """Return the true motion if it was recorded, else the estimated one."""
    return log.truth if len(log.truth) else log.odom


def geodesic_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (N,) [rad] between the rotations of (N, 4) and (N, 4) or (4,) quaternions."""
    bx, by, bz, bw = np.asarray(b).T
    x, y, z, w = rotations.product(-bx, -by, -bz, bw, *np.asarray(a).T)
    return 2 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w))


def roll_pitch_yaw(quaternions: np.ndarray) -> np.ndarray:
    """(N, 3) roll, pitch, yaw [deg] of (N, 4) quaternions, R = Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z, w = np.asarray(quaternions).T
    return np.degrees(np.stack([
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], axis=1))


def errors(body: Series, target: Target, window: slice = slice(None)):
    """
    Compute the errors from a target over the samples of a window.

    Returns:
        (n,) position error [m] and (n,) orientation error [deg].

    """
    position, quaternion = reference_poses(target, body.t[window])
    return (np.linalg.norm(body.position[window] - position, axis=1),
            np.degrees(geodesic_angles(body.quaternion[window], quaternion)))


def spans(log: FlightLog) -> list[tuple[Target, float]]:
    """Return (target, its end [s]) of each target."""
    return list(zip(log.targets, [*(target.stamp for target in log.targets[1:]), log.end]))


def target_errors(log: FlightLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (n,) times [s] and the errors (n,) [m], (n,) [deg] from the newest target."""
    body, parts = motion(log), [np.zeros((3, 0))]
    for target, end in spans(log):
        window = body.window(target.stamp, end - 1e-3)
        parts.append(np.array([body.t[window], *errors(body, target, window)]))
    return tuple(np.concatenate(parts, axis=1))


def estimate_errors(log: FlightLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Compute the errors of the estimate from the truth, where their stamps agree within 2.5 ms.

    Returns:
        (n,) times [s], (n,) position errors [m], (n,) orientation errors [deg].

    """
    if not len(log.truth.t):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    index = np.clip(np.searchsorted(log.truth.t, log.odom.t - SAME_TIME), 0, len(log.truth.t) - 1)
    near = np.abs(log.truth.t[index] - log.odom.t) < SAME_TIME
    index = index[near]
    distance = np.linalg.norm(log.odom.position[near] - log.truth.position[index], axis=1)
    angle = np.degrees(geodesic_angles(log.odom.quaternion[near], log.truth.quaternion[index]))
    return log.odom.t[near], distance, angle


def reference_poses(target: Target, times: np.ndarray):
    """Return (n, 3) positions and (n, 4) quaternions of a target at ``times`` (n,) [s]."""
    if isinstance(target, PoseTarget):
        return [np.tile(part, (len(times), 1)) for part in (target.position, target.quaternion)]
    references = target.sample(times)
    return references.position, references.quaternion


def hold(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the latest values at the times ``at``; before the first sample, the first one."""
    index = np.searchsorted(times, at + EDGE, side='right') - 1
    return values[np.maximum(index, 0)]


def inside(times: np.ndarray, intervals: list[tuple[float, float]]) -> np.ndarray:
    """Return a mask of the times that are in one of the intervals."""
    return np.any([(times >= begin - EDGE) & (times <= end + EDGE) for begin, end in intervals]
                  or [np.zeros(len(times), dtype=bool)], axis=0)
