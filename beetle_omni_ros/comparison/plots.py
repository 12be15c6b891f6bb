"""
Figures of poses, disturbances and the lemniscate.

Each is drawn from the results of one task under one set of conditions.
"""

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
import numpy as np

from beetle_omni_ros.comparison.flights import Flight
from beetle_omni_ros.comparison.summary import look
from beetle_omni_ros.pages.figures import FAINT, INK, legend, panels
from beetle_omni_ros.runs.metrics import L_WINDOW, REACHED_ORIENTATION, REACHED_POSITION, U_WINDOW
from beetle_omni_ros.runs.tasks import make_task, PERIOD, POSE_DURATION

FLOOR = {'position': 2e-4, 'orientation': 1e-2}  # of logarithmic errors [m], [deg]
UNITS = {'position': 'm', 'orientation': 'deg'}
STEP = 0.05  # [s] between points of a folded curve
BEFORE = 2.0  # [s] of hover shown before the first disturbance
SHOWN = {'position': 2.0, 'orientation': 180.0}  # largest limit of a disturbance's axes [m], [deg]

Groups = dict[str, list[dict]]      # controller -> one result with a trace for each seed


def of(flown: dict[Flight, dict], task: str, conditions: str) -> Groups:
    """Results with a trace of a task under one set of conditions."""
    chosen: Groups = {}
    for flight, result in flown.items():
        if (flight.task, flight.conditions) == (task, conditions) and result['trace']:
            chosen.setdefault(flight.controller, []).append(result)
    return chosen


def plain_ticks(axis) -> None:
    """Label a logarithmic axis with 0.01, 0.1, 1 instead of powers."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))


def distributions(groups: Groups, task: str) -> Figure:
    """Share of the poses with at most an error at the target; lost ones never count."""
    figure, axes = panels(1, 2, height=2.8)
    for panel, what, limit in zip(axes[0], FLOOR, (REACHED_POSITION, REACHED_ORIENTATION),
                                  strict=True):
        for name, results in groups.items():
            found = [pose[f'U_{what}_{UNITS[what]}'] for result in results
                     for pose in result['metrics']['poses']]
            known = np.sort([max(value, FLOOR[what]) for value in found if value is not None])
            values, style = np.concatenate([known[:1], known]), look(name)
            panel.step(values, 100 * np.arange(len(values)) / len(found), where='post',
                       color=style.colour, ls=style.dashes, lw=1.5, label=style.label)
        panel.axvline(limit, color=FAINT, lw=1, ls=(0, (3, 2)))
        panel.set_xscale('log')
        plain_ticks(panel.xaxis)
        panel.set_ylim(0, 101)
        panel.set_xlabel(f'U {what} error [{UNITS[what]}]')
    axes[0, 0].set_ylabel('share of the poses [%]')
    legend(figure, axes[0, 0])
    return figure


def convergence(groups: Groups, task: str) -> Figure:
    """Errors in the 8 s of a pose: median and 10 to 90 % band over all poses."""
    figure, axes = panels(1, 2, height=2.8)
    grid = np.arange(0.0, POSE_DURATION, STEP)
    for name, results in groups.items():
        style = look(name)
        for panel, (what, floor) in zip(axes[0], FLOOR.items(), strict=True):
            folded = _folded(results, f'{what}_error', grid)
            if not len(folded):
                continue
            low, middle, high = np.maximum(np.percentile(folded, (10, 50, 90), axis=0), floor)
            panel.fill_between(grid, low, high, color=style.colour, alpha=0.13, lw=0)
            panel.plot(grid, middle, color=style.colour, ls=style.dashes, lw=1.7,
                       label=style.label)
    for panel, what in zip(axes[0], FLOOR, strict=True):
        for window, colour, name in ((L_WINDOW, '#eef1f5', 'L'), (U_WINDOW, '#d5e6d9', 'U')):
            panel.axvspan(*window, color=colour, lw=0, zorder=0)
            panel.text(np.mean(window), 0.985, name, transform=panel.get_xaxis_transform(),
                       va='top', ha='center', color=FAINT, fontsize=8)
        panel.set_yscale('log')
        plain_ticks(panel.yaxis)
        panel.set_xlim(0, POSE_DURATION)
        panel.set_ylabel(f'{what} error [{UNITS[what]}]')
        panel.set_xlabel('time since the pose was asked for [s]')
    legend(figure, axes[0, 0])
    return figure


def _folded(results, key, grid):
    """(P, len(grid)) errors of each pose that was flown to its end."""
    rows = []
    for result in results:
        t, values = result['trace']['t'], result['trace'][key]
        for k in range(len(result['metrics']['poses'])):
            inside = (t >= k * POSE_DURATION - 1e-3) & (t < (k + 1) * POSE_DURATION - 1e-3)
            if np.any(inside) and t[inside][-1] >= k * POSE_DURATION + U_WINDOW[1]:
                rows.append(np.interp(grid, t[inside] - k * POSE_DURATION, values[inside]))
    return np.array(rows)


def disturbance(groups: Groups, kind: str) -> Figure:
    """Errors over time with the disturbance dashed, as in the publication."""
    unit = 'N' if kind == 'force' else 'N m'
    figure, axes = panels(2, height=2.1, sharex=True)
    times, levels = _levels(make_task(kind))
    for panel, what in zip(axes[:, 0], SHOWN, strict=True):
        right = panel.twinx()
        right.step(times, levels, where='post', color=INK, lw=1.1, ls=(0, (4, 2.5)))
        right.set_ylim(0, levels.max() * 1.15)
        right.set_ylabel(f'{kind} [{unit}]')
        right.grid(False)
        right.spines['right'].set_visible(True)
        panel.plot([], [], color=INK, lw=1.1, ls=(0, (4, 2.5)), label=f'{kind} (right axis)')
        highest = 0.0
        for name, results in groups.items():
            highest = max(highest, _error_curve(panel, results[0], what, name))
        panel.set_ylim(0, min(1.08 * highest, SHOWN[what]) or 1)
        panel.set_ylabel(f'{what} error [{UNITS[what]}]')
        panel.set_zorder(right.get_zorder() + 1)
        panel.patch.set_visible(False)
    axes[1, 0].set_xlim(POSE_DURATION - BEFORE, times[-1])
    axes[1, 0].set_xticks(np.arange(POSE_DURATION - BEFORE, times[-1] + 0.1, 2.0))
    axes[1, 0].set_xlabel('time since the hover was asked for [s]')
    legend(figure, axes[0, 0])
    return figure


def _levels(task):
    """Times and levels for a step plot."""
    times, levels, begin = [0.0], [0.0], 0.0
    for segment in task.segments:
        times.append(begin)
        levels.append(segment.level)
        begin += segment.duration
    return np.array([*times, begin]), np.array([*levels, levels[-1]])


def _error_curve(panel, result, what, name):
    """Plot one flight's errors, mark lost control, and return the largest error."""
    style, trace = look(name), result['trace']
    t, values = trace['t'], trace[f'{what}_error']
    panel.plot(t, values, color=style.colour, ls=style.dashes, lw=1.5, label=style.label)
    kind = 'force' if 'force' in result['metrics'] else 'torque'
    lost = next((value for key, value in result['metrics'][kind].items()
                 if key.startswith('lost_at')), None)
    if lost is not None:
        last = np.flatnonzero(np.isfinite(values))[-1:]
        panel.plot(t[last], np.minimum(values[last], SHOWN[what] * 0.98), marker='X', ms=8,
                   color=style.colour, mec='white', mew=0.8, ls='', zorder=6, clip_on=False)
    shown = values[(t > POSE_DURATION - BEFORE) & np.isfinite(values)]
    return float(np.max(shown)) if shown.size else 0.0


def _laps(results, keys):
    """Phase grid (N,) [s] of a round and (R, N, len(keys)) values of all complete rounds."""
    grid = np.arange(0.0, PERIOD, STEP)
    rounds = []
    for result in results:
        trace = result['trace']
        columns = np.column_stack([trace[key] for key in keys])
        for begin, end in make_task('lemniscate').rounds:
            if trace['t'][-1] >= end - 0.1:
                rounds.append(np.column_stack([np.interp(grid + begin, trace['t'], values)
                                               for values in columns.T]))
    return grid, np.array(rounds)


def lemniscate_errors(groups: Groups, task: str) -> Figure | None:
    """Tracking errors over a round: mean of all rounds, minimum to maximum as a band."""
    figure, axes = panels(2, height=1.6, sharex=True)
    drawn = False
    for name, results in groups.items():
        style = look(name)
        grid, rounds = _laps(results, ('position_error', 'orientation_error'))
        for column in range(2 if len(rounds) else 0):
            values, panel, drawn = rounds[:, :, column], axes[column, 0], True
            panel.fill_between(grid, values.min(axis=0), values.max(axis=0), color=style.colour,
                               alpha=0.2, lw=0)
            panel.plot(grid, values.mean(axis=0), color=style.colour, ls=style.dashes, lw=1.4,
                       label=style.label)
    if not drawn:
        return None
    for panel, what in zip(axes[:, 0], UNITS, strict=True):
        panel.set_ylabel(f'{what} error [{UNITS[what]}]')
        panel.set_ylim(bottom=0)
        panel.set_xlim(0, PERIOD)
    axes[1, 0].set_xlabel('time in the round [s]')
    legend(figure, axes[0, 0])
    return figure


_POSES = [('errors', 'Share of the poses with at most an error at the target; dashed: reached',
           distributions),
          ('convergence', 'Errors after a pose was asked for: median and 10 to 90 % band over all '
           'poses', convergence)]
_TIME = 'Errors in time in the first flight, the disturbance dashed; × where control was lost'
# Kind of a task -> name, caption and function of each figure.
DRAWN = {'random': _POSES, 'poses': _POSES, 'force': [('errors', _TIME, disturbance)],
         'torque': [('errors', f'{_TIME}; each torque lasts 0.05 s', disturbance)],
         'lemniscate': [('errors', 'Tracking errors in a round: mean of all rounds, least to '
                         'largest as a band', lemniscate_errors)]}
