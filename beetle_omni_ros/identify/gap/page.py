"""The HTML page of an analysis."""

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.identify.gap.analysis import Analysis, JUDGED
from beetle_omni_ros.identify.gap.residual import CHANNELS
from beetle_omni_ros.identify.gap.results import _evidence, CANDIDATES, grids, headline
from beetle_omni_ros.identify.gap.rollouts import STATES
from beetle_omni_ros.identify.gap.rollouts import UNITS as STATE_UNITS
from beetle_omni_ros.identify.recording.clocks import begin_of
from beetle_omni_ros.pages.figures import COLOURS, FAINT, legend, panels, STYLE, svg
from beetle_omni_ros.pages.page import Grid, html, page, section, verdict_head

BEFORE, AFTER = COLOURS[1], COLOURS[0]
VERDICT_COLOURS = {'no_gap': '#2b7a3d', 'named': '#1f5fa8', 'named_set': '#1f5fa8',
                   'unknown': '#b06a00', 'not_decidable': '#b06a00', 'bad_data': '#b3261e'}
APART = 5       # MoCap readings between two orientations of a finite difference


def gap_page(a: Analysis, result: dict) -> str:
    """One self-contained page."""
    reason = result['reason'][:1].upper() + result['reason'][1:]
    notes = [*([] if result['reason'] in result['summary'] else [f'{reason}.']),
             *([f'Next experiment: {result["next_experiment"]}.']
               if result['next_experiment'] else []),
             *result['findings']]
    sections = []
    if a.problem is not None:
        with matplotlib.rc_context(STYLE):
            sections = [
                section('Residuals', 'Whitened residual (measured minus expected) of the first '
                        'fitted flight, in standard deviations of the noise.',
                        svg(_residuals(a), 'residuals')),
                section('Evidence', 'Decrease of chi2 (squared residual over noise) by each entry '
                        'beside the accepted ones.', html(_evidence(result['candidates'], 60))),
                section('Detectability', 'Standard deviations that an effect of typical size '
                        'would show, alone and beside the most similar entry. Below '
                        f'{a.problem.p.decidable:g} it would not be named.',
                        html(_detectability(result))),
                section('Tolerances', 'Deviations of this robot from the robot file within '
                        'manufacturing tolerance. They are fitted and not named; --tolerances '
                        'writes masses, gains, lags and rotor positions to the robot file.',
                        html(_tolerances(result)))]
    tables = [grid for grid in grids(result) if grid.title != CANDIDATES]
    return page('Gap', _about(a, result['meta']), tables, notes, sections,
                head(result, _picture(a)))


def _about(a, meta):
    """Fitted flights, held-out flights and robot file in one line."""
    count = len(a.models[0]) or len(meta['runs'])
    parts = {'fitted': meta['runs'][:count], 'held out': [*meta['runs'][count:], *meta['holdout']],
             'robot file': [meta['robot']]}
    return '; '.join(f'{word}: {", ".join(runs)}' for word, runs in parts.items() if runs)


def _lines(a, *texts):
    """Name in ``a.runs``, colour and label of each line; only one if no effect is named."""
    if not a.found.accepted:
        return [('before', AFTER, 'robot file, tolerances fitted')]
    return list(zip(('before', 'after'), (BEFORE, AFTER), texts, strict=True))


def head(result: dict, picture: str = '') -> str:
    """Head of the page: verdict, sentence and picture, as HTML."""
    return verdict_head(headline(result), VERDICT_COLOURS[result['verdict']], result['summary'],
                        picture)


def _picture(a):
    """Free runs before and after, or the damaged readings; '' if there are neither."""
    if a.damaged is not None:
        with matplotlib.rc_context(STYLE):
            return svg(_damage(*a.damaged), 'damaged readings')
    if not a.runs:
        return ''
    with matplotlib.rc_context(STYLE):
        figure, axes = panels(len(STATES), 1, height=1.4, sharex=True)
        lines = _lines(a, 'robot file, tolerances fitted', 'with named effects')
        for axis, state in zip(axes[:, 0], STATES, strict=True):
            _errors(a, axis, state, lines)
        axes[-1, 0].set_xlabel('number of the free run, one every 0.5 s of flight')
        legend(figure, axes[0, 0])
        return svg(figure, 'error of free runs after 0.5 s')


def _errors(a, axis, state, lines):
    k = STATES.index(state)
    for name, colour, label in lines:
        error = np.concatenate([run.error[JUDGED][:, k] for run in a.runs[name]])
        axis.plot(error, color=colour, lw=1.0, label=label)
    axis.axhline(a.runs['before'][0].floor[JUDGED][k], color=FAINT, ls='--', lw=0.9,
                 label='noise floor')
    axis.set_ylabel(f'{state} [{STATE_UNITS[state]}]')
    axis.set_ylim(bottom=0)


def _residuals(a) -> Figure:
    problem = a.problem
    values = {'before': problem.residual(a.found.base), 'after': a.found.state.r}
    names = [n for g in problem.noise.taps for n in CHANNELS[g]]
    figure, axes = panels(8, 2, height=1.2, sharex=True)
    for k, (axis, name) in enumerate(zip(axes.T.ravel(), names, strict=False)):
        rows = (problem.where == k) & (problem.flight == 0)
        t = problem.time[rows]
        for which, colour, text in _lines(a, 'without named effects', 'with them'):
            axis.plot(t, values[which][rows], color=colour, lw=0.7, label=text)
        axis.set_title(f'{name} [1]')
    for axis in axes[-1]:
        axis.set_xlabel('time [s]')
    legend(figure, axes[0, 0])
    return figure


def _detectability(result):
    rows, seen = [], set()
    for row in sorted(result['candidates'], key=lambda r: r['sigma_of_realistic_size'] or 1e9):
        sigma = row['sigma_of_realistic_size']
        member = row.get('rotor') or row.get('joint')
        key = row['name'], member
        if sigma is None or key in seen:
            continue
        seen.add(key)
        rivals = row['sigma_beside_rivals']
        worst = min(rivals, key=rivals.get) if rivals else None
        rows.append([row['name'] + (f' {member}' if member else ''), f'{sigma:.1f}',
                     f'{rivals[worst]:.1f} beside {worst}' if worst else ''])
    return Grid('', ['entry', 'alone', 'beside the most similar entry'], rows)


def _tolerances(result):
    rows = [[name, f'{100 * e["deviation"]:.2f} %' if e['relative'] else f'{e["deviation"]:.2g}']
            for name, e in result['tolerances'].items()]
    return Grid('', ['number', 'deviation'], rows)


def _damage(recording, damage):
    """Figure of the damaged, uncorrected readings; a dashed line marks the onset."""
    begin = begin_of(recording)
    joints = damage.topic in ('joint_states', 'command')
    figure, axes = panels(4 if joints else 3, 1, height=1.1, sharex=True)
    draw = _joints if joints else _motion
    draw(recording, axes[:, 0], begin)
    for axis in axes[:, 0]:
        if damage.at_s is not None:
            axis.axvline(damage.at_s, color=COLOURS[1], ls='--', lw=1.0)
    axes[-1, 0].set_xlabel('stamp [s], from the first IMU message on')
    legend(figure, axes[0, 0])
    return figure


def _joints(recording, axes, begin):
    for k, axis in enumerate(axes):
        for topic, colour in (('command', FAINT), ('joint_states', COLOURS[0])):
            values = recording.values[topic]
            if len(values):
                axis.plot(recording.times[topic] - begin, values[:, k], color=colour, lw=0.9,
                     label=topic)
        axis.set_ylabel(f'gimbal{k + 1} [rad]')


def _motion(recording, axes, begin):
    rate, force, place = axes
    t, values = recording.times['imu/data_raw'] - begin, recording.values['imu/data_raw']
    if len(t):
        rate.plot(t, np.linalg.norm(values[:, 3:], axis=1), color=COLOURS[0], lw=0.8,
             label='imu/data_raw')
        force.plot(t, np.linalg.norm(values[:, :3], axis=1), color=COLOURS[0], lw=0.8)
    t, pose = recording.times['mocap/pose'] - begin, recording.values['mocap/pose']
    if len(t) > APART:
        rate.plot(*_turning(t, pose[:, 3:]), color=COLOURS[1], lw=0.8, label='mocap/pose')
        for k, axis in enumerate('xyz'):
            place.plot(t, pose[:, k], lw=0.8, color=COLOURS[k], label=axis)
        place.legend(loc='upper right', ncols=3)
    rate.set_ylabel('rate [rad/s]')
    force.set_ylabel('force [m/s^2]')
    place.set_ylabel('position [m]')


def _turning(t, quaternion):
    """Times (n,) and magnitude of the rate (n,) [rad/s] of orientations (N, 4)."""
    with np.errstate(all='ignore'):
        unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        cosine = np.clip(np.abs((unit[APART:] * unit[:-APART]).sum(axis=1)), 0, 1)
        steps = t[APART:] - t[:-APART]
        rate = 2 * np.arccos(cosine) / np.where(steps > 0, steps, np.nan)
    return 0.5 * (t[APART:] + t[:-APART]), rate
