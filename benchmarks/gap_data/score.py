"""All answers as numbers with the interval in which they lie with 95 %, and as a page."""

from functools import partial

import numpy as np
from scipy.stats import binomtest

from gap_data.cases import DIFFICULTIES

NOTHING = {'value': None, 'interval': None, 'count': 0}
LEGEND = ('`**` misses its target; in brackets the 95 % interval, in parentheses the number of '
          'cases or values.')


def proportion(hits: list[bool], method: str) -> dict:
    """Proportion with its interval, 'wilson' or 'exact'; None without any case."""
    if not hits:
        return NOTHING
    found = binomtest(sum(map(bool, hits)), len(hits))
    return {'value': found.statistic, 'count': len(hits),
            'interval': list(found.proportion_ci(method=method))}


def median(values: list[float | None], draws: int = 1000) -> dict:
    """Median with a bootstrap interval (percentiles)."""
    numbers = np.array([v for v in values if v is not None])
    if not len(numbers):
        return NOTHING
    rng = np.random.default_rng(0)
    medians = np.median(rng.choice(numbers, (draws, len(numbers))), axis=1)
    return {'value': float(np.median(numbers)), 'count': len(numbers),
            'interval': np.percentile(medians, [2.5, 97.5]).tolist()}


def score(judged: list[dict]) -> dict[str, list[dict]]:
    """Criteria by difficulty, of cases judged by :func:`gap_data.judge.judge`."""
    return {d: criteria([j for j in judged if j['difficulty'] == d], d) for d in DIFFICULTIES}


def criteria(judged: list[dict], difficulty: str, method: str = 'wilson') -> list[dict]:
    """Each with name, value, interval, count, target and whether the value reaches it."""
    clean, share = difficulty == 'clean', partial(proportion, method=method)
    singles, none, pairs, outside, hover = ([j for j in judged if j['kind'] == kind] for kind in (
        'singles', 'none', 'pairs', 'outside', 'undecidable'))
    rows = [row for j in singles + pairs for row in j['parameters']]
    table = [
        ('single: named, or the right set', share([j['right'] for j in singles]),
         '>=', 0.97 if clean else 0.90),
        ('single: any wrong name', share([bool(j['wrong']) for j in singles]), '<=', 0.05),
        ('none: false alarm', share([bool(j['wrong']) for j in none]), '<=', 0.05),
        *((f'none: false_alarm_probability of at most {alpha}', share(
            [j['chance'] <= alpha for j in none if j.get('chance') is not None]), '<=', alpha)
          for alpha in (0.05, 0.2)),
        ('none: says so', share([j['right'] for j in none]), '>=', 0.95),
        ('pair: both named', share([all(j['named']) for j in pairs]), '>=', 0.60),
        ('pair: any wrong name', share([bool(j['wrong']) for j in pairs]), '<=', 0.10),
        ('outside the catalogue: unknown', share([j['right'] for j in outside]), '>=', 0.80),
        ('outside the catalogue: wrong name', share([bool(j['wrong']) for j in outside]),
         '<=', 0.10),
        ('undecidable: says so', share([j['right'] for j in hover]), '>=', 0.90),
        ('undecidable: names the experiment', share([j['next_experiment'] for j in hover]),
         '>=', 0.90),
        ('no traceback, no missing answer', share([not j['crashed'] for j in judged]), '>=', 1.0),
        ('JSON as the interface says', share([not j['problems'] for j in judged]), '>=', 1.0),
        ('parameter error, of the effect',
         median([r['of_effect'] for r in rows if not r['delay']]), '<=', 0.03 if clean else 0.10),
        ('delay error [s]', median([r['error'] for r in rows if r['delay']]), '<=', 0.003),
        ('interval covers the truth', share([i for r in rows for i in r['inside']]), 'in',
         [0.90, 0.98]),
        ('closure, single', median([j['closure'] or 0.0 for j in singles]), '>=', 0.8),
        ('closure, pair', median([j['closure'] or 0.0 for j in pairs]), '>=', 0.6),
        ('held-out gap worse by over 5 %', share([_worse(j) for j in judged]), '<=', 0.0),
        ('wall time of a case [s]', median([j['wall_s'] for j in judged]), '<=', 30.0),
        ('CPU time of a case [s]', median([j['cpu_s'] for j in judged]), '<=', None)]
    return [{'name': name, **number, 'relation': relation, 'target': target,
             'reached': _reached(number['value'], relation, target)}
            for name, number, relation, target in table]


def _worse(j):
    return j['gap_before'] is not None and j['gap_after'] > 1.05 * j['gap_before']


def _reached(value, relation, target):
    if value is None or target is None:
        return None
    if relation == 'in':
        return bool(target[0] <= value <= target[1])
    return bool(value >= target if relation == '>=' else value <= target)


def markdown(report: dict) -> str:
    """The criteria as a page."""
    lines = ['# Blind campaign', '', f'{report["meta"]["cases"]} cases: '
             f'`{report["meta"]["command"]}`', '']
    for difficulty, rows in report['criteria'].items():
        if any(row['count'] for row in rows):
            lines += [f'## {difficulty.capitalize()} flights', '', *table(rows), '']
    return '\n'.join([*lines, LEGEND]) + '\n'


def table(rows: list[dict]) -> list[str]:
    """Lines of a table of criteria."""
    return ['| | target | |', '|---|---|---|', *(
        f'| {row["name"]} | {_target(row)} | {_number(row)} |' for row in rows)]


def _number(row):
    if row['value'] is None:
        return '-'
    low, high = row['interval']
    return f'{row["value"]:.3g} [{low:.2g}, {high:.2g}] ({row["count"]})' + (
        ' **' if row['reached'] is False else '')


def _target(row):
    if row['target'] is None:
        return ''
    return '{:g} to {:g}'.format(*row['target']) if row['relation'] == 'in' \
        else f'{row["relation"]} {row["target"]:g}'
