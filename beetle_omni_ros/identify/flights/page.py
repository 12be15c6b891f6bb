"""Results of `beetle_omni gap` as one sentence and as tables."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.formula import described
from beetle_omni_ros.show.page import ABSENT, Grid

WORDS = {'no_gap': 'no gap', 'named': 'named', 'named_set': 'one of a set',
         'unknown': 'unknown: none of the known effects', 'not_decidable': 'not decidable',
         'bad_data': 'bad data: a recording cannot be used'}
MOST_NAMED = 6          # entries of a list in a sentence
LOPSIDED = 0.2          # asymmetry of an interval from which a sentence states both ends
SPELLED = {'imu': 'IMU', 'mocap': 'MoCap'}
SHOWN = 6               # channels and candidates in the terminal
LEAST_CHANCE = 1e-6     # below, a probability is not stated as a number


def headline(result: dict) -> str:
    """Verdict and named effects."""
    names = ', '.join(label(effect) for effect in result['effects'])
    return f"{WORDS[result['verdict']]}{': ' + names if names else ''}"


def label(effect: dict) -> str:
    """Names of an effect or candidate with the number of its rotor or joint."""
    if len(effect.get('members', [])) > 1:
        return ' or '.join(effect['members'])
    return ' '.join([' or '.join(effect.get('names') or [effect['name']]), *(
        str(effect[kind]) for kind in ('rotor', 'joint', 'term') if effect.get(kind))])


def first_label(effect: dict) -> str:
    """Name of the first of the entries that an effect may be, with its rotor or joint."""
    return label({**effect, 'names': effect['names'][:1], 'members': []})


def numbers(found: dict) -> np.ndarray:
    """(n, 4) value, interval and value of the robot file of each number of a parameter."""
    return np.column_stack([np.atleast_1d(found['value']), np.reshape(found['interval'], (-1, 2)),
                            np.atleast_1d(found['file'])])


def summary(result: dict) -> str:
    """The verdict as one or two sentences."""
    verdict, reason, chance = (result[key] for key in (
        'verdict', 'reason', 'false_alarm_probability'))
    # without evidence against it, no gap is more likely
    odds = '' if chance is None or chance >= 1 else ' The probability of a false alarm is ' + (
        f'{chance:.1g}.' if chance >= LEAST_CHANCE else f'below {LEAST_CHANCE:g}.')
    if verdict in ('named', 'named_set'):
        effects = [_effect_text(effect) for effect in result['effects']]
        explain = 'explain' if len(effects) > 1 else 'explains'
        closing = '' if result['closure'] is None else (
            f' Adding it closes {result["closure"]:.0%} of the gap on {flown(result)}.')
        return f'{_capital(listed(effects))} {explain} the disagreement.{closing}{odds}'
    if verdict == 'no_gap':
        text = 'Model and measurement agree to within noise and manufacturing tolerance.'
        if not result['hidden']:
            return f'{text} Every known effect of typical size would have been detected.'
        sizes = [_spelled(row['name']) + ('' if row['seen_from']['value'] is None else (
            f" below {_seen_text(row, 'value')}")) for row in visible(result['candidates'])
            if row['name'] in result['hidden']]
        return f'{text} Not visible in these data would be: {listed(sizes, "or")}.'
    if verdict == 'not_decidable':
        return f'These data cannot decide: {reason}.'
    if verdict == 'unknown':
        partial = [' or '.join(effect['names']) for effect in result['partial']]
        part = f' {_capital(listed(partial))} would explain a part.' if partial else ''
        return f'No known effect explains the disagreement: {reason}.{part}{odds}'
    further = len(result['bad_data']) - 1
    return (reason if reason.endswith('?') else f'{reason}.') + (
        f' {further} more {"fault is" if further == 1 else "faults are"} listed below.'
        if further > 0 else '')


def listed(words: list[str], last: str = 'and') -> str:
    """Join words as 'a, b and c'; a long list ends with the number of others."""
    if len(words) > MOST_NAMED:
        words = [*words[:MOST_NAMED - 1], f'{len(words) - MOST_NAMED + 1} others']
    words = [_spelled(word) for word in words]
    return f' {last} '.join(filter(None, [', '.join(words[:-1]), *words[-1:]]))


def _spelled(name):
    return ' '.join(SPELLED.get(word, word) for word in name.replace('_', ' ').split(' '))


def _capital(text):
    return text[:1].upper() + text[1:]


def _effect_text(effect):
    several = len(effect.get('members', [])) > 1
    names = ' or '.join(map(_spelled, effect['members' if several else 'names']))
    member = ''.join(f' of {kind} {effect[kind]}' for kind in ('rotor', 'joint', 'term')
                     if effect.get(kind) and not several)
    parameter, found = next(iter(effect['parameters'].items()))
    rows = numbers(found)
    unit = '' if found['unit'] == '1' else f' {found["unit"]}'
    sizes = ', '.join(_size(*row[:3]) for row in rows)
    file = ', '.join(f'{own:.3g}' for own in rows[:, 3]) + unit if rows[:, 3].any() else 'none'
    what = f'{parameter}; ' if len(CATALOGUE[effect['names'][0]].parameters) > 1 else ''
    return f'{names}{member} of {sizes}{unit} ({what}robot file: {file})'


def _size(value, low, high):
    below, above = value - low, high - value
    if abs(above - below) > LOPSIDED * (above + below):
        return f'{value:.3g} ({low:.2g} to {high:.2g})'
    return f'{value:.3g} +- {(below + above) / 2:.2g}'


def flown(result: dict) -> str:
    """What the gap was measured on."""
    return 'the held-out part of the log' if 'joints' in result else \
        'the held-out flights' if result['held_out'] else 'the fitted flights'


def grids(result: dict, brief: bool = True) -> list[Grid]:
    """
    Tables of damages, effects, gap, channels, groups and candidates.

    ``brief``: the largest rows, and groups only if one is not compared. Otherwise all but the
    candidates, which have a section of the page.
    """
    groups, where = result['groups'], whole(result)[:SHOWN if brief else None]
    if brief and all(group['used'] for group in groups.values()):
        groups = {}
    tables = [_damages(result['bad_data']), _effects(result), _formula(result), _gap(result),
              _channels(where), _groups(groups)]
    if brief:
        tables.append(evidence(result['candidates'][:SHOWN]))
        if result['verdict'] in ('no_gap', 'not_decidable'):
            tables.append(seen(visible(result['candidates'])[:SHOWN]))
    return [grid for grid in tables if grid.rows]


def whole(result: dict) -> list[dict]:
    """Channels with errors before and after, over whole flights or logs."""
    return [row for row in result['where'] if 'excess_after' in row]


def _effects(result):
    rows = []
    for effect in result['effects'] or result['partial']:
        ones = [(first_label(effect), effect, f"{effect['evidence']['ln_bayes_factor']:.0f}"),
                *((f'or {label(rival)}', rival, '') for rival in effect.get('rivals', []))]
        for first, one, ln in ones:
            for name, found in one['parameters'].items():
                own = numbers(found)
                rows.append([first, f"{name} [{found['unit']}]", _joined(own[:, 0]),
                             _spans(own), _joined(own[:, 3]), ln])
                first = ln = ''
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
        rows.append([symbols, words, f"{size['value']:.3g} {unit}", _spans(numbers(size))])
    where = listed([f'{name} {low:g} to {high:g}'
                    for name, (low, high) in found['ranges'].items()])
    return Grid('Formula', ['term', 'in words', 'k', '95 %'], rows, note=(
        f"Error over noise floor {found['gap_before']:.2f} without it, {found['gap_after']:.2f} "
        f"with it: closure {found['closure']:.0%}. ln B {found['ln_bayes_factor']:.0f} after the "
        f"choice among {found['terms_tried']} terms. Determined at {where}."))


def _gap(result):
    rows = [[name, _cell(result[key])] for name, key, shown in (
        ('robot file', 'gap_before', result['gap_before'] is not None),
        ('with the named effects', 'gap_after', result['effects'])) if shown]
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


def evidence(rows: list[dict]) -> Grid:
    """Table of candidates."""
    how = 'for the entry alone' if any('seen_from' in row for row in rows) else \
        'beside the accepted entries'
    return Grid('Candidates', ['entry', 'ln B', 'decision'], [
        [label(row), _cell(row['evidence']['ln_bayes_factor']),
         'accepted' if row['accepted'] else row['reason']] for row in rows],
        note=f'ln B: evidence {how}.')


def size_seen(row: dict) -> float:
    """Least size of a candidate that would have been named, over its typical size; 0: a limit."""
    seen = row['seen_from']
    return np.inf if seen['value'] is None else seen['value'] / (seen['typical'] or np.inf)


def visible(rows: list[dict]) -> list[dict]:
    """Candidates, each name with its most visible member; the least visible first."""
    best: dict[str, dict] = {}
    for row in rows:
        if 'seen_from' in row:
            best[row['name']] = min(best.get(row['name'], row), row, key=size_seen)
    return sorted(best.values(), key=size_seen, reverse=True)


def seen(rows: list[dict]) -> Grid:
    """Table of the sizes from which effects would have been named."""
    return Grid('What would have been seen', ['effect', 'from', 'typical'], [
        [_spelled(row['name']), _seen_text(row, 'value'), _seen_text(row, 'typical')]
        for row in visible(rows)], note=(
            'from: size that these flights would have shown in the mean; smaller ones may be '
            'there. %: of the value in the robot file. A limit is seen at this value or below.'))


def _seen_text(row, key):
    value = row['seen_from'][key]
    if value is None:
        return 'not by these flights' if key == 'value' else ''
    return f"{value:.2g} {row['seen_from']['unit']}".removesuffix(' 1')


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


def _joined(values):
    return ', '.join(f'{value:.4g}' for value in values)


def _spans(rows):
    if (rows[:, 1] == rows[:, 2]).all():
        return 'not fitted'
    digits = 4 if len(rows) == 1 else 3
    return ', '.join(f'{low:.{digits}g}..{high:.{digits}g}' for _, low, high, _ in rows)
