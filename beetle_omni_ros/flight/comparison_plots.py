"""
Figures of poses, disturbances and the lemniscate.

Each is drawn from the results of one task under one set of conditions.
"""

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
import numpy as np

from beetle_omni_ros.bags.metrics import L_WINDOW, U_WINDOW
from beetle_omni_ros.control.tasks import make_task, POSE_DURATION, RISING, TILTS
from beetle_omni_ros.flight.compared_flights import Flight
from beetle_omni_ros.flight.summary import look
from beetle_omni_ros.show.figures import FAINT, INK, legend, panels

FLOOR = {'position': 2e-4, 'orientation': 1e-2}  # of logarithmic errors [m], [deg]
UNITS = {'position': 'm', 'orientation': 'deg'}
STEP = 0.05  # [s] between points of a folded curve
BEFORE = 2.0  # [s] of hover shown before the first disturbance
LEVELS = {'force': 'force [N]', 'torque': 'torque [N m]', 'wind': 'wind [m/s]',
          'pushes': 'number of the push', 'payload': 'payload [kg]'}
SHOWN = {'position': 2.0, 'orientation': 180.0}  # largest limit of a disturbance's axes [m], [deg]

Groups = dict[str, list[dict]]      # controller -> one result with a trace for each seed


def of(flown: dict[Flight, dict], task: str, conditions: str) -> Groups:
    """Results with a trace of a task under one set of conditions."""
    chosen: Groups = {}
    for flight, result in flown.items():
        if (flight.task, flight.conditions) == (task, conditions) and result['trace']:
            chosen.setdefault(flight.controller, []).append(result)
    return chosen


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
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
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


def in_time(groups: Groups, task: str) -> Figure:
    """Errors of the first flights over time, with the disturbance dashed as in the publication."""
    flown = make_task(task)
    figure, axes = panels(2, height=2.1, sharex=True)
    for panel, what in zip(axes[:, 0], SHOWN, strict=True):
        if flown.kind in LEVELS:
            _levels(panel, flown)
        highest = max(_error_curve(panel, results[0], what, name)
                      for name, results in groups.items())
        panel.set_ylim(0, min(1.08 * highest, SHOWN[what]) or 1)
        panel.set_ylabel(f'{what} error [{UNITS[what]}]')
    axes[1, 0].set_xlim(POSE_DURATION - BEFORE, flown.duration)
    axes[1, 0].set_xlabel('time since the hover was asked for [s]')
    legend(figure, axes[0, 0])
    return figure


def _levels(panel, task):
    """Plot the level of the disturbance on an axis to the right."""
    right, name = panel.twinx(), LEVELS[task.kind]
    levels = [segment.level for segment in task.segments]
    style = {'color': INK, 'lw': 1.1, 'ls': (0, (4, 2.5))}
    right.step([0.0, *task.ends], [*levels, levels[-1]], where='post', **style)
    right.set_ylim(0, max(levels) * 1.15)
    right.set_ylabel(name)
    right.grid(False)
    right.spines['right'].set_visible(True)
    panel.plot([], [], label=f'{name} (right axis)', **style)
    panel.set_zorder(right.get_zorder() + 1)
    panel.patch.set_visible(False)


def _error_curve(panel, result, what, name):
    """Plot one flight's errors, mark lost control, and return the largest error."""
    style, trace = look(name), result['trace']
    t, values = trace['t'], trace[f'{what}_error']
    panel.plot(t, values, color=style.colour, ls=style.dashes, lw=1.5, label=style.label)
    if any(result['metrics'].get(kind, {}).get(f'lost_at_{unit}') is not None
           for kind, unit in (('force', 'N'), ('torque', 'N_m'))):
        last = np.flatnonzero(np.isfinite(values))[-1:]
        panel.plot(t[last], np.minimum(values[last], SHOWN[what] * 0.98), marker='X', ms=8,
                   color=style.colour, mec='white', mew=0.8, ls='', zorder=6, clip_on=False)
    shown = values[(t > POSE_DURATION - BEFORE) & np.isfinite(values)]
    return float(np.max(shown)) if shown.size else 0.0


_POSES = [('convergence', 'Errors after a pose was asked for: median and 10 to 90 % band over all '
           'poses', convergence)]
_TIME = [('errors', 'Errors in time in the first flight, the disturbance dashed; × where control '
          'was lost', in_time)]
# Kind of a task -> name, caption and function of each figure.
DRAWN = {'random': _POSES, 'poses': _POSES, **dict.fromkeys(
    (*RISING, *TILTS, 'wind', 'pushes', 'payload'), _TIME)}
