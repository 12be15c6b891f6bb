"""Figures that sum a flight up: errors of all poses, use of joints and rotors, task specials."""

from __future__ import annotations

from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.body import hold, inside
from beetle_omni_ros.runs.figures import FAINT, INK, legend, line, panels, Run
from beetle_omni_ros.runs.metrics import REACHED_ORIENTATION, REACHED_POSITION

ABSURD, TINY = 1e6, 1e-9    # [rad, rad/s, N] what no actuator does; ranges that cannot be divided


def steady_errors(runs: list[Run]) -> Figure | None:
    """Share of the poses whose U error is below a value."""
    figure, axes = panels(1, 2, height=2.5)
    drawn = False
    for run in runs:
        for label, result in run.results.items():
            for panel, key in zip(axes[0], ('U_position_m', 'U_orientation_deg'), strict=True):
                values = np.sort([p[key] for p in result['poses'] if p[key] is not None])
                if len(values) < 3:
                    continue
                drawn = True
                share = np.arange(1, len(values) + 1) / len(result['poses'])
                panel.step(np.concatenate([values[:1], values]), np.concatenate([[0], share]),
                           where='post', color=run.colour, label=label, lw=1.6)
    if not drawn:
        return None
    for panel, limit, title in zip(
            axes[0], (REACHED_POSITION, REACHED_ORIENTATION),
            ('U position error [m]', 'U orientation error [deg]'), strict=True):
        panel.axvline(limit, color=FAINT, lw=1, ls=(0, (3, 2)))
        panel.text(limit, 0.02, ' reached below', color=FAINT, fontsize=8, ha='left', va='bottom')
        panel.set_xscale('log')
        panel.set_ylim(0, 1.02)
        panel.set_title(title)
        panel.set_ylabel('share of the poses')
    legend(figure, axes[0, 0])
    return figure


def use(runs: list[Run], robot: RobotParameters) -> Figure:
    """Histograms of what joints and rotors were asked for and gave, with their limits."""
    figure, axes = panels(2, 2, height=2.1)
    joints, rotors = robot.joints, robot.rotors
    used = [_used(run) for run in runs]
    for panel, column in zip(axes.ravel(), zip(*used, strict=True), strict=True):
        _histograms(panel, runs, column)
    limits = ((-joints.position_limit, joints.position_limit),
              (-joints.velocity_limit, joints.velocity_limit),
              (rotors.thrust_min, rotors.thrust_max), ())
    titles = ('tilt angle [rad]', 'tilt rate [rad/s]', 'thrust command [N]', '|q* - q| [rad]')
    for panel, limit, title in zip(axes.ravel(), limits, titles, strict=True):
        for value in limit:
            panel.axvline(value, color=INK, lw=1, ls=(0, (3, 2)))
        panel.set_yscale('log')
        panel.set_title(title)
        panel.set_ylabel('share of the time')
    legend(figure, axes[0, 0])
    return figure


def _used(run):
    log = run.log
    flown = [(run.start, log.end)]
    joint, command = inside(log.joint_t, flown), inside(log.command_t, flown)
    error = np.zeros(0)
    if np.any(joint) and len(log.command_t):
        error = np.abs(hold(log.command_t, log.command_tilt, log.joint_t[joint])
                       - log.joint_position[joint])
    return (log.joint_position[joint].ravel(), log.joint_velocity[joint].ravel(),
            log.command_thrust[command].ravel(), error.ravel())


def _histograms(panel, runs, columns):
    """All runs in the same bins, so that their shares compare."""
    columns = [values[np.abs(values) < ABSURD] for values in columns]
    every = np.concatenate(columns)
    if not every.size:
        return
    low, high = every.min(), every.max()
    spare = 0.5 if high - low < TINY else 0.0
    edges = np.linspace(low - spare, high + spare, 61)
    for run, values in zip(runs, columns, strict=True):
        share = np.histogram(values, bins=edges)[0] / max(1, values.size)
        panel.stairs(share, edges, color=run.colour, lw=1.3, label=run.label)
        panel.stairs(share, edges, color=run.colour, alpha=0.12, fill=True)


def path(runs: list[Run]) -> Figure | None:
    """Trajectories from above and from the side."""
    pairs = [(run, next((t for t in run.log.targets if isinstance(t, TrajectoryTarget)), None))
             for run in runs]
    pairs = [(run, target) for run, target in pairs if target is not None]
    if not pairs:
        return None
    figure, axes = panels(1, 2, height=3.4)
    for k, (run, target) in enumerate(pairs):
        body = run.body
        window = body.window(target.times[0], target.times[-1])
        for panel, column in ((axes[0, 0], 1), (axes[0, 1], 2)):
            if k == 0:
                panel.plot(target.positions[:, 0], target.positions[:, column], color=INK, lw=0.9,
                           ls=(0, (3, 2)), label='target')
            panel.plot(body.position[window][::4, 0], body.position[window][::4, column],
                       color=run.colour, lw=1, label=run.label)
            panel.set_aspect('equal', adjustable='datalim')
            panel.set_xlabel('x [m]')
    axes[0, 0].set_ylabel('y [m]')
    axes[0, 1].set_ylabel('z [m]')
    legend(figure, axes[0, 0])
    return figure


def disturbance(runs: list[Run]) -> Figure | None:
    """Peak errors against the disturbance, for force and torque tasks."""
    kinds = [kind for kind in ('force', 'torque')
             if any(kind in result for run in runs for result in run.results.values())]
    if not kinds:
        return None
    figure, axes = panels(len(kinds), 2, height=2.3)
    for row, (kind, unit) in enumerate((kind, 'N' if kind == 'force' else 'N_m')
                                       for kind in kinds):
        for run in runs:
            for label, result in run.results.items():
                levels = result.get(kind, {}).get('levels')
                if not levels:
                    continue
                for panel, key in zip(axes[row], ('peak_position_m', 'peak_orientation_deg'),
                                      strict=True):
                    x = [entry[f'level_{unit}'] for entry in levels]
                    panel.plot(x, [entry[key] for entry in levels], 'o-', ms=3.5,
                               color=run.colour, label=label)
                    lost = [entry for entry in levels if entry['lost']]
                    panel.plot([e[f'level_{unit}'] for e in lost], [e[key] for e in lost], 'x',
                               ms=9, mew=2, color=run.colour)
        for panel, title in zip(axes[row], ('peak position error [m]',
                                            'peak orientation error [deg]'), strict=True):
            panel.set_title(title)
            panel.set_xlabel(f"{kind} [{unit.replace('_', ' ')}]; × control lost")
    legend(figure, axes[0, 0])
    return figure


def payload(runs: list[Run]) -> Figure | None:
    """Height over time while payloads are attached."""
    runs = [run for run in runs if run.task and run.task.kind == 'payload' and run.log.targets]
    if not runs:
        return None
    figure, axes = panels(1, height=2.2)
    panel = axes[0, 0]
    for run in runs:
        body = run.body
        height = run.log.targets[0].at(run.start).position[2]
        line(panel, body.t - run.start, body.position[:, 2] - height,
             color=run.colour, label=run.label)
    begin = 0.0
    for segment in runs[0].task.segments:
        panel.axvline(begin, color=FAINT, lw=0.8)
        panel.text(begin, 1.0, f' {segment.payload:g} kg', color=FAINT, fontsize=8, va='top',
                   transform=panel.get_xaxis_transform())
        begin += segment.duration
    panel.set_xlim(-1, begin)
    panel.set_ylabel('height error [m]')
    panel.set_xlabel('time since the first target [s]')
    legend(figure, panel)
    return figure
