"""What an engineer would say of an analysis, in one sentence."""

from __future__ import annotations

from beetle_omni_ros.robot.effects import CATALOGUE

MOST_NAMED = 6          # entries in a list before it is cut
LOPSIDED = 0.2          # of an interval's width, from which both ends are said
# Words that are no words of a sentence.
SPELLED = {'imu': 'IMU', 'mocap': 'MoCap'}


def summary(made: dict) -> str:
    """
    Say the verdict as one sentence.

    Args:
        made: results as INTERFACES lays them out.

    """
    return _SENTENCES[made['verdict']](made)


def _bad_data(made):
    text = made['reason'] if made['reason'].endswith('?') else f'{made["reason"]}.'
    further = len(made['bad_data']) - 1
    if further > 0:
        text += f' {further} more {"fault is" if further == 1 else "faults are"} listed below.'
    return text


def _no_gap(made):
    unseen = made.get('hidden') or []
    text = 'Model and measurement agree to within noise and manufacturing tolerance.'
    if not unseen:
        return f'{text} Every known effect of realistic size would have shown.'
    return f'{text} A realistic {listed(unseen, "or")} would not have shown in these data.'


def _named(made):
    parts = [_effect(effect) for effect in made['effects']]
    explain = 'explain' if len(parts) > 1 else 'explains'
    return f'{_capital(listed(parts))} {explain} the disagreement. {_closing(made)}'


def _unknown(made):
    partial = [' or '.join(e['names']) for e in made.get('partial') or []
               if e['names'][0] not in made['reason']]
    tried = f' {_capital(listed(partial))} would explain a part.' if partial else ''
    return f'No known effect explains the disagreement: {made["reason"]}.{tried}'


def _not_decidable(made):
    return f'These data cannot decide: {made["reason"]}.'


_SENTENCES = {'bad_data': _bad_data, 'no_gap': _no_gap, 'named': _named, 'named_set': _named,
              'unknown': _unknown, 'not_decidable': _not_decidable}


def listed(words: list[str], last: str = 'and') -> str:
    """Join words as 'a, b and c', the rest counted where there are many."""
    words = list(words)
    if len(words) > MOST_NAMED:
        words = [*words[:MOST_NAMED - 1], f'{len(words) - MOST_NAMED + 1} others']
    words = [_spelled(word) for word in words]
    return f' {last} '.join(filter(None, [', '.join(words[:-1]), words[-1] if words else '']))


def _spelled(name):
    return ' '.join(SPELLED.get(word, word) for word in name.replace('_', ' ').split(' '))


def _of_file(found):
    """What the robot file has in place of a parameter."""
    own = found['file'] if isinstance(found['file'], list) else [found['file']]
    if not any(own):
        return 'none'
    text = ', '.join(f'{value:.3g}' for value in own)
    return text if found['unit'] == '1' else f'{text} {found["unit"]}'


def _effect(effect):
    names = [_spelled(name) for name in effect['names']]
    member = next((f' of {kind} {effect[kind]}' for kind in ('rotor', 'joint')
                   if effect.get(kind)), '')
    parameter, found = next(iter(effect['parameters'].items()))
    shapes = CATALOGUE[effect['names'][0]].parameters
    value = found['value'] if isinstance(found['value'], list) else [found['value']]
    spans = found.get('interval') or []
    spans = spans if spans and isinstance(spans[0], list) else [spans]
    sizes = ', '.join(_size(v, span) for v, span in zip(value, spans, strict=False))
    unit = '' if found['unit'] == '1' else f' {found["unit"]}'
    what = f'{parameter}; ' if len(shapes) > 1 else ''
    return (f'{" or ".join(names)}{member} of {sizes}{unit} ({what}robot file: '
            f'{_of_file(found)})')


def _size(value, span):
    if not span:
        return f'{value:.3g}'
    below, above = value - span[0], span[1] - value
    if abs(above - below) > LOPSIDED * (above + below):
        return f'{value:.3g} ({span[0]:.2g} to {span[1]:.2g})'
    return f'{value:.3g} +- {(below + above) / 2:.2g}'


def _closing(made):
    if made.get('closure') is None:
        return 'The gap in free runs is at its noise floor before and after.'
    flights = 'the held-out part of the log' if 'joints' in made else \
        'the held-out flight' if made.get('held_out') else 'the fitted flights'
    return f'Adding it closes {made["closure"]:.0%} of the gap on {flights}.'


def _capital(text):
    return text[:1].upper() + text[1:]
