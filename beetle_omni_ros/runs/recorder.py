"""
Collecting a flight while it happens.

:class:`LogRecorder` and :class:`~beetle_omni_ros.runs.bag.BagWriter` take the same
``write_*`` calls, so that a loop records into memory, onto disk, or both with
:class:`Tee`.
"""

from __future__ import annotations

from array import array

import numpy as np

from beetle_omni_ros.control.base import Target
from beetle_omni_ros.runs.log import Commands, COMPUTE_KEYS, Diagnostic, FlightLog, SERIES, WIDTHS


class LogRecorder:
    """
    Collects a :class:`FlightLog` from ``write_*`` calls; see there for units and frames.

    Attributes:
        keeps_covariances: whether ``write_odom`` does anything with them.

    """

    keeps_covariances = False

    def __init__(self, meta: dict | None = None):
        self._rows = {name: array('d') for name in SERIES}  # flat: hours of flight fit
        self._requests: dict[str, array] = {}
        self._log = FlightLog(meta=dict(meta or {}))
        self._states: list[tuple[float, str]] = []

    def _add(self, series, *row, rows=None):
        if len(row) != WIDTHS[series]:
            raise ValueError(f'{series}: expected {WIDTHS[series]} values, found {len(row)}')
        (self._rows[series] if rows is None else rows).extend(row)

    def write_meta(self, meta: dict) -> None:
        """Add to what is known of the flight: task, conditions, seed, robot, version."""
        self._log.meta.update(meta)

    def write_truth(self, t, position, quaternion, velocity, angular_velocity) -> None:
        """Simulated truth; velocity in world, angular velocity in base_link."""
        self._add('truth', t, *position, *quaternion, *velocity, *angular_velocity)

    def write_odom(self, t, position, quaternion, velocity, angular_velocity,
                   pose_covariance=None, twist_covariance=None) -> None:
        """Record an estimate; velocity in world, angular velocity in base_link."""
        self._add('odom', t, *position, *quaternion, *velocity, *angular_velocity)

    def write_imu(self, t, specific_force, angular_velocity) -> None:
        """One IMU sample in base_link."""
        self._add('imu', t, *specific_force, *angular_velocity)

    def write_mocap(self, t, position, quaternion, received=None) -> None:
        """One MoCap pose, captured at ``t``."""
        self._add('mocap', t, *position, *quaternion)

    def write_joints(self, t, position, velocity, effort=None, received=None) -> None:
        """One joint feedback, captured at ``t``."""
        effort = (np.nan,) * 4 if effort is None else effort
        self._add('joint', t, *position, *velocity, *effort)

    def write_battery(self, t, voltage, current) -> None:
        """Pack voltage [V] and current [A, negative when discharging]."""
        self._add('battery', t, voltage, current)

    def write_command(self, t, tilt, thrust, received=None) -> None:
        """Record the selected command; ``t`` is the stamp of the estimate that it answers."""
        self._add('command', t, t if received is None else received, *tilt, *thrust)

    def write_request(self, controller: str, t, tilt, thrust, received=None) -> None:
        """What one controller asked for, before the supervisor."""
        self._add('command', t, t if received is None else received, *tilt, *thrust,
                  rows=self._requests.setdefault(controller, array('d')))

    def write_wrench(self, t, force_world, torque_body) -> None:
        """External wrench from ``t`` until the next."""
        self._add('wrench', t, *force_world, *torque_body)

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
        self.keeps_covariances = any(recorder.keeps_covariances for recorder in recorders)

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
