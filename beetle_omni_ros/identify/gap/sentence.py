"""What an engineer would say of an analysis, in one sentence."""

from __future__ import annotations

from beetle_omni_ros.robot.effects import CATALOGUE

MOST_NAMED = 6          # entries in a list before it is cut


def summary(made: dict) -> str:
    """
    Say the verdict as one sentence.

    Args:
        made: results as INTERFACES lays them out.

    """
    return _SENTENCES[made['verdict']](made)


def _bad_data(made):
    return made['reason'] + '.'


def _no_gap(made):
    unseen = made.get('hidden') or []
    text = 'Model and measurement agree to within noise and manufacturing tolerance.'
    if 'joints' in made:
        return text
    if not unseen:
        return f'{text} Every known effect of realistic size would have shown.'
    return f'{text} A realistic {listed(unseen, "or")} would not have shown in these data.'


def _named(made):
    parts = [_effect(effect) for effect in made['effects']]
    return f'{_capital(listed(parts))}: the robot file lacks this. {_closing(made)}'


def _unknown(made):
    partial = [' or '.join(e['names']) for e in made.get('partial') or []]
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
    words = [word.replace('_', ' ') for word in words]
    return f' {last} '.join(filter(None, [', '.join(words[:-1]), words[-1] if words else '']))


def _effect(effect):
    names = [name.replace('_', ' ') for name in effect['names']]
    member = next((f' of {kind} {effect[kind]}' for kind in ('rotor', 'joint')
                   if effect.get(kind)), '')
    parameter, found = next(iter(effect['parameters'].items()))
    shapes = CATALOGUE[effect['names'][0]].parameters
    value = found['value'] if isinstance(found['value'], list) else [found['value']]
    spans = found.get('interval') or []
    spans = spans if spans and isinstance(spans[0], list) else [spans]
    sizes = ', '.join(_size(v, span) for v, span in zip(value, spans, strict=False))
    unit = '' if found['unit'] == '1' else f' {found["unit"]}'
    what = f' ({parameter})' if len(shapes) > 1 else ''
    return f'{" or ".join(names)}{member} of {sizes}{unit}{what}'


def _size(value, span):
    if not span:
        return f'{value:.3g}'
    return f'{value:.3g} +- {(span[1] - span[0]) / 2:.2g}'


def _closing(made):
    if made.get('closure') is None:
        return 'The gap in free runs is at its noise floor before and after.'
    flights = 'the held-out part of the log' if 'joints' in made else \
        'the held-out flight' if made.get('held_out') else 'the fitted flights'
    return f'Adding it closes {made["closure"]:.0%} of the gap on {flights}.'


def _capital(text):
    return text[:1].upper() + text[1:]
