"""Charts that sum a flight up: errors of all poses, use of joints and rotors, disturbances."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.pages.charts import Chart, Series
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.body import errors, hold, inside
from beetle_omni_ros.runs.charts import L_COLOUR, TINY, U_COLOUR
from beetle_omni_ros.runs.metrics import (
    L_WINDOW,
    REACHED_ORIENTATION,
    REACHED_POSITION,
    U_WINDOW,
)
from beetle_omni_ros.runs.shown import Run
from beetle_omni_ros.runs.tasks import POSE_DURATION

ABSURD, NARROW = 1e6, 1e-9    # [rad, rad/s, N] what no actuator does; ranges not to be divided
BINS = 60
FEW = 3                 # poses below which no distribution is shown
SHARES = 200            # points of a distribution


def errors_of_a_pose(runs: list[Run]) -> list[Chart]:
    """Errors in the 8 s of a pose: median and 10 to 90 % band over all poses of a run."""
    grid = np.arange(0.0, POSE_DURATION, 0.02)
    folded = [(number, run, stacks) for number, run in enumerate(runs)
              if (stacks := _folded(run, grid)) is not None]
    made = []
    for k, (name, unit) in enumerate((('position error', 'm'), ('orientation error', 'deg'))):
        series = []
        for number, run, stacks in folded:
            low, middle, high = np.maximum(np.percentile(stacks[k], (10, 50, 90), axis=0),
                                           TINY[unit])
            series += [Series(f'{run.label}, 10 %', run.colour, low, number, 'dot'),
                       Series('90 %', run.colour, high, number, 'dot', band=True),
                       Series('median', run.colour, middle, number)]
        if series:
            made.append(Chart(f'{name} [{unit}]', series, grid, 'time since the pose [s]',
                              (False, True), wide=False, windows=[
                                  (*L_WINDOW, L_COLOUR), (*U_WINDOW, U_COLOUR)]))
    return made


def _folded(run, grid):
    body, stacks = run.body, ([], [])
    for target in run.log.targets:
        if not isinstance(target, PoseTarget) or \
                not body.covers(target.stamp, target.stamp + U_WINDOW[1]):
            continue
        window = body.window(target.stamp, target.stamp + POSE_DURATION)
        for stack, values in zip(stacks, errors(body, target, window), strict=True):
            stack.append(np.interp(grid, body.t[window] - target.stamp, values))
    return [np.array(stack) for stack in stacks] if len(stacks[0]) >= FEW else None


def steady_errors(runs: list[Run]) -> list[Chart]:
    """Share of the poses whose U error is below a value."""
    made = []
    for key, limit, title in (('U_position_m', REACHED_POSITION, 'U position error [m]'),
                              ('U_orientation_deg', REACHED_ORIENTATION,
                               'U orientation error [deg]')):
        known = [(number, run, label, values, len(result['poses']))
                 for number, run in enumerate(runs) for label, result in run.results.items()
                 if len(values := np.sort([pose[key] for pose in result['poses']
                                           if pose[key] is not None])) >= FEW]
        if not known:
            continue
        every = np.concatenate([values for *_, values, _ in known])
        x = np.geomspace(max(every.min(), 1e-6) * 0.8, max(every.max(), limit) * 1.25, SHARES)
        made.append(Chart('share of the poses', [
            Series(label, run.colour, np.searchsorted(values, x, side='right') / count, number,
                   'step') for number, run, label, values, count in known],
            x, title, (True, False), [(limit, 'reached below')], wide=False))
    return made


def use(runs: list[Run], robot: RobotParameters) -> list[Chart]:
    """Histograms of what joints and rotors were asked for and gave, with their limits."""
    joints, rotors = robot.joints, robot.rotors
    limits = ((-joints.position_limit, joints.position_limit),
              (-joints.velocity_limit, joints.velocity_limit),
              (rotors.thrust_min, rotors.thrust_max), ())
    titles = ('tilt angle [rad]', 'tilt rate [rad/s]', 'thrust command [N]', '|q* - q| [rad]')
    used = [_used(run) for run in runs]
    return [chart for title, limit, column in zip(titles, limits, zip(*used, strict=True),
                                                  strict=True)
            for chart in _histograms(runs, column, title, limit)]


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


def _histograms(runs, columns, title, limit):
    """All runs in the same bins, so that their shares compare."""
    columns = [values[np.abs(values) < ABSURD] for values in columns]
    every = np.concatenate(columns)
    if not every.size:
        return []
    low, high = every.min(), every.max()
    spare = 0.5 if high - low < NARROW else 0.0
    edges = np.linspace(low - spare, high + spare, BINS + 1)
    series = []
    for number, (run, values) in enumerate(zip(runs, columns, strict=True)):
        share = np.histogram(values, bins=edges)[0] / max(1, values.size)
        series.append(Series(run.label, run.colour, np.append(share, share[-1]), number, 'step'))
    return [Chart('share of the time', series, edges, title, (False, True),
                  [(value, '') for value in limit], wide=False)]


def disturbance(runs: list[Run]) -> list[Chart]:
    """Peak errors against the disturbance, for force and torque tasks."""
    made = []
    for kind, unit in (('force', 'N'), ('torque', 'N_m')):
        known = [(number, run, label, result[kind]['levels']) for number, run in enumerate(runs)
                 for label, result in run.results.items() if result.get(kind, {}).get('levels')]
        x = np.array(sorted({entry[f'level_{unit}'] for *_, levels in known for entry in levels}))
        if not len(x):
            continue
        for key, title in (('peak_position_m', 'peak position error [m]'),
                           ('peak_orientation_deg', 'peak orientation error [deg]')):
            series = []
            for number, run, label, levels in known:
                for name, style, wanted in ((label, 'points', False),
                                            (f'{label}: control lost', 'points', True)):
                    y = np.full(len(x), np.nan)
                    for entry in levels:
                        if entry['lost'] >= wanted and entry[key] is not None:
                            y[np.searchsorted(x, entry[f'level_{unit}'])] = entry[key]
                    if np.isfinite(y).any():
                        series.append(Series(name, '#22272e' if wanted else run.colour, y, number,
                                             style))
            if series:
                made.append(Chart(title, series, x, f"{kind} [{unit.replace('_', ' ')}]",
                                  wide=False))
    return made
