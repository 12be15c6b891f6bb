"""
One flight as numpy arrays, its recording, and the motion and errors in it.

Times are float seconds on the flight's clock, ROS time in the graph. A loop records into memory
(:class:`LogRecorder`), onto disk (:class:`~beetle_omni_ros.bags.bag_writer.BagWriter`), or both
(:class:`Recorder`).
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np

from beetle_omni_ros.bags.values import Diagnostic
from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.mode import FALLBACK, Mode

SERIES = {
    'truth': {'position': 3, 'quaternion': 4, 'velocity': 3, 'angular_velocity': 3},
    'odom': {'position': 3, 'quaternion': 4, 'velocity': 3, 'angular_velocity': 3},
    'imu': {'specific_force': 3, 'angular_velocity': 3},
    'mocap': {'position': 3, 'quaternion': 4},
    'joint': {'position': 4, 'velocity': 4, 'effort': 4},
    'battery': {'voltage': 0, 'current': 0},
    'command': {'received': 0, 'tilt': 4, 'thrust': 4},
    'wrench': {'force': 3, 'torque': 3},
}
"""Series -> channel -> width; 0 is a scalar. A log has times ``<series>_t`` and each channel."""

SERIES_OF = {'ground_truth/odom': 'truth', 'odom': 'odom', 'imu/data_raw': 'imu',
             'mocap/pose': 'mocap', 'joint_states': 'joint', 'battery_state': 'battery',
             'command': 'command', 'disturbance': 'wrench'}
"""Topic -> series of its values."""

META_KEY = 'beetle_omni'    # a flight's metadata in custom_data of metadata.yaml
COMPUTE_STATUS = 'compute'  # diagnostic status '<name>_node: compute'
SUPERVISOR_STATUS, FAULT_KEY = 'supervisor_node: supervisor', 'fault.'
COMPUTE_KEYS = {'median_ms': 'median', 'p99_ms': 'p99', 'max_ms': 'max',
                'deadline_misses': 'deadline_misses', 'count': 'count'}
"""Diagnostic key -> key in ``FlightLog.compute``; the times are CPU milliseconds."""
# [s] tolerance of a window's edges. Stamps are integer nanoseconds in a bag and floats in memory,
# where UNIX time has a resolution of 0.24 us.
EDGE = 1e-5
SAME_TIME = 2.5e-3  # [s] between stamps of an estimate and of the truth that are compared


@dataclass
class Commands:
    """Commands: t (M,) stamps [s], received (M,) [s], tilt (M, 4) [rad], thrust (M, 4) [N]."""

    t: np.ndarray
    received: np.ndarray
    tilt: np.ndarray
    thrust: np.ndarray


@dataclass
class FlightLog:
    """
    One flight. Every series is sorted by its time; an absent topic is an empty array.

    Attributes:
        truth_t, truth_position, truth_quaternion, truth_velocity, truth_angular_velocity:
            simulated truth: (N,) [s], (N, 3) in world [m], (N, 4) body to world (x, y, z, w),
            (N, 3) in world [m/s], (N, 3) in base_link [rad/s].
        odom_t, odom_position, odom_quaternion, odom_velocity, odom_angular_velocity: the estimate,
            same channels.
        imu_t, imu_specific_force, imu_angular_velocity: (N,), (N, 3) [m/s^2], (N, 3) [rad/s].
        mocap_t, mocap_position, mocap_quaternion: measured poses at their capture times.
        joint_t, joint_position, joint_velocity, joint_effort: (N, 4) [rad], [rad/s], [N m];
            effort is NaN where the message had none.
        battery_t, battery_voltage, battery_current: (N,) [V], [A, negative discharging].
        command_t, command_received, command_tilt, command_thrust: commands to the actuators:
            stamp of the answered estimate, time of recording, (M, 4) [rad], (M, 4) [N].
        wrench_t, wrench_force, wrench_torque: external force in world [N] and torque in
            base_link [N m], each valid until the next.
        requests: controller -> its commands, before the supervisor.
        targets: pose and trajectory targets in the order of their stamps.
        state_t, states: (S,) times and the supervisor's states.
        compute: controller, or another node's name without '_node' -> median, p99, max [ms],
            deadline_misses, count (cumulative).
        compute_history: the same names -> list of (t, such a dict), one for each report.
        diagnostics: every other status, in the order of time.
        meta: task, conditions, seed, robot, version, if known.
        warnings: problems found while reading, one line each.
        source: folder or file of the bag, '' in memory.

    """

    requests: dict[str, Commands] = field(default_factory=dict)
    targets: list[Target] = field(default_factory=list)
    state_t: np.ndarray = field(init=False)
    states: list[Mode] = field(default_factory=list)
    compute: dict[str, dict] = field(default_factory=dict)
    compute_history: dict[str, list] = field(default_factory=dict)
    diagnostics: list[Diagnostic] = field(default_factory=list)
    meta: dict = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    source: str = ''

    if TYPE_CHECKING:
        def __getattr__(self, name: str) -> np.ndarray:
            """Return a channel of SERIES."""

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
        return [times for series in (*SERIES, 'state')
                if len(times := getattr(self, f'{series}_t'))]

    def controllers(self) -> list[str]:
        """Return the names of the controllers that flew, in this order."""
        names = [name for _, name in self.active_controller() if name]
        return list(dict.fromkeys(names))

    def named_faults(self) -> dict[str, float]:
        """Return the supervisor's fault names -> time of the first report [s], by time."""
        found: dict[str, float] = {}
        for t, state in zip(self.state_t, self.states, strict=True):
            if state.fault:
                found.setdefault(state.fault, float(t))
        for entry in self.diagnostics:
            if entry.name.endswith(SUPERVISOR_STATUS):
                for key in entry.values:
                    if key.startswith(FAULT_KEY):
                        name = key.removeprefix(FAULT_KEY)
                        found[name] = min(found.get(name, entry.t), entry.t)
        return dict(sorted(found.items(), key=lambda item: item[1]))

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


class LogRecorder(Recorder):
    """Collects a :class:`FlightLog`; see there for units and frames."""

    def __init__(self, meta: dict | None = None):
        # topic -> flat rows: hours of flight fit
        self._rows: dict[str, array] = defaultdict(partial(array, 'd'))
        self._log = FlightLog(meta=dict(meta or {}))
        self._states: list[tuple[float, Mode]] = []

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Record one value; other topics than those of a log are ignored."""
        series = SERIES_OF.get(topic) or ('command' if topic.endswith('/command') else '')
        if not series:
            self._add_event(topic, value, received)
            return
        rows, stamp = self._rows[topic], value.stamp
        parts = [((stamp if received is None else received) if channel == 'received' else
                  getattr(value, channel), width) for channel, width in SERIES[series].items()]
        if isinstance(stamp, np.ndarray):       # the fields are arrays over several messages
            rows.frombytes(np.column_stack([stamp, *(
                np.full((len(stamp), width), np.nan) if part is None else part
                for part, width in parts)]).astype(float).tobytes())
            return
        row = [stamp]
        for part, width in parts:
            if not width:
                row.append(part)
            elif isinstance(part, np.ndarray):
                row += part.tolist()    # floats are added faster than numpy's numbers
            else:
                row += [np.nan] * width if part is None else part
        rows.fromlist(row)

    def _add_event(self, topic, value, received):
        """Add a target, a state of the supervisor or diagnostics."""
        if topic in ('target_pose', 'target_trajectory'):
            self._log.targets.append(value)
        elif topic == 'supervisor/state':
            self._states.append((received, Mode(value)))
        elif topic == 'diagnostics':
            for entry in value:
                node, _, kind = entry.name.rpartition(': ')
                if kind != COMPUTE_STATUS or not set(COMPUTE_KEYS) <= set(entry.values):
                    self._log.diagnostics.append(entry)
                    continue
                report = {key: int(entry.values[name]) if key in ('deadline_misses', 'count')
                          else float(entry.values[name]) for name, key in COMPUTE_KEYS.items()}
                name = node.rpartition('/')[2].removesuffix('_node')
                self._log.compute[name] = report
                self._log.compute_history.setdefault(name, []).append((entry.t, report))

    def write_meta(self, meta: dict) -> None:
        """Add metadata of the flight."""
        self._log.meta.update(meta)

    def log(self) -> FlightLog:
        """Return the flight so far, each series sorted by time."""
        log = self._log
        for topic, series in SERIES_OF.items():
            for name, values in _columns(self._rows.get(topic, ()), SERIES[series]).items():
                setattr(log, f'{series}_{name}', values)
        log.requests = {
            topic.removesuffix('/command'): Commands(**_columns(rows, SERIES['command']))
            for topic, rows in self._rows.items() if topic not in SERIES_OF}
        # A latched topic repeats its target: of equal stamps, the last one is kept.
        log.targets = list({(target.stamp, type(target)): target for target in sorted(
            log.targets, key=lambda target: target.stamp)}.values())
        states = sorted(self._states, key=lambda entry: entry[0])
        log.state_t = np.array([t for t, _ in states], dtype=float)
        log.states = [state for _, state in states]
        log.diagnostics.sort(key=lambda entry: entry.t)
        return log


def _columns(rows, channels):
    """'t' and the channels of flat rows, sorted by time."""
    widths = {'t': 0, **channels}
    ends = np.cumsum([max(1, width) for width in widths.values()])
    table = np.array(rows, dtype=float).reshape(-1, ends[-1])
    table = table[np.argsort(table[:, 0], kind='stable')]
    return {name: (table[:, end - width:end] if width else table[:, end - 1]).copy()
            for (name, width), end in zip(widths.items(), ends, strict=True)}


@dataclass(frozen=True)
class Motion:
    """
    Motion of a body.

    Attributes:
        t: (N,) [s].
        position: (N, 3) in world [m].
        quaternion: (N, 4) body to world (x, y, z, w).
        velocity: (N, 3) in world [m/s].
        angular_velocity: (N, 3) in base_link [rad/s].

    """

    t: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray

    def window(self, begin: float, end: float) -> slice:
        """Slice of the samples from ``begin`` to ``end`` [s], both included."""
        return slice(int(np.searchsorted(self.t, begin - EDGE, side='left')),
                     int(np.searchsorted(self.t, end + EDGE, side='right')))

    def covers(self, begin: float, end: float, gap: float = 0.1) -> bool:
        """Whether the first and last sample in the window are within ``gap`` [s] of its edges."""
        times = self.t[self.window(begin, end)]
        return len(times) > 0 and times[0] <= begin + gap and times[-1] >= end - gap


def motion(log: FlightLog) -> Motion:
    """Return the true motion if it was recorded, else the estimated one."""
    name = 'truth' if len(log.truth_t) else 'odom'
    return Motion(*(getattr(log, f'{name}_{channel}') for channel in
                    ('t', 'position', 'quaternion', 'velocity', 'angular_velocity')))


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


def errors(body: Motion, target: Target, window: slice = slice(None)):
    """
    Compute the errors from a target over the samples of a window.

    Returns:
        (n,) position error [m] and (n,) orientation error [deg].

    """
    position, quaternion = reference_poses(target, body.t[window])
    return (np.linalg.norm(body.position[window] - position, axis=1),
            np.degrees(geodesic_angles(body.quaternion[window], quaternion)))


def estimate_errors(log: FlightLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Compute the errors of the estimate from the truth, where their stamps agree within 2.5 ms.

    Returns:
        (n,) times [s], (n,) position errors [m], (n,) orientation errors [deg].

    """
    if not len(log.truth_t):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    index = np.clip(np.searchsorted(log.truth_t, log.odom_t - SAME_TIME), 0, len(log.truth_t) - 1)
    near = np.abs(log.truth_t[index] - log.odom_t) < SAME_TIME
    index = index[near]
    distance = np.linalg.norm(log.odom_position[near] - log.truth_position[index], axis=1)
    angle = np.degrees(geodesic_angles(log.odom_quaternion[near], log.truth_quaternion[index]))
    return log.odom_t[near], distance, angle


def reference_poses(target: Target, times: np.ndarray):
    """Return (n, 3) positions and (n, 4) quaternions of a target at ``times`` (n,) [s]."""
    if isinstance(target, PoseTarget):
        return np.tile(target.position, (len(times), 1)), np.tile(target.quaternion,
                                                                  (len(times), 1))
    references = target.sample(times)
    return references.position, references.quaternion


def hold(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the latest values at the times ``at``; before the first sample, the first one."""
    index = np.searchsorted(times, at + EDGE, side='right') - 1
    return values[np.maximum(index, 0)]


def inside(times: np.ndarray, intervals: list[tuple[float, float]]) -> np.ndarray:
    """Return a mask of the times that are in one of the intervals."""
    mask = np.zeros(len(times), dtype=bool)
    for begin, end in intervals:
        mask |= (times >= begin - EDGE) & (times <= end + EDGE)
    return mask
