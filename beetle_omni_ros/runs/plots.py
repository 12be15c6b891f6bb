"""Figures over time: pose, errors, commands, compute, estimate, battery."""

from __future__ import annotations

from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.runs.body import errors, geodesic_angles, reference_poses, roll_pitch_yaw
from beetle_omni_ros.runs.figures import (
    FAINT,
    INK,
    legend,
    line,
    panels,
    PARTS,
    Run,
    thinned,
    without_jumps,
)
from beetle_omni_ros.runs.metrics import L_WINDOW, U_WINDOW
from beetle_omni_ros.runs.tasks import POSE_DURATION

FEW_POSES = 20  # up to so many, the windows of each are shaded
MILLI = 1e3
TINY = {'m': 1e-4, 'deg': 1e-2}  # floor of logarithmic errors


def pose(runs: list[Run]) -> Figure:
    """Position and attitude of every run against its target."""
    figure, axes = panels(6, height=1.15, sharex=True)
    labels = ('x [m]', 'y [m]', 'z [m]', 'roll [deg]', 'pitch [deg]', 'yaw [deg]')
    for k, run in enumerate(runs):
        body = run.body
        target_t, target = _targets(run)
        angles = roll_pitch_yaw(body.quaternion)
        for row, panel in enumerate(axes[:, 0]):
            if k == 0 or run.log.meta.get('task') != runs[0].log.meta.get('task'):
                panel.plot(target_t, target[:, row], color=INK, lw=0.9, ls=(0, (3, 2)),
                           label='target' if k == 0 else None)
            values = body.position[:, row] if row < 3 else without_jumps(angles[:, row - 3])
            line(panel, body.t - run.start, values, color=run.colour, label=run.label)
    for panel, label in zip(axes[:, 0], labels, strict=True):
        panel.set_ylabel(label)
    axes[-1, 0].set_xlabel('time since the first target [s]')
    legend(figure, axes[0, 0])
    return figure


def _targets(run):
    """Steps of pose targets, curves of trajectories; (n,) times, (n, 6) with angles in deg."""
    times, values = [], []
    for target, end in run.pursued:
        t = np.array([target.stamp, end]) if isinstance(target, PoseTarget) else target.times[::5]
        position, quaternion = reference_poses(target, t)
        times.append(t - run.start)
        angles = np.stack([without_jumps(a) for a in roll_pitch_yaw(quaternion).T], axis=1)
        values.append(np.hstack([position, angles]))
    if not times:
        return np.zeros(0), np.zeros((0, 6))
    return np.concatenate(times), np.concatenate(values)


def error_series(run: Run):
    """(n,) times since the start, (n,) position errors [m], (n,) orientation errors [deg]."""
    body, parts = run.body, []
    for target, end in run.pursued:
        window = body.window(target.stamp, end - 1e-3)
        if body.t[window].size:
            parts.append((body.t[window] - run.start, *errors(body, target, window)))
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def errors_over_time(runs: list[Run]) -> Figure | None:
    """Both errors on a logarithmic scale; L and U windows shaded where they are few."""
    series = [(run, error_series(run)) for run in runs]
    if not any(len(t) for _, (t, _, _) in series):
        return None
    figure, axes = panels(2, height=2.0, sharex=True)
    for run, (t, position, orientation) in series:
        for panel, values, unit in ((axes[0, 0], position, 'm'), (axes[1, 0], orientation, 'deg')):
            line(panel, t, np.maximum(values, TINY[unit]), color=run.colour, label=run.label)
    for panel, label in ((axes[0, 0], 'position error [m]'),
                         (axes[1, 0], 'orientation error [deg]')):
        panel.set_yscale('log')
        panel.set_ylabel(label)
    first = [t.stamp - runs[0].start for t in runs[0].log.targets if isinstance(t, PoseTarget)]
    if 0 < len(first) <= FEW_POSES:
        for panel in axes[:, 0]:
            _shade(panel, first)
    axes[1, 0].set_xlabel('time since the first target [s]')
    legend(figure, axes[0, 0])
    return figure


def _shade(panel, stamps):
    for k, stamp in enumerate(stamps):
        for window, colour, name in ((L_WINDOW, '#eef1f5', 'L window'),
                                     (U_WINDOW, '#cfe3d4', 'U window')):
            panel.axvspan(stamp + window[0], stamp + window[1], color=colour, lw=0, zorder=0,
                          label=name if k == 0 else None)


def errors_of_a_pose(runs: list[Run]) -> Figure | None:
    """Errors in the 8 s of a pose: median and 10 to 90 % band over all poses of a run."""
    figure, axes = panels(1, 2, height=2.7)
    grid = np.arange(0.0, POSE_DURATION, 0.02)
    drawn = False
    for run in runs:
        folded = _folded(run, grid)
        if folded is None:
            continue
        drawn = True
        for panel, stack, unit in zip(axes[0], folded, ('m', 'deg'), strict=True):
            low, middle, high = np.maximum(np.percentile(stack, (10, 50, 90), axis=0), TINY[unit])
            panel.fill_between(grid, low, high, color=run.colour, alpha=0.15, lw=0)
            panel.plot(grid, middle, color=run.colour, label=run.label, lw=1.6)
    if not drawn:
        return None
    for panel, title in zip(axes[0], ('position error [m]', 'orientation error [deg]'),
                            strict=True):
        panel.set_yscale('log')
        panel.set_title(title)
        panel.set_xlabel('time since the pose was asked for [s]')
        _shade(panel, [0.0])
    legend(figure, axes[0, 0])
    return figure


def _folded(run, grid):
    body, stacks = run.body, ([], [])
    for target in run.log.targets:
        if not isinstance(target, PoseTarget) or \
                not body.covers(target.stamp, target.stamp + U_WINDOW[1]):
            continue
        window = body.window(target.stamp, target.stamp + POSE_DURATION)
        for stack, values in zip(stacks, errors(body, target, window), strict=True):
            stack.append(np.interp(grid, body.t[window] - target.stamp, values))
    return [np.array(stack) for stack in stacks] if len(stacks[0]) >= 3 else None


def commands(runs: list[Run]) -> Figure:
    """Tilt and thrust commands, a column for each run."""
    figure, axes = panels(2, len(runs), height=1.8, sharex='col', sharey='row')
    for column, run in enumerate(runs):
        log = run.log
        for row, values in enumerate((log.command_tilt, log.command_thrust)):
            for k in range(4):
                line(axes[row, column], log.command_t - run.start, values[:, k], color=PARTS[k],
                     lw=0.9, label=f'{k + 1}' if row == column == 0 else None)
        axes[0, column].set_title(run.label, color=run.colour)
        axes[1, column].set_xlabel('time since the first target [s]')
    axes[0, 0].set_ylabel('tilt command [rad]')
    axes[1, 0].set_ylabel('thrust command [N]')
    legend(figure, axes[0, 0])
    return figure


def compute(runs: list[Run], period_ms: float = 10.0) -> Figure | None:
    """CPU time of the controllers' steps since their start, against the period."""
    figure, axes = panels(1, height=2.4)
    panel, drawn = axes[0, 0], False
    for run in runs:
        for label, name in _controllers(run):
            history = run.log.compute_history[name]
            t = np.array([entry[0] for entry in history]) - run.start
            drawn = True
            for key, style in (('max', ':'), ('p99', '--'), ('median', '-')):
                values = np.array([entry[1][key] for entry in history])
                panel.plot(*thinned(t, values), color=run.colour, ls=style, lw=1.3,
                           label=f'{label}, {key}')
    if not drawn:
        return None
    panel.axhline(period_ms, color=FAINT, lw=1)
    panel.text(1, period_ms, 'period ', ha='right', va='bottom', color=FAINT, fontsize=8,
               transform=panel.get_yaxis_transform())
    panel.set_yscale('log')
    panel.set_ylabel('CPU time of a step [ms]')
    panel.set_xlabel('time since the first target [s]')
    legend(figure, panel)
    return figure


def _controllers(run):
    """(label, name) of each controller of a run whose compute times are known."""
    names = [name for name in run.log.controllers() if run.log.compute_history.get(name)]
    return [(run.label if len(names) == 1 else f'{run.label}: {name}', name) for name in names]


def estimate(runs: list[Run]) -> Figure | None:
    """Error of the estimate, where the truth is known."""
    runs = [run for run in runs if len(run.log.truth_t) and len(run.log.odom_t)]
    if not runs:
        return None
    figure, axes = panels(2, height=1.7, sharex=True)
    for run in runs:
        log = run.log
        index = np.clip(np.searchsorted(log.truth_t, log.odom_t - 2.5e-3), 0,
                        len(log.truth_t) - 1)
        near = np.abs(log.truth_t[index] - log.odom_t) < 2.5e-3
        t, index = log.odom_t[near] - run.start, index[near]
        distance = np.linalg.norm(log.odom_position[near] - log.truth_position[index], axis=1)
        angle = np.degrees(geodesic_angles(log.odom_quaternion[near], log.truth_quaternion[index]))
        line(axes[0, 0], t, MILLI * distance, color=run.colour, label=run.label, lw=0.9)
        line(axes[1, 0], t, angle, color=run.colour, lw=0.9)
    axes[0, 0].set_ylabel('position [mm]')
    axes[1, 0].set_ylabel('orientation [deg]')
    axes[1, 0].set_xlabel('time since the first target [s]')
    legend(figure, axes[0, 0])
    return figure


def battery(runs: list[Run]) -> Figure | None:
    """Pack voltage and current."""
    runs = [run for run in runs if len(run.log.battery_t)]
    if not runs:
        return None
    figure, axes = panels(1, 2, height=2.0)
    for run in runs:
        t = run.log.battery_t - run.start
        line(axes[0, 0], t, run.log.battery_voltage, color=run.colour, label=run.label)
        line(axes[0, 1], t, -run.log.battery_current, color=run.colour)
    axes[0, 0].set_title('voltage [V]')
    axes[0, 1].set_title('current drawn [A]')
    for panel in axes[0]:
        panel.set_xlabel('time since the first target [s]')
    legend(figure, axes[0, 0])
    return figure
