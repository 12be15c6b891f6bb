"""
`gap --learn`: a formula of at most three terms, where no entry of the catalogue explains flights.

Each term of the library is an entry beside those of the catalogue. The engine then learns the
noise with all of them, and its search is a sparse regression: it adds, exchanges and removes
terms while their evidence, with the prior of one set among all sets, rises.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from math import exp, log
from pathlib import Path

import numpy as np
from scipy.stats import t as student
import yaml

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.evidence import Solution
from beetle_omni_ros.identify.flights.page import label, listed
from beetle_omni_ros.identify.flights.quality import errors
from beetle_omni_ros.identify.flights.results import CROWD, effect_of, named_of, result_of
from beetle_omni_ros.identify.robot_file import rounded
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.formula import library, unit_of
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

FORMULA = 'formula'
MOST = 3                # terms
CLOSED = 0.5            # least closure on what was not fitted
NOTHING = {'no_gap': 'model and measurement agree', 'bad_data': 'the recordings cannot be used'}
RANGE = 0.02, 0.98      # quantiles of the motion that are stated


def learned(run: Callable[[RobotParameters, Callable], dict], robot: RobotParameters,
            result: dict) -> dict:
    """
    Results of flights with a formula, or with the reason why there is none.

    Args:
        run: results of the flights for a robot, to which a function may add.
        robot: of the ``result`` of the catalogue alone.
        result: of the catalogue alone.

    Raises:
        ParameterError: the robot file has a formula already.

    """
    if FORMULA in robot.effects:
        raise ParameterError(f'--learn: expected a robot file without the effect {FORMULA}')
    if result['verdict'] in NOTHING:
        return _none(result, NOTHING[result['verdict']])
    used = {name: group['used'] for name, group in result['groups'].items()}
    terms = library(used['torque'], used['joint'])
    search = Search(result, terms)
    run(replace(robot, effects=robot.effects | {FORMULA: {
        'expressions': terms, 'coefficients': (0.0,) * len(terms)}}), search)
    return search.found


def _none(result, reason):
    return result | {FORMULA: {'reason': reason}, 'findings': [
        *result['findings'], f'No formula: {reason}']}


@dataclass
class Search:
    """Takes a formula from the solution of an engine whose entries include the ``terms``."""

    before: dict
    terms: tuple[str, ...]

    def __call__(self, engine: Engine, solution: Solution, result: dict, starts: dict | None,
                 judges: Sequence) -> dict:
        """Set :attr:`found`, the results; nothing is added to those of this engine."""
        found = self._formula(engine, solution, result, starts, judges)
        self.found = found if isinstance(found, dict) else _none(self.before, found)
        return {}

    def _formula(self, engine, solution, result, starts, judges):
        """Results with a formula, or the reason why there is none."""
        entries, best = solution.entries, set(solution.best)
        own = sorted((k for k in best if entries[k].name == FORMULA), key=lambda k: -engine.gain(
            solution.judge, solution.best, tuple(sorted(best - {k}))))
        if not own:
            return f'none of {len(self.terms)} terms has enough evidence beside the catalogue'
        rest, own = best - set(own), own[:MOST]
        best = rest | set(own)
        accepted = {label(row) for row in self.before['candidates'] if row['accepted']}
        known = {k for k, entry in enumerate(entries) if not entry.varying and label(
            {'name': entry.name, 'rotor': entry.member}) in accepted}
        gain = min(engine.gain(solution.judge, tuple(sorted(best)), tuple(sorted(other)))
                   for other in (rest, known, rest | known))
        if gain < log(1 / engine.alpha):
            return 'a formula is not more probable than the entries of the catalogue'
        before, after, floor, closure = errors(engine, solution, own, judges)
        chance = 0.0
        if not result['held_out']:
            chance, closure = self._repeats(engine, solution, own, rest)
        if closure is None or closure < CLOSED or chance > engine.alpha:
            return f'the best one of {MOST} terms closes ' + (
                'nothing' if closure is None else f'{max(closure, 0):.0%}') \
                + ' of the gap on what was not fitted'
        return self._accepted(engine, solution, result, starts, own, judges) | {FORMULA: {
            'ln_bayes_factor': gain, 'probability': exp(-gain), 'closure': closure,
            'gap_before': before / floor, 'gap_after': after / floor,
            'terms_tried': len(self.terms), 'ranges': ranges(engine.flights)}}

    def _repeats(self, engine, solution, own, rest):
        """
        Probability by chance, and closure, of blocks that a fit of the others predicts.

        All other keys are as fitted without the formula, and move with it.
        """
        index = engine.indices(own)
        judge = solution.judge
        without = judge.posterior(engine.indices(tuple(rest))).theta
        direction = judge.covariance[:, index] @ np.linalg.inv(
            judge.covariance[np.ix_(index, index)])
        equations = judge.equations
        score = (equations.scores - equations.slopes @ without) @ direction
        info = direction.T @ equations.slopes @ direction
        prior = np.diag((3 * judge.typical[index])**-2.0)
        moved = np.linalg.solve(info.sum(axis=0) - info + prior,
                                (score.sum(axis=0) - score)[:, :, None])[:, :, 0]
        whole = np.linalg.solve(info.sum(axis=0) + prior, score.sum(axis=0))
        gains, most = (np.einsum('bi,bi->b', score, w) - 0.5 * np.einsum(
            'bi,bij,bj->b', w, info, w) for w in (moved, np.tile(whole, (len(score), 1))))
        value = gains.mean() / gains.std(ddof=1) * len(gains)**0.5
        return float(student.sf(value, len(gains) - 1)), float(gains.sum() / most.sum())

    def _accepted(self, engine, solution, result, starts, own, judges):
        """Results of the catalogue's entries and the formula together."""
        keys = engine.flights[0].keys
        own_set = [(k, [j for j in members if solution.entries[j].name != FORMULA])
                   for k, members in named_of(engine, solution, engine.alpha)
                   if solution.entries[k].name != FORMULA]
        named = [(k, members) for k, members in own_set if len(members) < CROWD]
        each = {self.terms[solution.entries[k].member - 1]: effect_of(
            solution, engine, keys, k, [k], starts) for k in own}
        for term, effect in each.items():
            effect['parameters']['coefficients']['unit'] = unit_of(term)
        first = next(iter(each.values()))
        formula = first | {'members': [FORMULA], 'expressions': list(each), 'parameters': {
            term: effect['parameters']['coefficients'] for term, effect in each.items()}}
        formula.pop('term')
        effects = [*(effect_of(solution, engine, keys, k, members, starts)
                     for k, members in named), formula]
        before, after, floor, closure = errors(
            engine, solution, [*own, *(k for k, _ in named)], judges)
        return result_of(
            'named_set' if any(len(m) > 1 for _, m in named) else 'named',
            self.before['groups'], **{key: self.before[key] for key in (
                'hidden', 'findings', 'held_out', 'next_flight', 'meta')},
            effects=effects, where=result['where'], closure=closure, gap_before=before / floor,
            gap_after=after / floor, noise_floor=1.0, candidates=[
                row for row in result['candidates'] if row['name'] != FORMULA],
            tolerances={key: value for key, value in result['tolerances'].items()
                        if not key.startswith(FORMULA)},
            false_alarm_probability=exp(min(0.0, -solution.e_value)))


def ranges(flights: Sequence) -> dict[str, list[float]]:
    """Quantity with its unit -> smallest and largest value in the flights, without extremes."""
    motion = {name: np.concatenate([flight.motion[name] for flight in flights])
              for name in ('velocity', 'rate', 'tilt', 'position')}
    quantities = {'speed [m/s]': np.linalg.norm(motion['velocity'], axis=1),
                  'rate of turn [rad/s]': np.linalg.norm(motion['rate'], axis=1),
                  'tilt [rad]': motion['tilt'].ravel(), 'height [m]': motion['position'][:, 2]}
    return {name: [rounded(float(x)) for x in np.quantile(values, RANGE)]
            for name, values in quantities.items()}


def write_effect(path: Path, result: dict, robot: RobotParameters) -> None:
    """Write the formula of the ``result`` as a file of an effect; ``robot``: it was found for."""
    effect, found = next(e for e in result['effects'] if 'expressions' in e), result[FORMULA]
    sizes = [effect['parameters'][term] for term in effect['expressions']]
    content = {
        'expressions': effect['expressions'],
        'coefficients': [rounded(size['value']) for size in sizes],
        'units': [size['unit'] for size in sizes],
        'intervals': [[rounded(x) for x in size['interval']] for size in sizes],
        'source': {
            'written_by': f'beetle_omni gap --learn {__version__}',
            'date': datetime.now(timezone.utc).strftime('%Y-%m-%d'),
            **{key: result['meta'][key] for key in ('runs', 'holdout', 'robot')},
            'robot_hash': robot.hash(), 'beside': listed(
                [label(e) for e in result['effects'] if e is not effect]),
            **{key: rounded(found[key]) for key in ('ln_bayes_factor', 'closure')},
            'terms_tried': found['terms_tried'], 'ranges': found['ranges']}}
    write_text(path, '# An effect for robot files, `effects: {formula: FILE}`. SI units; '
               'intervals of 95 %; see docs/gap.md.\n'
               + yaml.safe_dump(content, sort_keys=False, width=95), 'effect')
