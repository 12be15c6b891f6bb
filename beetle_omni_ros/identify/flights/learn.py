"""
`gap --learn`: a formula of at most three terms, where no entry of the catalogue explains flights.

Each term of the library is an entry beside those of the catalogue. The engine then learns the
noise with all of them, and its search is a sparse regression: it adds, exchanges and removes
terms while their evidence, with the prior of one set among all sets, rises.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from math import log
from pathlib import Path

import numpy as np
from scipy.stats import t as student
import yaml

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.flights.page import label
from beetle_omni_ros.identify.flights.quality import errors
from beetle_omni_ros.identify.flights.results import CROWD, effect_of, named_of, result_of
from beetle_omni_ros.identify.robot_file import rounded
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.formula import described, library
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

FORMULA = 'formula'
MOST = 3                # terms
CLOSED = 0.5            # least closure on what was not fitted
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
    if result['verdict'] == 'bad_data':
        return _none(result, 'the recordings cannot be used')
    terms = library(*(result['groups'][name]['used'] for name in ('torque', 'joint')))
    found: list = []

    def then(*given):
        found.append(_formula(terms, result, *given))
        return {}
    run(replace(robot, effects=robot.effects | {FORMULA: {
        'expressions': terms, 'coefficients': (0.0,) * len(terms)}}), then)
    return found[0] if isinstance(found[0], dict) else _none(result, found[0])


def _none(result, reason):
    return result | {FORMULA: {'reason': reason}, 'findings': [
        *result['findings'], f'No formula: {reason}']}


def _formula(terms, before, engine, solution, result, starts, judges):
    """
    Results with a formula of the engine whose entries include the ``terms``, or why there is none.

    ``before`` are the results of the catalogue alone.
    """
    judge, entries, best = solution.judge, solution.entries, set(solution.best)

    def gain(one, other):
        return engine.gain(judge, tuple(sorted(one)), tuple(sorted(other)))
    own = sorted((k for k in best if entries[k].name == FORMULA),
                 key=lambda k: -gain(best, best - {k}))
    if not own:
        return f'none of {len(terms)} terms has enough evidence beside the catalogue'
    rest, own = best - set(own), own[:MOST]
    chosen = tuple(sorted(rest | set(own)))
    solution = replace(solution, best=chosen, posterior=judge.posterior(engine.indices(chosen)))
    accepted = {label(row) for row in before['candidates'] if row['accepted']}
    known = {k for k, entry in enumerate(entries) if not entry.varying and label(
        {'name': entry.name, 'rotor': entry.member}) in accepted}
    more = min(gain(chosen, other) for other in (rest, known, rest | known))
    if more < log(1 / engine.alpha):
        return 'it would not be more probable than the entries of the catalogue'
    at, after, floor, closure = errors(engine, solution, own, judges)
    chance = 0.0
    if not result['held_out']:
        chance, closure = _repeats(engine, judge, own, rest)
    if closure is None or closure < CLOSED or chance > engine.alpha:
        return f'the best one of {MOST} terms closes {max(closure or 0, 0):.0%} of the gap on ' \
            'what was not fitted'
    keys = engine.flights[0].keys
    named = [(k, [j for j in members if entries[j].name != FORMULA]) for k, members in named_of(
        engine, solution, engine.alpha) if entries[k].name != FORMULA]
    effects = [effect_of(solution, engine, keys, k, members, starts)
               for k, members in named if len(members) < CROWD]
    each = [effect_of(solution, engine, keys, k, [k]) for k in own]
    sizes = {term: effect['parameters']['coefficients'] | {'unit': described(term)[0]}
             for term, effect in zip((terms[entries[k].member - 1] for k in own), each)}
    effects.append({**each[0], 'members': [FORMULA], 'term': None, 'expressions': list(sizes),
                    'parameters': sizes})
    start, end, all_of_it, share = errors(
        engine, solution, [*own, *(k for k, members in named if len(members) < CROWD)], judges)
    return result_of(
        'named_set' if any(len(effect['members']) > 1 for effect in effects) else 'named',
        before['groups'], **{key: before[key] for key in (
            'hidden', 'findings', 'held_out', 'next_flight', 'meta')},
        **{key: result[key] for key in (
            'where', 'noise_floor', 'tolerances', 'false_alarm_probability')}, effects=effects,
        closure=share, gap_before=start / all_of_it, gap_after=end / all_of_it,
        candidates=[row for row in result['candidates'] if row['name'] != FORMULA]) | {FORMULA: {
            'ln_bayes_factor': more, 'closure': closure, 'gap_before': at / floor,
            'gap_after': after / floor, 'terms_tried': len(terms),
            'ranges': ranges(engine.flights)}}


def _repeats(engine, judge, own, rest):
    """
    Probability by chance, and closure, of blocks that a fit of the others predicts.

    All other keys are as fitted with the entries ``rest``, and move with those of ``own``.
    """
    index, without = engine.indices(own), judge.posterior(engine.indices(tuple(rest))).theta
    move = judge.covariance[:, index] @ np.linalg.inv(judge.covariance[np.ix_(index, index)])
    score = (judge.equations.scores - judge.equations.slopes @ without) @ move
    info = move.T @ judge.equations.slopes @ move
    prior = np.diag((3 * judge.typical[index])**-2.0)
    others = np.linalg.solve(info.sum(axis=0) - info + prior,
                             (score.sum(axis=0) - score)[:, :, None])[:, :, 0]
    every = np.linalg.solve(info.sum(axis=0) + prior, score.sum(axis=0))
    gains, most = (np.einsum('bi,bi->b', score, w) - 0.5 * np.einsum('bi,bij,bj->b', w, info, w)
                   for w in (others, np.tile(every, (len(score), 1))))
    value = gains.mean() / gains.std(ddof=1) * len(gains)**0.5
    return float(student.sf(value, len(gains) - 1)), float(gains.sum() / most.sum())


def ranges(flights: Sequence) -> dict[str, list[float]]:
    """Quantity with its unit -> smallest and largest value in the flights, without extremes."""
    motion = {name: np.concatenate([flight.motion[name] for flight in flights])
              for name in ('velocity', 'rate', 'tilt', 'position')}
    return {name: [rounded(float(x), 2) for x in np.quantile(values, RANGE)] for name, values in {
        'speed [m/s]': np.linalg.norm(motion['velocity'], axis=1),
        'rate of turn [rad/s]': np.linalg.norm(motion['rate'], axis=1),
        'tilt [rad]': motion['tilt'], 'height [m]': motion['position'][:, 2]}.items()}


def write_effect(path: Path, result: dict, robot: RobotParameters) -> None:
    """Write the formula of the ``result`` as a file of an effect; ``robot``: it was found for."""
    *beside, effect = result['effects']
    sizes = effect['parameters'].values()
    content = {
        'expressions': effect['expressions'],
        'coefficients': [rounded(size['value']) for size in sizes],
        'units': [size['unit'] for size in sizes],
        'intervals': [[rounded(x) for x in size['interval']] for size in sizes],
        'source': {
            'written_by': f'beetle_omni gap --learn {__version__}',
            'date': datetime.now(timezone.utc).strftime('%Y-%m-%d'),
            **{key: result['meta'][key] for key in ('runs', 'holdout', 'robot')},
            'robot_hash': robot.hash(), 'beside': [label(each) for each in beside],
            **{key: rounded(found) if isinstance(found, float) else found
               for key, found in result[FORMULA].items()}}}
    write_text(path, '# An effect for robot files, `effects: {formula: FILE}`. SI units; '
               'intervals of 95 %; see docs/gap.md.\n'
               + yaml.safe_dump(content, sort_keys=False, width=95), 'effect')
