"""All answers as numbers: the issue's criteria, with their intervals."""

from __future__ import annotations

from gap_data.cases import DIFFICULTIES
from gap_data.intervals import median, share

DELAY_LIMIT = 0.003  # [s]


def score(judged: list[dict]) -> dict:
    """
    Criteria by difficulty, and power.

    Args:
        judged: of :func:`gap_data.judge.judge`, one for each case.

    """
    return {'criteria': {d: criteria([j for j in judged if j['difficulty'] == d], d)
                         for d in DIFFICULTIES},
            'power': power(judged)}


def criteria(judged: list[dict], difficulty: str) -> list[dict]:
    """Each with name, value, interval, count, target and whether the value reaches it."""
    clean = difficulty == 'clean'
    of = {kind: [j for j in judged if j['kind'] == kind]
          for kind in {j['kind'] for j in judged}}
    singles, pairs, none = of.get('singles', []), of.get('pairs', []), of.get('none', [])
    outside, hover = of.get('outside', []), of.get('undecidable', [])
    broken = of.get('short', []) + of.get('damaged', [])
    rows = [row for j in singles + pairs for row in j['parameters']]
    known = [r for r in rows if not r['missing']]
    sized = [r for r in known if not r['delay']]
    delays = [r for r in known if r['delay']]
    flown = [j for j in judged if j['kind'] in ('singles', 'none', 'pairs', 'outside')]
    table = [
        ('single: named, or the right set', share([j['right'] for j in singles]),
         '>=', 0.97 if clean else 0.90),
        ('single: named exactly', share([all(j['exact']) for j in singles]), '>=', 0.80),
        ('single: any wrong name', share([bool(j['wrong']) for j in singles]), '<=', 0.05),
        ('none: false alarm', share([bool(j['wrong']) for j in none]), '<=', 0.05),
        *((f'none: false_alarm_probability of at most {alpha}', share(
            [j['chance'] <= alpha for j in none if j.get('chance') is not None]), '<=', alpha)
          for alpha in (0.05, 0.2)),
        ('none: says so', share([j['right'] for j in none]), '>=', 0.95),
        ('pair: both named', share([all(j['named']) for j in pairs]), '>=', 0.60),
        ('pair: at least one named', share([any(j['named']) for j in pairs]), '>=', 0.90),
        ('pair: any wrong name', share([bool(j['wrong']) for j in pairs]), '<=', 0.10),
        ('outside the catalogue: unknown', share([j['right'] for j in outside]), '>=', 0.80),
        ('outside the catalogue: wrong name', share([bool(j['wrong']) for j in outside]),
         '<=', 0.10),
        ('undecidable: says so', share([j['right'] for j in hover]), '>=', 0.90),
        ('undecidable: names the experiment', share([j['next_experiment'] for j in hover]),
         '>=', 0.90),
        ('short or damaged: honest, no wrong name', share([j['right'] for j in broken]),
         '>=', 0.95),
        ('no traceback, no missing answer', share([not j['crashed'] for j in judged]), '>=', 1.0),
        ('parameter error, of the effect', median([r['of_effect'] for r in sized]), '<=',
         0.03 if clean else 0.10),
        ('parameter error, of the value', median([r['of_value'] for r in sized]), '<=', None),
        ('delay error [s]', median([r['error'] for r in delays]), '<=', DELAY_LIMIT),
        ('delays within 3 ms', share([r['error'] <= DELAY_LIMIT for r in delays]), '>=', 0.9),
        ('interval covers the truth', share([i for r in known for i in r['inside']]), 'in',
         [0.90, 0.98]),
        ('parameter reported', share([not r['missing'] for r in rows]), '>=', 1.0),
        ('closure, single', median([_closure(j) for j in singles]), '>=', 0.8),
        ('closure, pair', median([_closure(j) for j in pairs]), '>=', 0.6),
        ('held-out gap worse by over 5 %', share([_worse(j) for j in flown]), '<=', 0.0),
        ('wall time of a case [s]', median([j['wall_s'] for j in flown]), '<=', 30.0),
        ('CPU time of a case [s]', median([j['cpu_s'] for j in flown]), '<=', None),
        ('longest case [s]', _largest([j['wall_s'] for j in flown]), '<=', 30.0),
        ('JSON as the interface says', share([not j['problems'] for j in judged
                                              if j['verdict'] != 'refused']), '>=', 1.0)]
    return [{'name': name, **number, 'relation': relation, 'target': target,
             'reached': _reached(number['value'], relation, target)}
            for name, number, relation, target in table]


def _closure(j):
    return 0.0 if j['closure'] is None else j['closure']


def _worse(j):
    if j['gap_before'] is None or j['gap_after'] is None:
        return False
    return j['gap_after'] > 1.05 * j['gap_before']


def _largest(values):
    return {'value': max(values) if values else None, 'interval': None, 'count': len(values)}


def _reached(value, relation, target):
    if value is None or target is None:
        return None
    if relation == 'in':
        return target[0] <= value <= target[1]
    return value >= target if relation == '>=' else value <= target


def power(judged: list[dict]) -> list[dict]:
    """Share named by multiple of the detection limit, over effects; wrong names beside."""
    multiples = sorted({j['multiple'] for j in judged if j['kind'] == 'power'})
    rows = []
    for multiple in multiples:
        chosen = [j for j in judged if j['kind'] == 'power' and j['multiple'] == multiple]
        rows.append({'multiple': multiple, 'named': share([j['right'] for j in chosen]),
                     'wrong': share([bool(j['wrong']) for j in chosen]),
                     'effects': {j['truth'][0]: j['right'] for j in chosen}})
    return rows
