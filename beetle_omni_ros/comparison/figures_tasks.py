"""Figures of disturbances, payload, the lemniscate and the smoothness of a hover."""

from __future__ import annotations

from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.comparison.figures_poses import label_once, of, STEP, UNITS
from beetle_omni_ros.comparison.style import FAINT, INK, look
from beetle_omni_ros.pages.figures import panels, WIDTH
from beetle_omni_ros.runs import lemniscate as curve
from beetle_omni_ros.runs.tasks import make_task, POSE_DURATION

BEFORE = 2.0  # [s] of hover shown before the first disturbance
SHOWN = {'position': 2.0, 'orientation': 180.0}  # most that a disturbance's axes show [m], [deg]
HOVER_SHOWN = 0.5  # [s] of commands


def disturbance(flown: dict, kind: str, conditions: str) -> Figure | None:
    """Errors in time with the disturbance's magnitude dashed, as the publication draws them."""
    groups = of(flown, kind, conditions)
    if not groups:
        return None
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
            for k, result in enumerate(results):
                highest = max(highest, _error_curve(panel, result, what, name, k))
        panel.set_ylim(0, min(1.08 * highest, SHOWN[what]) or 1)
        panel.set_ylabel(f'{what} error [{UNITS[what]}]')
        panel.set_zorder(right.get_zorder() + 1)
        panel.patch.set_visible(False)
    axes[1, 0].set_xlim(POSE_DURATION - BEFORE, times[-1])
    axes[1, 0].set_xticks(np.arange(POSE_DURATION - BEFORE, times[-1] + 0.1, 2.0))
    axes[1, 0].set_xlabel('time since the hover was asked for [s]')
    label_once(figure, axes[0, 0])
    return figure


def _levels(task):
    """Steps of the level over time, as lists for a step plot."""
    times, levels, begin = [0.0], [0.0], 0.0
    for segment in task.segments:
        times.append(begin)
        levels.append(segment.level)
        begin += segment.duration
    return np.array([*times, begin]), np.array([*levels, levels[-1]])


def _error_curve(panel, result, what, name, k):
    """One flight's curve, its end marked where control was lost; returns its largest value."""
    style, trace = look(name), result['trace']
    t, values = trace['t'], trace[f'{what}_error']
    panel.plot(t, values, color=style.colour, ls=style.dashes, lw=1.5 if k == 0 else 0.8,
               alpha=1.0 if k == 0 else 0.45, label=style.label)
    kind = 'force' if 'force' in result['metrics'] else 'torque'
    lost = next((value for key, value in result['metrics'][kind].items()
                 if key.startswith('lost_at')), None)
    if lost is not None:
        last = np.flatnonzero(np.isfinite(values))[-1:]
        panel.plot(t[last], np.minimum(values[last], SHOWN[what] * 0.98), marker='X', ms=8,
                   color=style.colour, mec='white', mew=0.8, ls='', zorder=6, clip_on=False)
    shown = values[(t > POSE_DURATION - BEFORE) & np.isfinite(values)]
    return float(np.max(shown)) if shown.size else 0.0


def payload(flown: dict, conditions: str) -> Figure | None:
    """Steady errors against the mass, and the height while it is attached."""
    groups = of(flown, 'payload', conditions)
    if not groups:
        return None
    figure, axes = panels(1, 3, height=2.7, width_ratios=(1, 1, 1.5))
    for number, (name, results) in enumerate(groups.items()):
        style = look(name)
        entries = [result['metrics']['payload'] for result in results]
        masses = np.array([entry['payload_kg'] for entry in entries[0]])
        shift = 0.012 * (number - (len(groups) - 1) / 2)
        for panel, key, scale in ((axes[0, 0], 'height_error_m', 1e3),
                                  (axes[0, 1], 'orientation_deg', 1.0)):
            values = scale * np.array([[np.nan if e[key] is None else e[key] for e in part]
                                       for part in entries])
            if np.all(np.isnan(values)):
                continue
            middle = np.nanmean(values, axis=0)
            panel.errorbar(masses + shift, middle, yerr=[middle - np.nanmin(values, axis=0),
                                                         np.nanmax(values, axis=0) - middle],
                           color=style.colour, ls=style.dashes, marker=style.marker, ms=4.5,
                           lw=1.4, capsize=2, label=style.label)
        trace = results[0]['trace']
        axes[0, 2].plot(trace['t'], 1e3 * (trace['position'][:, 2] - 1.0), color=style.colour,
                        ls=style.dashes, lw=1.1)
    for panel, label in zip(axes[0], ('steady height error [mm]', 'steady orientation error [deg]',
                                      'height error [mm]'), strict=True):
        panel.set_ylabel(label)
    for panel in axes[0, :2]:
        panel.set_xlabel('payload [kg]')
    _mark_masses(axes[0, 2])
    axes[0, 1].set_ylim(bottom=0)
    axes[0, 0].axhline(0, color=FAINT, lw=0.8)
    label_once(figure, axes[0, 0])
    return figure


def _mark_masses(panel):
    begin = 0.0
    for segment in make_task('payload').segments:
        panel.axvline(begin, color=FAINT, lw=0.7)
        panel.text(begin + 0.4, 0.985, f'{segment.payload:g} kg', color=FAINT, fontsize=7.5,
                   va='top', transform=panel.get_xaxis_transform())
        begin += segment.duration
    panel.set_xlim(0, begin)
    panel.set_xlabel('time [s]')


def _rounds(results, keys):
    """Phase grid (N,) [s] in a round and (R, N, len(keys)) values of all complete rounds."""
    grid = np.arange(0.0, curve.PERIOD, STEP)
    rounds = []
    for result in results:
        trace = result['trace']
        columns = np.column_stack([trace[key] for key in keys])
        for begin, end in make_task('lemniscate').rounds:
            if trace['t'][-1] >= end - 0.1:
                rounds.append(np.column_stack([np.interp(grid + begin, trace['t'], values)
                                               for values in columns.T]))
    return grid, np.array(rounds)


def lemniscate_path(flown: dict, conditions: str) -> Figure | None:
    """The path in space, from above and from the side, mean of all rounds."""
    groups = {name: rounds for name, results in of(flown, 'lemniscate', conditions).items()
              if len((rounds := _rounds(results, ('position',))[1]))}
    if not groups:
        return None
    figure = Figure(figsize=(WIDTH, 4.1), layout='constrained')
    parts = figure.add_gridspec(2, 2, width_ratios=(1.15, 1), height_ratios=(1.75, 1))
    space = figure.add_subplot(parts[:, 0], projection='3d')
    above = figure.add_subplot(parts[0, 1])
    side = figure.add_subplot(parts[1, 1], sharex=above)
    for name, rounds in groups.items():
        path = np.vstack([rounds.mean(axis=0), rounds.mean(axis=0)[:1]])
        _path(space, above, side, path, look(name).colour, ls=look(name).dashes, lw=1.5,
              label=look(name).label)
    samples = [curve.sample(curve.RAMP + s) for s in np.arange(0, curve.PERIOD + 0.01, STEP)]
    _path(space, above, side, np.array([sample.position for sample in samples]), INK,
          ls=(0, (3, 2)), lw=0.8, label='reference', zorder=5)
    for panel, label in ((above, 'y [m]'), (side, 'z [m]')):
        panel.margins(0.05)
        panel.set_ylabel(label)
    above.tick_params(labelbottom=False)
    side.set_xlabel('x [m]')
    space.set(xlabel='x [m]', ylabel='y [m]', zlabel='z [m]', zlim=(0.9, 1.7),
              xticks=(-1, 0, 1), yticks=(-0.5, 0, 0.5), zticks=(1.0, 1.3, 1.6))
    space.set_box_aspect((2, 1.3, 1.0), zoom=1.02)
    space.view_init(elev=26, azim=-62)
    label_once(figure, space)
    return figure


def _path(space, above, side, path, colour, **style):
    """Draw (N, 3) positions into the view in space and the two projections."""
    space.plot(*path.T, color=colour, **style)
    above.plot(path[:, 0], path[:, 1], color=colour, **style)
    side.plot(path[:, 0], path[:, 2], color=colour, **style)


def lemniscate_errors(flown: dict, conditions: str) -> Figure | None:
    """Tracking errors over a round: mean of all rounds, least to largest as a band."""
    groups = of(flown, 'lemniscate', conditions)
    figure, axes = panels(2, height=1.6, sharex=True)
    drawn = False
    for name, results in groups.items():
        style = look(name)
        grid, rounds = _rounds(results, ('position_error', 'orientation_error'))
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
        panel.set_xlim(0, curve.PERIOD)
    axes[1, 0].set_xlabel('time in the round [s]')
    label_once(figure, axes[0, 0])
    return figure


def hover_commands(flown: dict, conditions: str) -> Figure | None:
    """What the actuators were told in the last half second of a hover: smooth, or chatter."""
    groups = of(flown, 'hover', conditions)
    groups = {name: results for name, results in groups.items()
              if len(results[0]['trace']['command_t'])}
    if not groups:
        return None
    figure, axes = panels(2, len(groups), height=1.35, sharex=True, sharey='row')
    for column, (name, results) in enumerate(groups.items()):
        trace, style = results[0]['trace'], look(name)
        t = trace['command_t'] - trace['command_t'][-1]
        for row, values in enumerate((trace['command_tilt'], trace['command_thrust'])):
            for k in range(4):
                axes[row, column].step(t, values[:, k] - values[:, k].mean(), where='post',
                                       color=style.colour, lw=1.0, alpha=1 - 0.2 * k)
        axes[0, column].set_title(style.label, color=style.colour, fontsize=9)
        axes[1, column].set_xlim(-HOVER_SHOWN, 0)
        axes[1, column].set_xticks((-HOVER_SHOWN, -HOVER_SHOWN / 2, 0))
        axes[1, column].set_xlabel('time before the end [s]')
    for panel, label, least in zip(axes[:, 0], ('tilt [rad]', 'thrust [N]'), (0.02, 0.25),
                                   strict=True):
        panel.set_ylabel(f'{label}\nabout its mean')
        largest = max(abs(limit) for limit in panel.get_ylim())
        panel.set_ylim(-max(largest, least), max(largest, least))
    return figure
