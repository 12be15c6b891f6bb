"""
`gap --learn`: a formula of at most three terms, where no entry of the catalogue explains flights.

Each term of the library is an entry beside those of the catalogue, so that the engine's search
is a sparse regression by evidence, with the prior of one set among all sets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import log
from pathlib import Path

import numpy as np
import yaml

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.flights.page import label
from beetle_omni_ros.identify.flights.quality import errors
from beetle_omni_ros.identify.flights.results import CROWD, result_of
from beetle_omni_ros.identify.robot_file import rounded
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.formula import described, library
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

FORMULA = 'formula'
MOST = 3                # terms
NOTHING = 1e-6          # of a prior deviation: the key keeps its value
CLOSED = 0.5            # least closure on the held-out flights
RANGE = 0.02, 0.98      # quantiles of the motion that are stated


def learned(run: Callable[[RobotParameters, Callable], dict], robot: RobotParameters,
            result: dict) -> dict:
    """
    Results of flights with a formula, or with the reason why there is none.

    ``run`` makes results for a robot, to which a function may add. ``result`` is that of ``robot``
    with the catalogue alone. A ParameterError, if the robot has a formula already.
    """
    if FORMULA in robot.effects:
        raise ParameterError(f'--learn: expected a robot file without the effect {FORMULA}')
    if not result['held_out']:      # nor are damaged ones
        return _none(result, 'no flight is held out that would confirm it, see --holdout')
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


def _formula(terms, before, weighed, result, judges):
    """
    Results with a formula of the engine whose entries include the ``terms``, or why there is none.

    ``before`` are the results of the catalogue alone.
    """
    engine, solution = weighed.engine, weighed.solution
    judge, entries, best = solution.judge, solution.entries, set(solution.best)

    def gain(one, other):
        return engine.gain(judge, tuple(sorted(one)), tuple(sorted(other)))
    own = sorted((k for k in best if entries[k].name == FORMULA),
                 key=lambda k: -gain(best, best - {k}))
    best, own = best - set(own[MOST:]), own[:MOST]
    for k in own:       # known entries have priority in the place of a term
        less, j = max((gain(best - {k} | {j}, best), j) for j, entry in enumerate(entries)
                      if j not in {*best, *solution.banned} and not entry.varying
                      and entry.name != FORMULA)
        best = best - {k} | {j} if less > log(engine.alpha) else best
    own = [k for k in own if k in best]
    if not own:
        return f'none of {len(terms)} terms has enough evidence beside the catalogue'
    rest, chosen = best - set(own), tuple(sorted(best))
    accepted = {label(row) for row in before['candidates'] if row['accepted']}
    known = {k for k, entry in enumerate(entries) if not entry.varying and label(
        {'name': entry.name, 'rotor': entry.member}) in accepted}
    more = min(gain(chosen, other) for other in (rest, known, rest | known))
    if more < log(1 / engine.alpha):
        return 'it would not be more probable than the entries of the catalogue'
    # the other terms are no part of the model, neither as tolerances nor where noise is learnt
    for deviations in (engine.narrow, engine.typical):
        deviations[engine.indices([k for k, entry in enumerate(entries)
                                   if entry.name == FORMULA and k not in own])] *= NOTHING
    solution = engine.again(solution, chosen)
    alone = errors(engine, solution, own, judges)
    if alone['closure'] is None or alone['closure'] < CLOSED:
        return f'the best one of {MOST} terms closes {max(alone["closure"] or 0, 0):.0%} of the ' \
            'gap on the held-out flights'
    found = replace(weighed, solution=solution)
    named = [(k, [j for j in members if entries[j].name != FORMULA])
             for k, members in found.named(engine.alpha) if entries[k].name != FORMULA]
    named = [(k, members) for k, members in named if len(members) < CROWD]
    each = [found.effect(k, [k]) for k in own]
    sizes = {term: effect['parameters']['coefficients'] | {'unit': described(term)[0]}
             for term, effect in zip((terms[entries[k].member - 1] for k in own), each)}
    effects = [*(found.effect(k, members) for k, members in named), {
        **each[0], 'members': [FORMULA], 'term': None, 'expressions': list(sizes),
        'parameters': sizes}]
    return result_of(
        'named_set' if any(len(effect['members']) > 1 for effect in effects) else 'named',
        before['groups'], **{key: before[key] for key in (
            'hidden', 'findings', 'held_out', 'next_flight', 'meta')},
        **{key: result[key] for key in (
            'where', 'noise_floor', 'tolerances', 'false_alarm_probability')}, effects=effects,
        **errors(engine, solution, [*own, *(k for k, _ in named)], judges),
        candidates=[row for row in result['candidates'] if row['name'] != FORMULA]) | {FORMULA: {
            'ln_bayes_factor': more, **alone, 'terms_tried': len(terms),
            'ranges': ranges(engine.flights)}}


def ranges(flights: Sequence) -> dict[str, list[float]]:
    """Quantity with its unit -> smallest and largest value in the flights, without extremes."""
    quantities: dict[str, Callable] = {
        'speed [m/s]': lambda m: np.linalg.norm(m['velocity'], axis=1),
        'rate of turn [rad/s]': lambda m: np.linalg.norm(m['rate'], axis=1),
        'tilt [rad]': lambda m: m['tilt'], 'height [m]': lambda m: m['position'][:, 2]}
    return {name: [rounded(float(x), 2) for x in np.quantile(np.concatenate(
        [of(flight.motion) for flight in flights]), RANGE)] for name, of in quantities.items()}


def write_effect(path: Path, result: dict, robot: RobotParameters) -> None:
    """Write the formula of the ``result`` as a file of an effect; ``robot``: it was found for."""
    *beside, effect = result['effects']
    sizes = effect['parameters'].values()
    content = {
        'expressions': effect['expressions'], 'units': [size['unit'] for size in sizes],
        **{f'{key}s': [rounded(size[name]) for size in sizes]
           for key, name in (('coefficient', 'value'), ('interval', 'interval'))},
        'source': {
            'written_by': f'beetle_omni gap --learn {__version__}',
            **{key: result['meta'][key] for key in ('runs', 'holdout', 'robot')},
            'robot_hash': robot.hash(), 'beside': [label(each) for each in beside],
            **rounded(result[FORMULA])}}
    write_text(path, '# An effect for robot files, `effects: {formula: FILE}`. SI units; '
               'intervals of 95 %; see docs/gap.md.\n'
               + yaml.safe_dump(content, sort_keys=False, width=95), 'effect')
