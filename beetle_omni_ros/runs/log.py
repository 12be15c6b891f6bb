"""
One flight as plain numpy arrays, and the recorder that collects it.

:class:`LogRecorder` and :class:`~beetle_omni_ros.runs.bag.BagWriter` take the same
``write_*`` calls, so that a loop records into memory, onto disk, or both. All times
are float seconds on the flight's own clock: ROS time in the graph, from 0 in the
in-process loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from beetle_omni_ros.control.base import Target

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
"""Series -> channel -> width; 0 is a scalar channel. Each has times ``<series>_t``."""

COMPUTE_KEYS = {'median_ms': 'median', 'p99_ms': 'p99', 'max_ms': 'max',
                'deadline_misses': 'deadline_misses', 'count': 'count'}
"""Diagnostic key -> key in ``FlightLog.compute``; the times are CPU milliseconds."""


def _empty(width):
    return field(default_factory=lambda: np.zeros((0, width) if width else 0))


@dataclass
class Commands:
    """Commands in time: t (M,) stamps [s], tilt (M, 4) [rad], thrust (M, 4) [N]."""

    t: np.ndarray = _empty(0)
    received: np.ndarray = _empty(0)
    tilt: np.ndarray = _empty(4)
    thrust: np.ndarray = _empty(4)


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic status: level 0 ok, 1 warning, 2 error, 3 stale; values as text."""

    t: float
    name: str
    level: int
    message: str
    values: dict[str, str]


@dataclass
class FlightLog:
    """
    One flight. Every series is sorted by its time; an absent topic is an empty array.

    Attributes:
        truth_t, truth_position, truth_quaternion, truth_velocity, truth_angular_velocity:
            simulated truth: (N,) [s], (N, 3) in world [m], (N, 4) body to world (x, y, z, w),
            (N, 3) in world [m/s], (N, 3) in base_link [rad/s].
        odom_t, odom_position, ...: the estimate, same channels.
        imu_t, imu_specific_force, imu_angular_velocity: (N,), (N, 3) [m/s^2], (N, 3) [rad/s].
        mocap_t, mocap_position, mocap_quaternion: measured poses at their capture times.
        joint_t, joint_position, joint_velocity, joint_effort: (N, 4) [rad], [rad/s], [N m];
            effort is NaN where the message had none.
        battery_t, battery_voltage, battery_current: (N,) [V], [A, negative discharging].
        command_t, command_received, command_tilt, command_thrust: what the actuators were
            told: stamp of the estimate answered, time of recording, (M, 4) [rad], (M, 4) [N].
        wrench_t, wrench_force, wrench_torque: external force in world [N] and torque in
            base_link [N m], each valid until the next.
        requests: controller -> what it asked for, before the supervisor.
        targets: pose and trajectory targets in the order of their stamps.
        state_t, states: (S,) times and names of the supervisor's states.
        compute: controller, or another node's name without '_node' -> median, p99, max [ms],
            deadline_misses, count (cumulative).
        compute_history: the same names -> list of (t, such a dict), one for each report.
        diagnostics: every status other than the above, in time order.
        meta: task, conditions, seed, robot, version, as far as known.
        warnings: what was wrong while reading, one line each.
        source: the folder or file it was read from, '' in memory.

    """

    truth_t: np.ndarray = _empty(0)
    truth_position: np.ndarray = _empty(3)
    truth_quaternion: np.ndarray = _empty(4)
    truth_velocity: np.ndarray = _empty(3)
    truth_angular_velocity: np.ndarray = _empty(3)
    odom_t: np.ndarray = _empty(0)
    odom_position: np.ndarray = _empty(3)
    odom_quaternion: np.ndarray = _empty(4)
    odom_velocity: np.ndarray = _empty(3)
    odom_angular_velocity: np.ndarray = _empty(3)
    imu_t: np.ndarray = _empty(0)
    imu_specific_force: np.ndarray = _empty(3)
    imu_angular_velocity: np.ndarray = _empty(3)
    mocap_t: np.ndarray = _empty(0)
    mocap_position: np.ndarray = _empty(3)
    mocap_quaternion: np.ndarray = _empty(4)
    joint_t: np.ndarray = _empty(0)
    joint_position: np.ndarray = _empty(4)
    joint_velocity: np.ndarray = _empty(4)
    joint_effort: np.ndarray = _empty(4)
    battery_t: np.ndarray = _empty(0)
    battery_voltage: np.ndarray = _empty(0)
    battery_current: np.ndarray = _empty(0)
    command_t: np.ndarray = _empty(0)
    command_received: np.ndarray = _empty(0)
    command_tilt: np.ndarray = _empty(4)
    command_thrust: np.ndarray = _empty(4)
    wrench_t: np.ndarray = _empty(0)
    wrench_force: np.ndarray = _empty(3)
    wrench_torque: np.ndarray = _empty(3)
    requests: dict[str, Commands] = field(default_factory=dict)
    targets: list[Target] = field(default_factory=list)
    state_t: np.ndarray = _empty(0)
    states: list[str] = field(default_factory=list)
    compute: dict[str, dict] = field(default_factory=dict)
    compute_history: dict[str, list] = field(default_factory=dict)
    diagnostics: list[Diagnostic] = field(default_factory=list)
    meta: dict = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    source: str = ''

    @property
    def body(self) -> str:
        """Which series metrics judge by: 'truth' where it was recorded, else 'odom'."""
        return 'truth' if len(self.truth_t) else 'odom'

    @property
    def start(self) -> float:
        """Earliest time in any series [s]; 0 for an empty log."""
        return min((times[0] for times in self._times()), default=0.0)

    @property
    def end(self) -> float:
        """Latest time in any series [s]; 0 for an empty log."""
        return max((times[-1] for times in self._times()), default=0.0)

    def _times(self):
        return [times for entry in fields(self) if entry.name.endswith('_t')
                and len(times := getattr(self, entry.name))]

    def controllers(self) -> list[str]:
        """Names of the controllers that flew, in the order in which they did."""
        names = [name for _, name in self.active_controller() if name]
        return list(dict.fromkeys(names))

    def active_controller(self) -> list[tuple[float, str | None]]:
        """
        Who flew when.

        Returns:
            (t, name) changes in time order; None where nobody flew a task (on the ground, in
            take-off and landing). A fallback counts for the controller that it replaced.

        """
        if not self.states:
            only = next(iter(self.requests)) if len(self.requests) == 1 else 'unknown'
            return [(self.start, self.meta.get('controller', only))]
        changes: list[tuple[float, str | None]] = []
        for t, state in zip(self.state_t, self.states, strict=True):
            if state.startswith('flying:'):
                name = state.partition(':')[2]
            elif state == 'fallback':
                name = changes[-1][1] if changes else None
            else:
                name = None
            if not changes or changes[-1][1] != name:
                changes.append((float(t), name))
        return changes


class LogRecorder:
    """Collects a :class:`FlightLog` from ``write_*`` calls; see there for units and frames."""

    def __init__(self, meta: dict | None = None):
        self._rows = {name: [] for name in SERIES}
        self._requests: dict[str, list] = {}
        self._log = FlightLog(meta=dict(meta or {}))
        self._states: list[tuple[float, str]] = []

    def write_meta(self, meta: dict) -> None:
        """Add to what is known of the flight: task, conditions, seed, robot, version."""
        self._log.meta.update(meta)

    def write_truth(self, t, position, quaternion, velocity, angular_velocity) -> None:
        """Simulated truth; velocity in world, angular velocity in base_link."""
        self._rows['truth'].append((t, *position, *quaternion, *velocity, *angular_velocity))

    def write_odom(self, t, position, quaternion, velocity, angular_velocity,
                   pose_covariance=None, twist_covariance=None) -> None:
        """Record an estimate; velocity in world, angular velocity in base_link."""
        self._rows['odom'].append((t, *position, *quaternion, *velocity, *angular_velocity))

    def write_imu(self, t, specific_force, angular_velocity) -> None:
        """One IMU sample in base_link."""
        self._rows['imu'].append((t, *specific_force, *angular_velocity))

    def write_mocap(self, t, position, quaternion, received=None) -> None:
        """One MoCap pose, captured at ``t``."""
        self._rows['mocap'].append((t, *position, *quaternion))

    def write_joints(self, t, position, velocity, effort=None, received=None) -> None:
        """One joint feedback, captured at ``t``."""
        effort = (np.nan,) * 4 if effort is None else effort
        self._rows['joint'].append((t, *position, *velocity, *effort))

    def write_battery(self, t, voltage, current) -> None:
        """Pack voltage [V] and current [A, negative when discharging]."""
        self._rows['battery'].append((t, voltage, current))

    def write_command(self, t, tilt, thrust, received=None) -> None:
        """Record the selected command; ``t`` is the stamp of the estimate that it answers."""
        self._rows['command'].append((t, t if received is None else received, *tilt, *thrust))

    def write_request(self, controller: str, t, tilt, thrust, received=None) -> None:
        """What one controller asked for, before the supervisor."""
        self._requests.setdefault(controller, []).append(
            (t, t if received is None else received, *tilt, *thrust))

    def write_wrench(self, t, force_world, torque_body) -> None:
        """External wrench from ``t`` until the next."""
        self._rows['wrench'].append((t, *force_world, *torque_body))

    def write_target(self, target: Target, received=None) -> None:
        """One pose or trajectory target, in force from its stamp."""
        self._log.targets.append(target)

    def write_state(self, t, state: str) -> None:
        """Record the supervisor's state, e.g. 'flying:nmpc', whenever it changes."""
        self._states.append((t, state))

    def write_compute(self, t, controller: str, **times) -> None:
        """
        CPU time of one controller's steps since its start; the last report counts.

        Args:
            t: time of the report [s].
            controller: name.
            times: median, p99, max [ms], deadline_misses, count.

        """
        report = {name: int(times[name]) if name in ('deadline_misses', 'count')
                  else float(times[name]) for name in COMPUTE_KEYS.values()}
        self._log.compute[controller] = report
        self._log.compute_history.setdefault(controller, []).append((t, report))

    def write_diagnostic(self, t, name: str, values: dict, level: int = 0,
                         message: str = '') -> None:
        """One status of one node: name 'ekf_node: estimator', values as numbers or text."""
        self._log.diagnostics.append(Diagnostic(
            t, name, int(level), message, {str(k): str(v) for k, v in values.items()}))

    def log(self) -> FlightLog:
        """Build the flight so far, each series sorted by time."""
        log = self._log
        for series, channels in SERIES.items():
            _unpack(log, series + '_', self._rows[series], channels)
        log.requests = {name: _unpack(Commands(), '', rows, SERIES['command'])
                        for name, rows in self._requests.items()}
        log.targets = _in_order(log.targets)
        states = sorted(self._states, key=lambda entry: entry[0])
        log.state_t = np.array([t for t, _ in states], dtype=float)
        log.states = [state for _, state in states]
        log.diagnostics.sort(key=lambda entry: entry.t)
        return log


def _unpack(into, prefix, rows, channels):
    width = 1 + sum(max(1, w) for w in channels.values())
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
    """Sort by stamp; a target received again, as latched topics do, is the same target."""
    kept: list[Target] = []
    for target in sorted(targets, key=lambda entry: entry.stamp):
        if kept and target.stamp == kept[-1].stamp and type(target) is type(kept[-1]):
            kept[-1] = target
        else:
            kept.append(target)
    return kept


class Tee:
    """Passes every ``write_*`` call on to several recorders."""

    def __init__(self, *recorders):
        self._recorders = recorders

    def __getattr__(self, name):
        """Look the method up in every recorder."""
        if not name.startswith('write_'):
            raise AttributeError(name)
        methods = [getattr(recorder, name) for recorder in self._recorders]

        def write(*args, **kwargs):
            for method in methods:
                method(*args, **kwargs)
        setattr(self, name, write)
        return write
