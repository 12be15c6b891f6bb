"""`beetle_omni gap LOG.csv`: response logs of the servos against a robot file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from beetle_omni_ros.identify.flights.page import grids as flight_grids
from beetle_omni_ros.identify.flights.picture import head
from beetle_omni_ros.identify.flights.results import result_of
from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.identify.inference.hierarchy import WIDTH
from beetle_omni_ros.identify.servo.fit import (
    decoded,
    error_rms,
    mask,
    rms,
    Search,
    select,
    Servos,
)
from beetle_omni_ros.identify.servo.log import JointLog, read_joint_log
from beetle_omni_ros.identify.servo.model import (
    catalogue_values,
    ENTRIES,
    file_sets,
    INDEX,
    NAMES,
    own_delay,
    simulate,
    with_encoder_errors,
)
from beetle_omni_ros.identify.servo.results import grids, identify, joint_results, sections
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.page import page

ALPHA = 0.05        # probability of a wrong name, if each entry has the same prior probability
AS_WELL = 1.3       # ratio of held-out errors of a corrected file and of the log's best model
STEP = 1e-3         # of derivatives by the coordinates of a fit, in standard deviations
NAMED = [name for name in ENTRIES if name in CATALOGUE]
CERTAIN = np.log(len(NAMED) / ALPHA)    # [nat] gain of evidence of a named entry


def analyse_joint_logs(runs: Sequence[Path], holdout: Sequence[Path], robot: RobotParameters
                       ) -> tuple[dict, Callable[[], str]]:
    """
    Compare the first log with a robot file, and further ones and those of ``holdout`` with it.

    Returns:
        results with the keys of flights, and a function that makes their HTML page.

    Raises:
        LogError: unusable log.

    """
    log = read_joint_log(runs[0])
    others = [read_joint_log(path) for path in [*runs[1:], *holdout]]
    search, apart = compare(log, robot), identify([log], robot)
    joints = joint_results(apart, others, robot)
    result = gap_of(search, apart, robot, joints=joints['joints'], text=joints['text'])
    if result['next_experiment']:
        result['next_experiment'] = 'sine of 3.8 Hz and 0.25 rad for 10 s on the joints ' \
            '(separates latency from bandwidth)'

    def made_page() -> str:
        tables = [*flight_grids(result),
                  *grids(result | {'meta': {'validate': [other.name for other in others]}})]
        return page('Tilt servos', f'{log.name} against the robot file', tables, result['text'],
                    sections(apart, others, robot), head(result))

    return result, made_page


def compare(log: JointLog, robot: RobotParameters) -> Search:
    """
    The entries by which a log differs from the servos of a robot file as the simulator flies them.

    No file can state a delay below that of the simulator, so that the fits have none.
    """
    servos = Servos([log], file_sets(robot, flown=True), one_delay=True)
    servos.low[INDEX['delay']] = own_delay()
    return select(servos, (), NAMED, CERTAIN, named=True)


def gap_of(search: Search, apart: Search, robot: RobotParameters, **more) -> dict:
    """
    Verdict, effects and errors, with the keys of a gap of flights (`flights/results.py`).

    Args:
        search: comparison with the robot file.
        apart: identification of the same log, whose error is the noise floor.
        robot: the robot file.
        more: further keys of the results.

    """
    s, file = search.servos, file_sets(robot, flown=True)
    log, numbers = s.logs[0], np.array([number for *_, number in s.units])
    before, after, floor = (np.array([
        error_rms(log, u, simulate(log, u, one)[0], slice(log.end, None))
        for u, one in enumerate(sets)])
        for sets in (file[numbers - 1], search.values(), apart.values()))
    floor = np.minimum(floor, after)
    allowed = np.hypot(AS_WELL * floor, log.quantum)
    effects, explained = _effects(search, robot), bool((after <= allowed).all())
    total_before, total_after, noise = map(rms, (before, after, floor))
    verdict = ('unknown' if not explained else 'no_gap' if not effects else
               'named_set' if any(len(e['names']) > 1 for e in effects) else 'named')
    worst = int(np.argmax(after / allowed))
    reason = (f'error on the held-out part {1e3 * total_before:.1f} mrad before, '
              f'{1e3 * total_after:.1f} mrad after') + ('' if explained else (
                  f'; joint {numbers[worst]} keeps {1e3 * after[worst]:.1f} mrad, '
                  f'{1e3 * floor[worst]:.1f} mrad with every term'))
    return result_of(
        verdict, {}, reason, closure=None if total_before <= 1.1 * noise else
        1.0 - max(total_after**2 - noise**2, 0.0) / (total_before**2 - noise**2),
        gap_before=total_before / noise, gap_after=total_after / noise, noise_floor=1.0,
        effects=effects if explained else [], partial=[] if explained else effects, held_out=True,
        candidates=[
            {'name': name, 'accepted': name in search.chosen.entries,
             'evidence': _evidence(search, name),
             'reason': '' if name in search.chosen.entries else
             'the evidence does not need it' if search.gains[name] < CERTAIN else
             'less than an encoder count, or no better on left-out blocks'}
            for name in sorted(search.gains, key=lambda name: -search.gains[name])],
        where=sorted(({'channel': f'joint_{number}', 'regime': 'log', 'excess': float(first),
                       'excess_after': float(then)} for number, first, then in zip(
                           numbers, before / floor, after / floor, strict=True)),
                     key=lambda row: -row['excess']), **more)


def _evidence(search, name):
    """Evidence of an entry: with the others of the selected model, against that model without."""
    sign = 1 if name in search.chosen.entries else -1
    on, off = search.chosen.fit, search.trials[name].fit
    held = sign * (on.held - off.held)
    return {'ln_bayes_factor': search.gains[name], 'delta_bic': 2 * search.gains[name],
            'cv_gain': 2 * float(held.sum())}


def _effects(search, robot):
    """Accepted entries, largest gain first; a zero is an effect of each joint that it moves."""
    result, s = [], search.servos
    for name in sorted(search.chosen.entries, key=lambda name: -search.gains[name]):
        rivals = _rivals(search, name)
        effect = {'names': [name, *rivals], 'evidence': _evidence(search, name)}
        if rivals:
            effect['rivals'] = [{'name': rival, 'parameters': _of_all(rival, _estimates(
                search, search.trials[rival], rival, robot))} for rival in rivals]
        of_units = _estimates(search, search.chosen, name, robot)
        if CATALOGUE[name].each != 'joint':
            result.append(effect | {'parameters': _of_all(name, of_units)})
            continue
        moved = s.visible(search.chosen, search.trials[name]) & s.changed(search.chosen, name)
        result += [effect | {'joint': number, 'parameters': of_units[number]}
                   for (*_, number), seen in zip(s.units, moved, strict=True) if seen]
    return result


def _rivals(search, name):
    """Rejected entries that explain the log nearly as well in place of an accepted one."""
    entries, s = search.chosen.entries, search.servos
    rivals = {}
    for other in (rival for rival in TREATMENTS[name].confused_with
                  if rival in NAMED and rival not in entries and rival in search.trials):
        swapped = s.fit([*(e for e in entries if e != name), other],
                        starts=(search.trials[other], search.full), still=search.chosen.still)
        if swapped.fit.evidence > search.chosen.fit.evidence - CERTAIN:
            rivals[other] = swapped.fit.evidence
            search.trials[other] = swapped
    return sorted(rivals, key=lambda other: -rivals[other])


def _estimates(search, trial, name, robot):
    """
    Number of a joint -> parameters of an entry by name.

    Value, unit, 95 % interval, value of the file, and the one that a corrected file has. An entry
    that the log neither needs nor excludes widens the intervals of the others.
    """
    s, spec, file = search.servos, CATALOGUE[name].parameters, file_sets(robot, flown=True)
    possible = [trial, *(search.trials[other] for other, gain in search.gains.items()
                         if trial is search.chosen and other not in trial.entries
                         and gain > -CERTAIN)]

    def written(values):
        found = catalogue_values(values, robot)[name]
        return np.array([found[parameter] for parameter in spec])

    result = {}
    for unit, (*_, number) in enumerate(s.units):
        def reported(values, unit=unit):
            zero = _constant(s, unit, values) if name == 'joint_offset' else 0.0
            return written(values) - zero

        value, error = np.swapaxes([_derived(one, unit, reported) for one in possible], 0, 1)
        low, high = (value - WIDTH * error).min(axis=0), (value + WIDTH * error).max(axis=0)
        result[number] = {
            parameter: {'value': here, 'unit': spec[parameter].unit, 'interval': list(ends),
                        'file': known, 'written': new}
            for parameter, here, *ends, known, new in zip(spec, *(column.tolist() for column in (
                value[0], low, high, reported(file[number - 1]),
                written(search.values()[unit]))), strict=True)}
    return result


def _of_all(name, of_units):
    """The median joint of :func:`_estimates`, with the value of each joint."""
    joined = {}
    for parameter, spec in CATALOGUE[name].parameters.items():
        own = {str(number): one[parameter] for number, one in of_units.items()}
        value, file, (low, high) = (
            np.median([one[key] for one in own.values()], axis=0).tolist()
            for key in ('value', 'file', 'interval'))
        joined[parameter] = {'value': value, 'unit': spec.unit, 'file': file,
                             'interval': [max(low, spec.low), high],
                             'each': {number: one['value'] for number, one in own.items()}}
    return joined


def _constant(servos, unit, values):
    """
    Constant of a line through the encoder errors at the angles of a log [rad].

    That of the cosine is 0 at angle 0 and has one sign elsewhere, so that a zero at angle 0 is not
    the mean error of the reading over the log.
    """
    k, j, _ = servos.units[unit]
    log, settled = servos.logs[k], servos.rows[k][0]
    angles = log.measured[j, settled:][log.fresh[settled:]]
    value = dict(zip(NAMES, values[:, None], strict=True))
    positions = angles[None] + value['offset'][:, None]
    errors = with_encoder_errors(positions, value) - positions
    return np.polyfit(angles, errors[0], 1)[1]


def _derived(trial, unit, function):
    """Values (n,) of a unit's parameter set, and standard errors (n,) by the delta method."""
    theta = trial.fit.theta[unit]
    covariance = trial.fit.spread()[unit]
    value = function(decoded(theta))
    slopes = np.zeros((len(value), len(theta)))
    for p in np.flatnonzero(mask(trial.entries)):
        step = STEP * max(np.sqrt(covariance[p, p]), 1e-9)
        moved = theta.copy()
        moved[p] += step
        slopes[:, p] = (function(decoded(moved)) - value) / step
    return value, np.sqrt([slope @ covariance @ slope for slope in slopes])
