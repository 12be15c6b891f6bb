"""Results of an analysis of flights, as they are written as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import exp, inf, log
from typing import Any

import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.flights.balance import Balance
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.evidence import log_prior, Solution
from beetle_omni_ros.identify.flights.keys import Entry, Key
from beetle_omni_ros.identify.flights.page import size_seen, summary, visible
from beetle_omni_ros.identify.flights.quality import errors, Unexplained, unexplained, where_of
from beetle_omni_ros.identify.flights.treatment import separating_experiment, TREATMENTS
from beetle_omni_ros.model.effects import CATALOGUE

ALPHA = 0.05            # probability of a false alarm that is accepted
CROWD = 4               # members of a set from which the flights do not decide
NAMING = 'named', 'named_set'
WIDEST = 9.0            # typical deviations of the widest prior of an entry
MOST_FED_BACK = 2       # entries that feedback may exclude; with more, a name needs such evidence
SUBSTANTIAL = log(10) / 2   # [nat] of one value: Jeffreys, Theory of Probability (1961)
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


@dataclass(frozen=True)
class Weighed:
    """
    What a search of entries found.

    Attributes:
        engine: with the fitted flights, or a balance of torques.
        solution: of the engine, or the balance.
        keys: keys by name.
        starts: as of :class:`~beetle_omni_ros.identify.flights.bag_flight.BagFlight`; None: of
            tables, whose robot is not simulated.

    """

    engine: Any
    solution: Any
    keys: dict[str, Key]
    starts: Starts | None = None

    def named(self, alpha: float) -> list[tuple[int, list[int]]]:
        """
        Entries of the best set that the flights need, with those that could stand in their place.

        An entry is needed if the set without it is less probable by ``alpha``. Its rivals are the
        entries whose set in its place is more probable than ``alpha`` of the best one.
        """
        solution, best, named = self.solution, self.solution.best, []
        for k in best:
            own, rest = solution.entries[k], set(best) - {k}
            if own.varying or (needed := self._needed(k)) < log(1 / alpha):
                continue
            rivals = [(self.engine.gain(solution.judge, tuple(sorted(rest | {j})), best), j)
                      for j, entry in enumerate(solution.entries)
                      if j not in best and j not in solution.banned
                      and (entry.name != own.name or not entry.varying)]
            members = [k, *(j for less, j in sorted(rivals, reverse=True) if less > log(alpha))]
            named.append((-needed, k, members))
        return [(k, members) for _, k, members in sorted(named)]

    def _needed(self, k):
        """Ln of the probability of the best set over that of the best set without entry k."""
        best = self.solution.best
        return self.engine.gain(self.solution.judge, best, tuple(j for j in best if j != k))

    def effect(self, k: int, members: Sequence[int]) -> dict:
        """Names, sizes and evidence of entry k of the best set or one of the other members."""
        entries, rest = self.solution.entries, set(self.solution.best) - {k}
        first, *rivals = ({'name': entries[j].name, **member_of(entries[j]),
                           'parameters': self.sizes(j, (*rest, j))} for j in members)
        return {'names': list(dict.fromkeys(entries[j].name for j in members)),
                'members': list(dict.fromkeys(entries[j].label for j in members)),
                'parameters': first['parameters'], **member_of(entries[k]),
                'evidence': _evidence(self._needed(k)), **({'rivals': rivals} if rivals else {})}

    def sizes(self, k: int, chosen: Iterable[int]) -> dict:
        """
        Sizes of entry k in a set of entries.

        Returns:
            parameter -> value, unit, 95 % interval, value of the robot file and typical deviation.

        """
        entry, engine = self.solution.entries[k], self.engine
        index = sorted(engine.indices(tuple(chosen)))
        posterior = self.solution.judge.posterior(index)
        # key -> factors of the set's keys that make its deviation
        rows: dict[str, np.ndarray] = {}
        for name in entry.keys:
            start, _, tangent = name.partition('~')
            for of, part in (self.starts or {}).get(start, {name: 1.0}).items():
                if not tangent or tangent == of:
                    row = rows.setdefault(of, np.zeros(len(index)))
                    row[index.index(engine.index[name])] += part
        of_key = {name: self.keys[name.partition('#')[0]] for name in rows}   # '#': in one flight
        law, found = CATALOGUE[entry.name].layer not in ('sensor', 'timing'), {}
        for parameter, spec in CATALOGUE[entry.name].parameters.items():
            numbers = []
            own = [name for name, key in of_key.items() if key.parameter == parameter]
            for key, row in ((of_key[name], rows[name]) for name in own):
                middle = float(row @ posterior.estimate)
                form = FORM_DEVIATION * middle if law and not key.relative else 0.0
                half = 1.96 * float(row @ posterior.covariance @ row + form**2)**0.5
                value = key.value(middle)
                numbers.append((value, [max(key.value(middle - half), min(spec.low, value)),
                                        min(key.value(middle + half), max(spec.high, value))],
                                key.base))
            if own:
                values, intervals, files = (column[0] if len(own) == 1 else list(column)
                                            for column in zip(*numbers, strict=True))
                key = of_key[own[0]]
                typical = float(engine.typical[engine.index[own[0]]]) \
                    if own[0] in engine.index else key.typical
                found[parameter] = {'value': values, 'unit': spec.unit, 'interval': intervals,
                                    'file': files, 'typical': typical * (
                                        key.base if key.relative else 1.0)}
        return found

    def candidates(self, taken: Sequence[int], alpha: float) -> list[dict]:
        """
        Evidence of each entry alone; those in ``taken`` are accepted.

        Of the starts of one entry, the one with most evidence counts. ``seen_from`` is the size
        that would be named in the mean; of several starts, the smallest one.
        """
        solution, count = self.solution, len(self.solution.entries)
        least = log(1 / alpha) + log_prior(0, count) - log_prior(1, count)
        rows: dict[tuple, list[dict]] = {}
        for k, entry in enumerate(solution.entries):
            if not entry.varying:
                rows.setdefault((entry.name, entry.member), []).append({
                    'name': entry.name, **member_of(entry), 'accepted': k in taken,
                    'reason': 'value differs between frequencies' if k in solution.banned else '',
                    'evidence': _evidence(solution.gains.get((k,))),
                    'seen_from': self._seen_from(entry, least)})
        return [max(own, key=_rank) | {'seen_from': min(own, key=size_seen)['seen_from']}
                for own in rows.values()]

    def _seen_from(self, entry, evidence):
        """
        Size of an entry's first number with this mean ``evidence``, its typical size, and unit.

        The unit is % for a share of the robot file. The size of a limit is that of its start. A
        size is None beyond the start, where a secant is not valid, and beyond the widest prior.
        """
        engine, name, starts = self.engine, entry.keys[0], self.starts or {}
        size = self.solution.judge.least([engine.index[key] for key in entry.keys], evidence)
        limit = name in starts
        own, part = next(iter(starts[name].items())) if limit else (
            name, float(engine.typical[engine.index[name]]))
        key = self.keys[own]
        unit = CATALOGUE[entry.name].parameters[key.parameter].unit
        if not key.relative:
            value, typical = size * part, key.typical if limit else part
        elif limit:
            value, typical = key.value(part), None
        else:
            unit, value, typical = '%', *(100 * float(np.expm1(x * part))
                                          for x in (min(size, WIDEST), 1.0))
        return {'value': value if size <= (1 if limit else WIDEST) else None, 'unit': unit,
                'typical': typical}


def _rank(row):
    gain = row['evidence']['ln_bayes_factor']
    return row['accepted'], -inf if gain is None else gain


def _evidence(gain):
    return {'ln_bayes_factor': gain, 'delta_bic': None if gain is None else 2 * gain}


def member_of(entry: Entry) -> dict[str, int]:
    """Number of the rotor or joint of an entry of one of them."""
    return {CATALOGUE[entry.name].each or 'joint': entry.member} \
        if entry.member is not None else {}


Then = Callable[[Weighed, dict, list], dict]    # adds to the results; the list: judges


def concluded(forces: Weighed, judges: list, groups: dict, held_out: bool,
              findings: Sequence[str] = (), slow: Balance | None = None, measured: bool = True,
              then: Then | None = None) -> dict:
    """
    Results of a solution.

    Args:
        forces: what the flights say.
        judges: flights that the errors are about.
        groups: as of :func:`result_of`.
        held_out: whether the judges are other flights than the fitted ones.
        findings: sentences about the flights.
        slow: balance of torques; the mean of both e-values is one.
        measured: whether forces are those of an accelerometer. What an estimator makes of the
            motion repeats as well, and is no force.
        then: may add to the results.

    """
    engine, solution, alpha = forces.engine, forces.solution, forces.engine.alpha
    weighed = [forces] + ([Weighed(slow, slow, slow.keys)] if slow else [])
    e_value = np.logaddexp.reduce([own.solution.e_value for own in weighed]) - log(len(weighed))
    chance, fed_back = exp(min(0.0, -e_value)), [solution.entries[k].name for k in solution.banned]
    wanted = [(own, k, members) for own in weighed if chance <= alpha
              for k, members in own.named(alpha)]
    found = [(own, k, own.effect(k, members)) for own, k, members in wanted
             if (outweighs(solution, k) if own is forces else len(fed_back) <= MOST_FED_BACK)]
    hides = not found and bool(wanted or len(fed_back) > MOST_FED_BACK)
    if hides:       # no alpha names anything
        chance = 1.0
    weak = [effect for own, _, effect in found if own is not forces]
    found = [one for one in found if not of_a_rotor(one[-1], weak)]
    effects = [effect for *_, effect in found]
    # the balance alone tells rotors apart
    sets = [effect['names' if own is forces else 'members'] for own, _, effect in found]
    rest = unexplained(engine, solution) if measured else []
    likely = known_of(engine, solution) if rest and not sets else []
    verdict, reason = verdict_of(
        chance, sets, rest, fed_back if hides else [], alpha,
        max((effect['evidence']['ln_bayes_factor'] for effect in effects), default=0.0), likely)
    accepted = [effect for effect, members in zip(effects, sets, strict=True)
                if verdict in NAMING and len(members) < CROWD]
    named = [k for own, k, _ in found if own is forces and verdict in NAMING]
    fitted = {name: k for k, name in enumerate(engine.names[:engine.known])
              if name in forces.keys and k not in engine.indices(named)}
    rows = [row for own in weighed for row in own.candidates(
        [k for other, k, _ in found if other is own], alpha / len(weighed))]
    result = result_of(
        verdict, {**groups, **{kind: groups[kind] | {'reason': STILL}
                               for kind in engine.without_motion()}}, reason,
        effects=accepted, partial=[effect for effect in effects if effect not in accepted],
        candidates=sorted(rows, key=_rank, reverse=True),
        hidden=[row['name'] for row in visible(rows) if size_seen(row) > 1],
        where=where_of(engine, solution), false_alarm_probability=chance, held_out=held_out,
        findings=[*findings, *varied(engine, solution), *(
            test.sentence[:1].upper() + test.sentence[1:] for test in rest
            if verdict != 'unknown' and not likely)],
        noise_floor=1.0, **errors(engine, solution, named, judges), tolerances={
            name: {'deviation': float(solution.theta[k]), 'relative': forces.keys[name].relative}
            for name, k in fitted.items()})
    return result | then(forces, result, judges) if then else result


def outweighs(solution: Solution, k: int) -> bool:
    """
    Whether entry k of the best set is more than feedback.

    What feedback excluded has less evidence than what is left. If it excluded many entries, the
    bands also show one value, unless the entry is out of the loop.
    """
    if solution.banned and 2 * solution.posterior.gain < solution.sought:
        return False
    return len(solution.banned) <= MOST_FED_BACK \
        or -solution.unsteady.get(k, -inf) >= SUBSTANTIAL


def known_of(engine: Engine, solution: Solution) -> list[str]:
    """
    Entries that explain what repeats, although too few blocks show them for a name.

    Empty if it repeats beside the most likely entries as well.
    """
    likely = engine.likely(solution)
    if set(likely.best) <= set(solution.best) or unexplained(engine, likely):
        return []
    return list(dict.fromkeys(likely.entries[k].name for k in likely.best))


def of_a_rotor(effect: dict, weak: list[dict]) -> bool:
    """Whether an effect is that all rotors are weak, because one of the ``weak`` ones is."""
    rotors = [rotor for each in weak for rotor in _scales(each, 'rotor_thrust_coefficient')]
    for thrust in _scales(effect, 'thrust_coefficient'):
        low, high = thrust['interval']
        return any(low <= thrust['file'] * (3 + rotor['value'] / rotor['file']) / 4 <= high
                   for rotor in rotors)
    return False


def _scales(effect, name):
    """Scales of the members of an effect with this name."""
    members = {'name': effect['names'][0], **effect}, *effect.get('rivals', [])
    return [one['parameters']['scale'] for one in members if one['name'] == name]


def verdict_of(chance: float, sets: list[list[str]], rest: list[Unexplained],
               fed_back: list[str], alpha: float, evidence: float,
               likely: Sequence[str] = ()) -> tuple[str, str]:
    """
    Verdict on flights and, without names, its reason as the end of a sentence.

    Args:
        chance: probability of as much evidence without any effect.
        sets: named entries, each with those that could stand in its place.
        rest: what repeats and no entry explains, the most improbable first.
        fed_back: entries that feedback excludes, if it hides the others.
        alpha: accepted probability of a false alarm.
        evidence: of the surest of the named entries [nat].
        likely: entries that explain what repeats, but are not sure enough.

    """
    small = [len(members) for members in sets if len(members) < CROWD]
    minor = bool(rest) and evidence < MINOR * rest[0].gain
    # the first one that holds
    rules = (
        (fed_back, 'not_decidable', (
            'the controller answers noise more than it flies: the values of '
            f"{', '.join(sorted(fed_back))} differ between frequencies".replace('_', ' '))),
        (small and not minor, 'named_set' if max(small, default=0) > 1 else 'named', ''),
        (sets and not small, 'not_decidable', 'they do not separate ' + ' and '.join(
            map(' or '.join, sets)).replace('_', ' ')),
        (rest and likely, 'not_decidable', ' and '.join(likely).replace('_', ' ')
         + ' would explain what repeats, but too few blocks show it'),
        (rest, 'unknown', ''.join(test.sentence for test in rest[:1])),
        (chance > alpha, 'no_gap', ''),
        (True, 'not_decidable', (
            f'an effect is more likely than none (probability of a false alarm {chance:.2g}), '
            'but none is sure enough by itself')))
    return next((verdict, reason) for holds, verdict, reason in rules if holds)


def varied(engine: Engine, solution: Solution) -> list[str]:
    """A sentence for each thing that differs from flight to flight."""
    found = []
    for entry in (solution.entries[k] for k in solution.best if solution.entries[k].varying):
        values = solution.theta[[engine.index[key] for key in entry.keys]].reshape(
            len(engine.flights), -1)
        values = np.linalg.norm(values, axis=1) if values.shape[1] > 1 else values[:, 0]
        unit = next(iter(CATALOGUE[entry.name].parameters.values())).unit
        found.append(f"{entry.name.replace('_', ' ')} differs from flight to flight: "
                     + ', '.join(f'{value:.2g}' for value in values) + f' {unit}')
    return found
