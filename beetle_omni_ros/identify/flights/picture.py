"""Results of `beetle_omni gap` as an HTML page with a picture."""

from __future__ import annotations

from math import log

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.identify.flights.page import (
    evidence,
    first_label,
    grids,
    headline,
    numbers,
    seen,
    whole,
)
from beetle_omni_ros.identify.recording.bag import Recording
from beetle_omni_ros.identify.recording.topics import begin_of
from beetle_omni_ros.show import figures
from beetle_omni_ros.show.page import Grid, html, page, section, verdict_head

VERDICT_COLOURS = {'no_gap': figures.GREEN, 'bad_data': figures.RED,
                   **dict.fromkeys(('named', 'named_set'), figures.BLUE),
                   **dict.fromkeys(('unknown', 'not_decidable'), figures.AMBER)}
# Topic -> label of an axis -> names of its readings.
LABELS = {
    'imu/data_raw': {'force [m/s^2]': 'xyz', 'rate [rad/s]': 'xyz'},
    'mocap/pose': {'position [m]': 'xyz', 'quaternion': 'xyzw'},
    'joint_states': {'tilt [rad]': '1234'},
    'command': {'tilt [rad]': '1234', 'thrust [N]': '1234'}}
HEIGHT = 0.24   # [in] of a row of a figure


def gap_page(result: dict, damaged: tuple[Recording, dict] | None = None) -> str:
    """One self-contained page; ``damaged``: a recording and the first of its damages."""
    notes = [f'Next experiment: {result["next_experiment"]}.'] \
        if result['next_experiment'] else []
    notes += dict.fromkeys(result['findings'])
    candidates, sections = result['candidates'], []
    if candidates:
        least = log(1 / result['meta']['alpha'])
        tolerances = [[name, f'{100 * e["deviation"]:.2f} %' if e['relative'] else
                       f'{e["deviation"]:.2g}'] for name, e in result['tolerances'].items()]
        sections = [
            section('Evidence', 'Every entry of the catalogue that these flights were compared '
                    'with. An effect is named if its evidence outweighs the number of entries '
                    f'that were tried and the accepted probability of a false alarm ({least:.1f} '
                    'nat).', html(evidence(candidates))),
            section('What would have been seen', 'The smallest size of each effect that these '
                    'flights would have shown, the least visible ones first.',
                    html(seen(candidates))),
            section('Tolerances', 'Deviations of this robot from the robot file, as fitted and '
                    'not named; --tolerances writes masses, gains, lags and rotor positions to '
                    'the robot file.', '<details><summary>All numbers</summary>'
                    f'{html(Grid("", ["number", "deviation"], tolerances))}</details>')]
    with matplotlib.rc_context(figures.STYLE):
        picture = figures.svg(_damage(*damaged), 'damaged readings') if damaged else figures.svg(
            picture_of(result), 'disagreement and sizes') if result['where'] else ''
    meta = result['meta']
    about = {'flights': meta['runs'], 'held out': meta['holdout'], 'robot file': [meta['robot']]}
    return page('Gap', '; '.join(f'{word}: {", ".join(runs)}' for word, runs in about.items()
                                 if runs), grids(result, brief=False), notes, sections,
                head(result, picture))


def head(result: dict, picture: str = '') -> str:
    """Head of the page: verdict, sentence and picture, as HTML."""
    return verdict_head(headline(result), VERDICT_COLOURS[result['verdict']], result['summary'],
                        picture)


def picture_of(result: dict) -> Figure:
    """Disagreement by channel before and after, and the sizes of the effects with intervals."""
    sizes = [row for effect in result['effects'] or result['partial'] for row in _sizes(effect)]
    rows = sorted(whole(result), key=lambda row: row['channel'])[::-1]
    height = HEIGHT * max(len(rows), len(sizes)) + 0.6
    figure, axes = figures.panels(1, 2 if sizes else 1, height=height)
    place = np.arange(len(rows))
    for key, shift, colour, text in (('excess', 0.18, figures.BEFORE, 'robot file'),
                                     ('excess_after', -0.18, figures.AFTER, 'fit')):
        axes[0, 0].barh(place + shift, [row[key] for row in rows], 0.36, color=colour, label=text)
    axes[0, 0].axvline(1.0, color=figures.FAINT, ls='--', lw=0.9, label='noise')
    axes[0, 0].set_yticks(place, [row['channel'] for row in rows])
    axes[0, 0].set_xlabel('RMS of measured minus expected, over the noise')
    figures.legend(figure, axes[0, 0])
    for axis in axes[0, 1:]:        # only with sizes
        for k, (_, middle, low, high) in enumerate(sizes[::-1]):
            axis.plot([low, high], [k, k], color=figures.INK, lw=1.4)
            axis.plot(middle, k, 'o', color=figures.AFTER, ms=4)
        axis.axvline(0.0, color=figures.BEFORE, lw=0.9)
        axis.set_yticks(np.arange(len(sizes)), [text for text, *_ in sizes[::-1]])
        axis.set_xlabel('deviation in typical sizes, 95 %')
    return figure


def _sizes(effect):
    """Name, deviation and its interval of each number, over its typical deviation."""
    text = first_label(effect) + ' or …' * ('rivals' in effect)
    for name, found in effect['parameters'].items():
        rows = numbers(found)
        for axis, (*sizes, own) in zip('xyz' if len(rows) == 3 else ' ' * len(rows), rows,
                                       strict=True):
            yield f'{text}\n{name} {axis}'.rstrip(), *(
                (size - own) / found['typical'] for size in sizes)


def _damage(recording, damage):
    """Figure of the readings of the damaged topic; a dashed line marks the onset."""
    topic = damage['topic'] if damage['topic'] in LABELS else 'imu/data_raw'
    t, values = recording.times[topic] - begin_of(recording), recording.values[topic]
    figure, axes = figures.panels(len(LABELS[topic]), 1, height=1.1, sharex=True)
    first = 0
    for axis, (label_of, names) in zip(axes[:, 0], LABELS[topic].items(), strict=True):
        for k, name in enumerate(names):
            axis.plot(t, values[:, first + k], lw=0.8, color=figures.PARTS[k], label=name)
        first += len(names)
        axis.set_ylabel(label_of)
        axis.legend(loc='upper right', ncols=4)
        if damage['at_s'] is not None:
            axis.axvline(damage['at_s'], color=figures.INK, ls='--', lw=1.0)
    axes[-1, 0].set_xlabel('stamp [s], from the first IMU message on')
    return figure
