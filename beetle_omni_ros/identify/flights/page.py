"""Results of `beetle_omni gap` as one sentence, as tables and as an HTML page."""

from __future__ import annotations

from math import log

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.identify.recording.bag import Recording
from beetle_omni_ros.identify.recording.topics import begin_of
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.formula import described
from beetle_omni_ros.show import figures
from beetle_omni_ros.show.page import ABSENT, Grid, html, page, section, verdict_head

WORDS = {'no_gap': 'no gap', 'named': 'named', 'named_set': 'one of a set',
         'unknown': 'unknown: none of the known effects', 'not_decidable': 'not decidable',
         'bad_data': 'bad data: a recording cannot be used'}
MOST_NAMED = 6          # entries of a list in a sentence
LOPSIDED = 0.2          # asymmetry of an interval from which a sentence states both ends
SPELLED = {'imu': 'IMU', 'mocap': 'MoCap'}
SHOWN = 6               # channels and candidates in the terminal
LEAST_CHANCE = 1e-6     # below, a probability is not stated as a number
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


def headline(result: dict) -> str:
    """Verdict and named effects."""
    names = ', '.join(label(effect) for effect in result['effects'])
    return f"{WORDS[result['verdict']]}{': ' + names if names else ''}"


def label(effect: dict) -> str:
    """Names of an effect or candidate with the number of its rotor or joint."""
    if len(effect.get('members', [])) > 1:
        return ' or '.join(effect['members'])
    member = effect.get('rotor') or effect.get('joint') or effect.get('term')
    names = ' or '.join(effect.get('names') or [effect['name']])
    return names + (f' {member}' if member else '')


def summary(result: dict) -> str:
    """The verdict as one or two sentences."""
    verdict, reason = result['verdict'], result['reason']
    if verdict in ('named', 'named_set'):
        parts = [_effect_text(effect) for effect in result['effects']]
        explain = 'explain' if len(parts) > 1 else 'explains'
        return ' '.join(filter(None, [f'{_capital(listed(parts))} {explain} the disagreement.',
                                      _closing(result), _chance(result)]))
    if verdict == 'no_gap':
        text = 'Model and measurement agree to within noise and manufacturing tolerance.'
        if not result['hidden']:
            return f'{text} Every known effect of typical size would have been detected.'
        return (f'{text} An effect of typical size of {listed(result["hidden"], "or")} would not '
                'have been detected in these data.')
    if verdict == 'not_decidable':
        return f'These data cannot decide: {reason}.'
    if verdict == 'unknown':
        return ' '.join(filter(None, [f'No known effect explains the disagreement: {reason}.',
                                      _partly(result), _chance(result)]))
    further = len(result['bad_data']) - 1
    return (reason if reason.endswith('?') else f'{reason}.') + (
        f' {further} more {"fault is" if further == 1 else "faults are"} listed below.'
        if further > 0 else '')


def _partly(result):
    partial = [' or '.join(effect['names']) for effect in result['partial']]
    return f'{_capital(listed(partial))} would explain a part.' if partial else ''


def listed(words: list[str], last: str = 'and') -> str:
    """Join words as 'a, b and c'; a long list ends with the number of others."""
    words = list(words)
    if len(words) > MOST_NAMED:
        words = [*words[:MOST_NAMED - 1], f'{len(words) - MOST_NAMED + 1} others']
    words = [_spelled(word) for word in words]
    return f' {last} '.join(filter(None, [', '.join(words[:-1]), words[-1] if words else '']))


def _spelled(name):
    return ' '.join(SPELLED.get(word, word) for word in name.replace('_', ' ').split(' '))


def _effect_text(effect):
    several = effect.get('members', [])[1:]
    names = [_spelled(name) for name in (effect['members'] if several else effect['names'])]
    member = next((f' of {kind} {effect[kind]}' for kind in ('rotor', 'joint', 'term')
                   if effect.get(kind) and not several), '')
    parameter, found = next(iter(effect['parameters'].items()))
    values, own = _list(found['value']), _list(found['file'])
    spans = [] if not found.get('interval') else [found['interval']] if np.ndim(
        found['interval']) == 1 else found['interval']
    sizes = ', '.join(_size(v, span) for v, span in zip(values, spans, strict=True))
    unit = '' if found['unit'] == '1' else f' {found["unit"]}'
    what = f'{parameter}; ' if len(CATALOGUE[effect['names'][0]].parameters) > 1 else ''
    file = ', '.join(f'{value:.3g}' for value in own) + unit if any(own) else 'none'
    return f'{" or ".join(names)}{member} of {sizes}{unit} ({what}robot file: {file})'


def _size(value, span):
    below, above = value - span[0], span[1] - value
    if abs(above - below) > LOPSIDED * (above + below):
        return f'{value:.3g} ({span[0]:.2g} to {span[1]:.2g})'
    return f'{value:.3g} +- {(below + above) / 2:.2g}'


def flown(result: dict) -> str:
    """What the gap was measured on."""
    return 'the held-out part of the log' if 'joints' in result else \
        'the held-out flights' if result['held_out'] else 'the fitted flights'


def _closing(result):
    if result['closure'] is None:
        return ''
    return f'Adding it closes {result["closure"]:.0%} of the gap on {flown(result)}.'


def _chance(result):
    chance = result.get('false_alarm_probability')
    if chance is None or chance >= 1:   # the evidence of the catalogue is against a gap
        return ''
    size = f'{chance:.1g}' if chance >= LEAST_CHANCE else f'below {LEAST_CHANCE:g}'
    return f'The probability of a false alarm is {size}.'


def _capital(text):
    return text[:1].upper() + text[1:]


def _list(value):
    return value if isinstance(value, list) else [value]


def grids(result: dict, brief: bool = True) -> list[Grid]:
    """
    Tables of damages, effects, gap, channels, groups and candidates.

    ``brief``: the largest rows, and groups only if one is not compared. Otherwise all but the
    candidates, which have a section of the page.
    """
    groups, where = result.get('groups', {}), whole(result)
    if brief:
        where = where[:SHOWN]
        groups = {} if all(group['used'] for group in groups.values()) else groups
    tables = [_damages(result['bad_data']), _effects(result), _formula(result), _gap(result),
              _channels(where), _groups(groups),
              evidence(result['candidates'], SHOWN if brief else 0)]
    return [grid for grid in tables if grid.rows]


def whole(result: dict) -> list[dict]:
    """Channels with errors before and after, over whole flights or logs."""
    return [row for row in result['where'] if 'excess_after' in row]


def _effects(result):
    rows = []
    for effect in result['effects'] or result['partial']:
        ln = f"{effect['evidence']['delta_bic'] / 2:.0f}"
        for first, one in [(label(effect), effect), *(
                (f'or {label(rival)}', rival) for rival in effect.get('rivals', []))]:
            for k, (name, entry) in enumerate(one['parameters'].items()):
                rows.append(['' if k else first, f"{name} [{entry['unit']}]",
                             _numbers(entry['value']), _spans(entry.get('interval')),
                             _numbers(entry['file']), '' if k or one is not effect else ln])
    title = 'Effects' if result['effects'] else 'Partial explanation, not accepted'
    return Grid(title, ['effect', 'parameter', 'value', '95 %', 'in the file', 'ln B'], rows,
                note='95 %: interval that contains the true value in 95 of 100 cases. ln B: '
                     'logarithm of the evidence with the effect over that without it; 3 is 20 to '
                     '1.')


def _formula(result):
    found = result.get('formula', {})
    if 'ranges' not in found:
        return Grid('', [], [])
    rows = []
    for term, size in result['effects'][-1]['parameters'].items():
        unit, words, symbols = described(term)
        rows.append([symbols, words, f"{size['value']:.3g} {unit}", _spans(size['interval'])])
    where = listed([f'{name} {low:g} to {high:g}'
                    for name, (low, high) in found['ranges'].items()])
    return Grid('Formula', ['term', 'in words', 'k', '95 %'], rows, note=(
        f"Error over noise floor {found['gap_before']:.2f} without it, {found['gap_after']:.2f} "
        f"with it: closure {found['closure']:.0%}. ln B {found['ln_bayes_factor']:.0f} after the "
        f"choice among {found['terms_tried']} terms. Determined at {where}."))


def _gap(result):
    if result['gap_before'] is None:
        return Grid('', [], [])
    rows = [[name, _cell(result[key])] for name, key in (
        ('robot file', 'gap_before'), ('with the named effects', 'gap_after'))]
    if not result['effects']:
        del rows[1]
    return Grid(f'Error over noise floor on {flown(result)}', ['model', 'error'], rows,
                note='1 is the error of the most flexible fit to the same data.' + (
                    '' if 'joints' in result else ' Tolerances are as fitted.'))


def _channels(where):
    header = ['channel', 'robot file', 'fit']
    if 'unit' not in (where or [{}])[0]:
        return Grid('Channels', header, [[row['channel'], _cell(row['excess']),
                                          _cell(row['excess_after'])] for row in where],
                    note='RMS error over noise floor.')
    rows = [[f"{row['channel']} [{row['unit']}]", f"{row['rms']:.3g}", f"{row['rms_after']:.3g}",
             _cell(row['excess']), _cell(row['excess_after']),
             f"{row['discrepancy_rms']:.2g}" if row['discrepancy_rms'] else ''] for row in where]
    return Grid('Channels', [*header, 'over noise', 'fit', 'in no entry'], rows,
                note='RMS of measured minus expected, in the unit and whitened over the noise. '
                     'fit: with effects, tolerances and sensors of each flight. in no entry: RMS '
                     'of what repeats and no entry of the catalogue explains.')


def _groups(groups):
    return Grid('Groups of channels', ['group', 'compared', 'reason'], [
        [name, ', '.join(c.rpartition('_')[2] for c in group['channels']) or 'no',
         group.get('reason', '')] for name, group in groups.items()])


def evidence(rows: list[dict], most: int) -> Grid:
    """Table of candidates, the first ``most``."""
    typical = any(row.get('expected_ln_bayes_factor') is not None for row in rows)
    shown = [[label(row), _cell(_half(row['evidence']['delta_bic'])),
              *([_cell(row['expected_ln_bayes_factor'])] if typical else []),
              'accepted' if row['accepted'] else row['reason']] for row in rows[:most]]
    note = 'ln B: evidence for the entry alone. typical: what an effect of typical size would ' \
        'have in the mean.' if typical else 'ln B: evidence beside the accepted entries.'
    return Grid('Candidates', ['entry', 'ln B', *(['typical'] if typical else []), 'decision'],
                shown, note=note)


def _half(value):
    return None if value is None else value / 2


def _damages(rows):
    shown = [[row['run'], row['topic'], row['cause'],
              ABSENT if row['at_s'] is None else f"{row['at_s']:.1f}", f"{row['sure']:.1%}",
              row['fix'] or 'no'] for row in rows]
    return Grid('Damages of the recordings',
                ['recording', 'topic', 'likely cause', 'from [s]', 'sure', '--fix'], shown,
                note='from: time after the first IMU message. sure: probability among the '
                     'compared causes. --fix: correction that the option applies.')


def _cell(value):
    return ABSENT if value is None or not np.isfinite(value) else f'{value:.2f}'


def _numbers(value):
    return ', '.join(f'{v:.4g}' for v in _list(value))


def _spans(interval):
    if interval is None:
        return ABSENT
    if not np.ptp(interval, axis=-1).any():
        return 'not fitted'
    if isinstance(interval[0], list):
        return ', '.join(f'{a:.3g}..{b:.3g}' for a, b in interval)
    return f'{interval[0]:.4g}..{interval[1]:.4g}'


def gap_page(result: dict, damaged: tuple[Recording, dict] | None = None) -> str:
    """One self-contained page; ``damaged``: a recording and the first of its damages."""
    notes = [f'Next experiment: {result["next_experiment"]}.'] \
        if result['next_experiment'] else []
    notes += dict.fromkeys(result['findings'])
    candidates, sections = result['candidates'], []
    if candidates:
        least = log(1 / result['meta']['alpha'])
        sections = [
            section('Evidence', 'Every entry of the catalogue that these flights were compared '
                    'with. An effect is named if its evidence outweighs the number of entries '
                    f'that were tried and the accepted probability of a false alarm ({least:.1f} '
                    'nat).', html(evidence(candidates, len(candidates)))),
            section('Tolerances', 'Deviations of this robot from the robot file, as fitted and '
                    'not named; --tolerances writes masses, gains, lags and rotor positions to '
                    'the robot file.', '<details><summary>All numbers</summary>'
                    f'{html(_tolerances(result))}</details>')]
    with matplotlib.rc_context(figures.STYLE):
        picture = figures.svg(_damage(*damaged), 'damaged readings') if damaged else figures.svg(
            picture_of(result), 'disagreement and sizes') if result['where'] else ''
    return page('Gap', _about(result['meta']), grids(result, brief=False), notes, sections,
                head(result, picture))


def _about(meta):
    """Flights and robot file in one line."""
    parts = {'flights': meta['runs'], 'held out': meta['holdout'],
             'robot file': [meta['robot']]}
    return '; '.join(f'{word}: {", ".join(runs)}' for word, runs in parts.items() if runs)


def head(result: dict, picture: str = '') -> str:
    """Head of the page: verdict, sentence and picture, as HTML."""
    return verdict_head(headline(result), VERDICT_COLOURS[result['verdict']], result['summary'],
                        picture)


def picture_of(result: dict) -> Figure:
    """Disagreement by channel before and after, and the sizes of the effects with intervals."""
    sizes = _sizes(result['effects'] or result['partial'])
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
    if sizes:
        _draw(axes[0, 1], sizes[::-1])
    return figure


def _draw(axis, sizes):
    for k, (_, middle, low, high) in enumerate(sizes):
        axis.plot([low, high], [k, k], color=figures.INK, lw=1.4)
        axis.plot(middle, k, 'o', color=figures.AFTER, ms=4)
    axis.axvline(0.0, color=figures.BEFORE, lw=0.9)
    axis.set_yticks(np.arange(len(sizes)), [text for text, *_ in sizes])
    axis.set_xlabel('deviation in typical sizes, 95 %')


def _sizes(effects):
    """Name, deviation and its interval of each number, over its typical deviation."""
    result = []
    for effect in effects:
        for name, found in effect['parameters'].items():
            values, file = np.atleast_1d(found['value']), np.atleast_1d(found['file'])
            spans = np.reshape(found['interval'], (-1, 2))
            for k, (value, own, span) in enumerate(zip(values, file, spans, strict=True)):
                more = f' {"xyz"[k]}' if len(values) == 3 else ''
                result.append((f'{label({**effect, "names": effect["names"][:1]})}\n{name}{more}',
                               *((x - own) / found['typical'] for x in (value, *span))))
    return result


def _tolerances(result):
    rows = [[name, f'{100 * e["deviation"]:.2f} %' if e['relative'] else f'{e["deviation"]:.2g}']
            for name, e in result['tolerances'].items()]
    return Grid('', ['number', 'deviation'], rows)


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
