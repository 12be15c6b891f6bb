"""Results of an analysis of flights, as they are written as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import compress
from math import exp, log

import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.flights.balance import Balance
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.evidence import log_prior, Posterior, Solution
from beetle_omni_ros.identify.flights.keys import Entry, Key
from beetle_omni_ros.identify.flights.page import size_seen, summary, visible
from beetle_omni_ros.identify.flights.quality import (
    errors,
    Unexplained,
    unexplained,
    where_of,
)
from beetle_omni_ros.identify.flights.treatment import separating_experiment, TREATMENTS
from beetle_omni_ros.model.effects import CATALOGUE

ALPHA = 0.05            # probability of a false alarm that is accepted
CROWD = 4               # members of a set from which the flights do not decide
NAMING = 'named', 'named_set'
WIDEST = 9.0            # typical deviations of the widest prior of an entry
TESTS = 3               # of what is unexplained; they share the accepted probability
MOST_FED_BACK = 2       # entries that feedback may exclude; with more, the loop hides the robot,
SUBSTANTIAL = log(10) / 2   # [nat] and only entries with such evidence of one value are named;
                        # "substantial" on the scale of Jeffreys (Theory of Probability, 1961)
FORM_DEVIATION = 0.1    # of a value: deviation by the error of form of its law
MINOR = 0.1             # share of the gain of what repeats below which names explain too little
STILL = 'noise hides the motion, so that only means are compared'
Starts = dict[str, dict[str, float]]


def result_of(verdict: str, groups: dict, reason: str = '', **more) -> dict:
    """
    Results with all fixed keys.

    Flights that do not show most of the catalogue decide nothing.

    Args:
        verdict: a key of :data:`~beetle_omni_ros.identify.flights.page.WORDS`.
        groups: each group of channels: ``used``, ``channels``, and ``reason`` if not, or
            if only a part is.
        reason: why no effect is named, as the end of a sentence.
        more: further keys, and those that have another value than that of bad data.

    """
    result: dict = {
        'verdict': verdict, 'reason': reason, 'effects': [], 'partial': [], 'where': [],
        'closure': None, 'gap_before': None, 'gap_after': None, 'noise_floor': None,
        'candidates': [], 'hidden': [], 'tolerances': {}, 'false_alarm_probability': None,
        'held_out': False, 'groups': groups, 'bad_data': [], 'findings': [],
        'next_experiment': None, 'next_flight': None, 'meta': {'version': __version__}} | more
    seen = {row['name'] for row in result['candidates']} - set(result['hidden'])
    if verdict == 'no_gap' and len(result['hidden']) > len(seen):
        result |= {'verdict': (verdict := 'not_decidable'), 'reason': (
            'most known effects would not have been detected at their typical size')}
    unclear = [effect['names'] for effect in [*result['effects'], *result['partial']]
               if len(effect['names']) > 1]
    if unclear:
        result['next_experiment'] = separating_experiment(unclear[0])
    elif verdict == 'not_decidable' and result['hidden']:
        result['next_experiment'] = Counter(
            TREATMENTS[name].excited_by for name in result['hidden']).most_common(1)[0][0]
    return result | {'summary': summary(result)}


def concluded(engine: Engine, solution: Solution, keys: dict[str, Key], judges: list,
              groups: dict, held_out: bool, starts: Starts | None = None,
              findings: Sequence[str] = (), slow: Balance | None = None,
              measured: bool = True) -> dict:
    """
    Results of a solution.

    Args:
        engine: with the fitted flights.
        solution: of the engine.
        keys: keys by name.
        judges: flights that the errors are about.
        groups: as of :func:`result_of`.
        held_out: whether the judges are other flights than the fitted ones.
        starts: as of :class:`~beetle_omni_ros.identify.flights.bag_flight.BagFlight`.
        findings: sentences about the flights.
        slow: balance of torques; the mean of both e-values is one.
        measured: whether forces are those of an accelerometer. What an estimator makes of the
            motion repeats as well, and is no force.

    """
    alpha = engine.alpha
    tests: list[tuple] = [(engine, solution, keys), *([(slow, slow, slow.keys)] if slow else [])]
    e_value = float(np.logaddexp.reduce([s.e_value for _, s, _ in tests])) - log(len(tests))
    chance, hides = exp(min(0.0, -e_value)), len(solution.banned) > MOST_FED_BACK
    found = [(e, s, own, k, members) for e, s, own in tests if chance <= alpha
             for k, members in named_of(e, s, alpha) if not hides or e is engine and steady(s, k)]
    if hides and not found:     # no alpha names anything
        chance = 1.0
    effects = [effect_of(s, e, own, k, members, starts) for e, s, own, k, members in found]
    weak = [effect for effect, (e, *_) in zip(effects, found, strict=True) if e is slow]
    keep = [one[0] is slow or not of_a_rotor(effect, weak)
            for one, effect in zip(found, effects, strict=True)]
    found, effects = list(compress(found, keep)), list(compress(effects, keep))
    taken = [[k for e, _, _, k, _ in found if e is test[0]] for test in tests]
    sets = [list(dict.fromkeys(s.entries[j].label if e is slow else s.entries[j].name
                               for j in members)) for e, s, _, _, members in found]
    rows = [row for (e, s, own), named in zip(tests, taken, strict=True) for row in candidates_of(
        e, s, own, named, starts or {}, alpha / len(tests))]
    rest = unexplained(engine, solution) if measured else []
    fed_back = sorted(solution.entries[k].name.replace('_', ' ') for k in solution.banned)
    likely = known_of(engine, solution, alpha) if not sets and repeating(rest, alpha) else []
    verdict, reason = verdict_of(chance, sets, rest, fed_back, alpha, max(
        (effect['evidence']['ln_bayes_factor'] for effect in effects), default=0.0), likely)
    return result_of(
        verdict, {**groups, **{kind: groups[kind] | {'reason': STILL}
                               for kind in engine.without_motion()}}, reason,
        effects=[effect for effect, members in zip(effects, sets, strict=True)
                 if verdict in NAMING and len(members) < CROWD],
        partial=[effect for effect, members in zip(effects, sets, strict=True)
                 if verdict not in NAMING or len(members) >= CROWD],
        candidates=sorted(rows, key=_rank, reverse=True),
        hidden=[row['name'] for row in visible(rows) if size_seen(row) > 1],
        where=where_of(engine, solution), false_alarm_probability=chance,
        held_out=held_out, findings=[*findings, *varied(engine, solution), *(
            test.sentence[:1].upper() + test.sentence[1:] for test in rest
            if test.probability < alpha / TESTS and verdict != 'unknown' and not likely)],
        **numbers_of(engine, solution, taken[0] if verdict in NAMING else [], judges))


def named_of(engine: Engine, solution: Solution, alpha: float) -> list[tuple[int, list[int]]]:
    """
    Entries of the best set that the flights need, with those that could stand in their place.

    An entry is needed if the set without it is less probable by ``alpha``. Its rivals are the
    entries whose set in its place is more probable than ``alpha`` of the best one.
    """
    best, gain = solution.best, engine.gain
    named = []
    for k in best:
        if solution.entries[k].varying:
            continue
        rest = set(best) - {k}
        needed = gain(solution.judge, best, tuple(sorted(rest)))
        if needed < log(1 / alpha):
            continue
        rivals = [(gain(solution.judge, tuple(sorted(rest | {j})), best), j)
                  for j in range(len(solution.entries))
                  if j not in best and j not in solution.banned
                  and (solution.entries[j].name != solution.entries[k].name
                       or not solution.entries[j].varying)]
        members = [k, *(j for less, j in sorted(rivals, reverse=True) if less > log(alpha))]
        named.append((-needed, k, members))
    return [(k, members) for _, k, members in sorted(named)]


def steady(solution: Solution, k: int) -> bool:
    """Whether an entry is out of the loop, or the bands show that it has one value."""
    return -solution.unsteady.get(k, -np.inf) >= SUBSTANTIAL


def effect_of(solution: Solution, engine: Engine, keys: dict[str, Key], k: int,
              members: list[int], starts: Starts | None = None) -> dict:
    """Names, sizes and evidence of a named entry; ``starts`` as of :class:`BagFlight`."""
    entry, rest = solution.entries[k], set(solution.best) - {k}
    gain = engine.gain(solution.judge, solution.best, tuple(sorted(rest)))

    def sizes(j):
        index = sorted(engine.indices(tuple(rest | {j})))
        return parameters(solution.entries[j], engine, index, solution.judge.posterior(index),
                          keys, starts or {})

    result: dict = {
        'names': list(dict.fromkeys(solution.entries[j].name for j in members)),
        'members': list(dict.fromkeys(solution.entries[j].label for j in members)),
        'parameters': sizes(k), 'layer': CATALOGUE[entry.name].layer, **member_of(entry),
        'evidence': _evidence(gain)}
    if rivals := [{'name': solution.entries[j].name, **member_of(solution.entries[j]),
                   'parameters': sizes(j)} for j in members[1:]]:
        result['rivals'] = rivals
    return result


def repeating(rest: list[Unexplained], alpha: float) -> bool:
    """Whether a test shows what no entry of the best set explains."""
    return bool(rest) and rest[0].probability < alpha / TESTS


def known_of(engine: Engine, solution: Solution, alpha: float) -> list[str]:
    """
    Entries that explain what repeats, although too few blocks show them for a name.

    Empty if it repeats beside the most likely entries as well.
    """
    likely = engine.likely(solution)
    if set(likely.best) <= set(solution.best) or repeating(unexplained(engine, likely), alpha):
        return []
    return list(dict.fromkeys(likely.entries[k].name for k in likely.best))


def of_a_rotor(effect: dict, slow: list[dict]) -> bool:
    """
    Whether the forces show all rotors as weak because one is.

    Args:
        effect: named by the forces.
        slow: effects that the balance of torques names.

    """
    thrust, = [one['parameters']['scale'] for one in [effect, *effect.get('rivals', [])]
               if 'thrust_coefficient' in (one.get('name'), one.get('names', [''])[0])] or [None]
    rotors = [one['parameters']['scale'] for each in slow for one in [
        each, *each.get('rivals', [])] if 'rotor' in one]
    return thrust is not None and any(
        thrust['interval'][0] <= thrust['file'] * (3 + rotor['value'] / rotor['file']) / 4
        <= thrust['interval'][1] for rotor in rotors)


def member_of(entry: Entry) -> dict[str, int]:
    """Number of the rotor or joint of an entry of one of them."""
    return {CATALOGUE[entry.name].each or 'joint': entry.member} \
        if entry.member is not None else {}


def parameters(entry: Entry, engine: Engine, index: list[int], posterior: Posterior,
               keys: dict[str, Key], starts: Starts) -> dict:
    """
    Parameter -> value, unit, 95 % interval, value of the robot file and typical deviation.

    Args:
        entry: the entry.
        engine: for the index of each key.
        index: keys of the set that ``posterior`` is about.
        posterior: estimate of a set that has the entry.
        keys: keys by name.
        starts: name of a start -> deviations of the keys of its effect.

    """
    found = {}
    # key -> factors of the set's keys that make its deviation
    rows: dict[str, np.ndarray] = {}
    for name in entry.keys:
        start, _, tangent = name.partition('~')
        for of, part in starts.get(start, {name: 1.0}).items():
            if not tangent or tangent == of:
                row = rows.setdefault(of, np.zeros(len(index)))
                row[index.index(engine.index[name])] += part
    of_key = {name: keys[name.partition('#')[0]] for name in rows}   # '#': in one flight
    law = CATALOGUE[entry.name].layer not in ('sensor', 'timing')
    for parameter, spec in CATALOGUE[entry.name].parameters.items():
        own = [name for name in rows if of_key[name].parameter == parameter]
        values, spans = [], []
        for name in own:
            key, row = of_key[name], rows[name]
            middle = float(row @ posterior.estimate)
            form = FORM_DEVIATION * middle if law and not key.relative else 0.0
            half = 1.96 * float(row @ posterior.covariance @ row + form**2)**0.5
            values.append(key.value(middle))
            spans.append([max(key.value(middle - half), min(spec.low, values[-1])),
                          min(key.value(middle + half), max(spec.high, values[-1]))])
        if own:
            base, key, one = [of_key[n].base for n in own], of_key[own[0]], len(own) == 1
            typical = float(engine.typical[engine.index[own[0]]]) if own[0] in engine.index \
                else key.typical
            found[parameter] = {'value': values[0] if one else values, 'unit': spec.unit,
                                'interval': spans[0] if one else spans,
                                'file': base[0] if one else base,
                                'typical': typical * (key.base if key.relative else 1.0)}
    return found


def candidates_of(engine: Engine, solution: Solution, keys: dict[str, Key], taken: Sequence[int],
                  starts: Starts, alpha: float) -> list[dict]:
    """
    Evidence of each entry alone.

    Of the starts of one entry, the one with most evidence counts. ``seen_from`` is the size that
    would be named in the mean; of several starts, the smallest one.
    """
    count = len(solution.entries)
    least = log(1 / alpha) + log_prior(0, count) - log_prior(1, count)
    rows: dict[tuple, dict] = {}
    for k, entry in enumerate(solution.entries):
        if entry.varying:
            continue
        gain = solution.gains.get((k,))
        row = {'name': entry.name, **member_of(entry), 'accepted': k in taken,
               'reason': 'value differs between frequencies' if k in solution.banned else '',
               'evidence': _evidence(gain),
               'seen_from': seen_from(engine, solution, keys, entry, starts, least)}
        other = rows.get((entry.name, entry.member))
        if other:
            row = max(other, row, key=_rank) | {
                'seen_from': min(other, row, key=size_seen)['seen_from']}
        rows[entry.name, entry.member] = row
    return list(rows.values())


def _rank(row):
    gain = row['evidence']['ln_bayes_factor']
    return row['accepted'], -np.inf if gain is None else gain


def _evidence(gain):
    return {'ln_bayes_factor': gain, 'delta_bic': None if gain is None else 2 * gain}


def seen_from(engine: Engine, solution: Solution, keys: dict[str, Key], entry: Entry,
              starts: Starts, evidence: float) -> dict:
    """
    Size of an entry's first number with this mean ``evidence``, its typical size, and the unit.

    The unit is % for a share of the robot file. The size of a limit is that of its start. A size
    is None beyond the start, where a secant is not valid, and beyond the widest prior.
    """
    name = entry.keys[0]
    size = solution.judge.least([engine.index[key] for key in entry.keys], evidence)
    own, part = next(iter(starts[name].items())) if name in starts else (
        name, float(engine.typical[engine.index[name]]))
    key, known = keys[own], size <= (1 if name in starts else WIDEST)
    unit = CATALOGUE[entry.name].parameters[key.parameter].unit
    if not key.relative:
        return {'value': size * part if known else None, 'unit': unit,
                'typical': key.typical if name in starts else part}
    if name in starts:
        return {'value': key.value(part) if known else None, 'unit': unit, 'typical': None}
    return {'value': 100 * float(np.expm1(size * part)) if known else None, 'unit': '%',
            'typical': 100 * float(np.expm1(part))}


def numbers_of(engine: Engine, solution: Solution, named: list[int], flights: list) -> dict:
    """
    Errors over the noise floor without and with the named effects, closure, and what was fitted.

    ``tolerances`` are the deviations of keys that are not named.
    """
    before, after, floor, closure = errors(engine, solution, named, flights)
    keys, own = engine.flights[0].keys, set(engine.indices(named))
    tolerances = {name: {'deviation': float(solution.theta[k]), 'relative': keys[name].relative}
                  for k, name in enumerate(engine.names[:engine.known])
                  if name in keys and k not in own}
    return {'gap_before': before / floor, 'gap_after': after / floor, 'noise_floor': 1.0,
            'closure': closure, 'tolerances': tolerances}


def verdict_of(chance: float, sets: list[list[str]], rest: list[Unexplained],
               fed_back: list[str], alpha: float, evidence: float,
               likely: Sequence[str] = ()) -> tuple[str, str]:
    """
    Verdict on flights and, without names, its reason as the end of a sentence.

    Args:
        chance: probability of as much evidence without any effect.
        sets: named entries, each with those that could stand in its place.
        rest: tests of what no entry explains, the most improbable first.
        fed_back: entries that were excluded because of feedback.
        alpha: accepted probability of a false alarm.
        evidence: of the surest of the named entries [nat].
        likely: entries that explain what repeats, but are not sure enough.

    """
    if len(fed_back) > MOST_FED_BACK and not sets:
        return 'not_decidable', (
            'the controller answers noise more than it flies: the values of '
            f"{', '.join(fed_back)} differ between frequencies")
    repeats = repeating(rest, alpha)
    small = [len(members) for members in sets if len(members) < CROWD]
    if small and not (repeats and evidence < MINOR * rest[0].gain):
        return 'named_set' if max(small) > 1 else 'named', ''
    if sets and not small:
        return 'not_decidable', (
            f"they do not separate {' and '.join(map(' or '.join, sets))}".replace('_', ' '))
    if repeats and likely:
        return 'not_decidable', (f"{' and '.join(likely)} would explain what repeats, but too few "
                                 'blocks show it'.replace('_', ' '))
    if repeats:
        return 'unknown', rest[0].sentence
    if chance > alpha:
        return 'no_gap', ''
    return 'not_decidable', (f'an effect is more likely than none (probability of a false alarm '
                             f'{chance:.2g}), but none is sure enough by itself')


def varied(engine: Engine, solution: Solution) -> list[str]:
    """A sentence for each thing that differs from flight to flight."""
    found = []
    for k in solution.best:
        entry = solution.entries[k]
        if entry.varying:
            values = np.array([solution.theta[engine.index[key]] for key in entry.keys])
            values = np.linalg.norm(values.reshape(len(engine.flights), -1), axis=1) \
                if len(values) > len(engine.flights) else values
            unit = next(iter(CATALOGUE[entry.name].parameters.values())).unit
            found.append(f"{entry.name.replace('_', ' ')} differs from flight to flight: "
                         + ', '.join(f'{value:.2g}' for value in values) + f' {unit}')
    return found
