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
    log, units = search.servos.logs[0], range(len(search.servos.units))
    last = slice(log.end, None)
    numbers = [number for *_, number in search.servos.units]
    before, after, floor = (
        np.array([error_rms(log, u, sets[u], part=last) for u in units])
        for sets in (file_sets(robot, flown=True)[np.array(numbers) - 1], search.values(),
                     apart.values()))
    floor = np.minimum(floor, after)
    allowed = np.hypot(AS_WELL * floor, log.quantum)
    effects = _effects(search, robot)
    explained = bool((after <= allowed).all())
    total = {key: float(np.sqrt(np.mean(values**2)))
             for key, values in (('before', before), ('after', after), ('floor', floor))}
    closure = None if total['before'] <= 1.1 * total['floor'] else float(
        1.0 - max(total['after']**2 - total['floor']**2, 0.0)
        / (total['before']**2 - total['floor']**2))
    verdict = ('unknown' if not explained else 'no_gap' if not effects else
               'named_set' if any(len(e['names']) > 1 for e in effects) else 'named')
    ratio = {key: value / total['floor'] for key, value in total.items()}
    worst = int(np.argmax(after / allowed))
    reason = (f'error on the held-out part {1e3 * total["before"]:.1f} mrad before, '
              f'{1e3 * total["after"]:.1f} mrad after') + ('' if explained else (
                  f'; joint {numbers[worst]} keeps {1e3 * after[worst]:.1f} mrad, '
                  f'{1e3 * floor[worst]:.1f} mrad with every term'))
    return result_of(
        verdict, {}, reason, closure=closure, gap_before=ratio['before'],
        gap_after=ratio['after'], noise_floor=1.0, effects=effects if explained else [],
        partial=[] if explained else effects, held_out=True, candidates=[
            {'name': name, 'accepted': name in search.chosen.entries,
             'evidence': _evidence(search, name),
             'reason': '' if name in search.chosen.entries else
             'the evidence does not need it' if search.gains[name] < CERTAIN else
             'less than an encoder count, or no better on left-out blocks'}
            for name in sorted(search.gains, key=lambda name: -search.gains[name])],
        where=sorted(({'channel': f'joint_{number}', 'regime': 'log',
                       'excess': float(before[u] / floor[u]),
                       'excess_after': float(after[u] / floor[u])}
                      for u, number in enumerate(numbers)), key=lambda row: -row['excess']),
        **more)


def _evidence(search, name):
    """Evidence of an entry: with the others of the selected model, against that model without."""
    sign = 1 if name in search.chosen.entries else -1
    on, off = search.chosen.fit, search.trials[name].fit
    held = sign * (on.held - off.held)
    return {'ln_bayes_factor': search.gains[name], 'delta_bic': 2 * search.gains[name],
            'cv_gain': 2 * float(held.sum()), 'blocks_positive': int((held > 0).sum())}


def _effects(search, robot):
    """Accepted entries, largest gain first; a zero is an effect of each joint that it moves."""
    result = []
    for name in sorted(search.chosen.entries, key=lambda name: -search.gains[name]):
        rivals = _rivals(search, name)
        effect = {'names': [name, *rivals], 'evidence': _evidence(search, name)}
        if rivals:
            effect['rivals'] = [{'name': rival,
                                 'evidence': _evidence(search, rival),
                                 'parameters': _parameters(search, search.trials[rival], rival,
                                                           robot)} for rival in rivals]
        parts = _parameters(search, search.chosen, name, robot)
        if CATALOGUE[name].each != 'joint':
            result.append(effect | {'parameters': parts})
            continue
        s = search.servos
        moved = s.visible(search.chosen, search.trials[name]) & s.changed(search.chosen, name)
        for unit in np.flatnonzero(moved):
            number = s.units[unit][2]
            own = {key: {'value': entry['each'][str(number)], 'unit': entry['unit'],
                         'interval': entry['intervals'][str(number)],
                         'file': entry['files'][str(number)],
                         'written': float(catalogue_values(search.values()[unit],
                                                           robot)[name][key])}
                   for key, entry in parts.items()}
            result.append(effect | {'joint': number, 'parameters': own})
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


def _parameters(search, trial, name, robot):
    """Parameter -> value (median joint), unit, 95 % interval, value in the file, each joint's."""
    s, spec, joined = search.servos, CATALOGUE[name].parameters, {}
    file = file_sets(robot, flown=True)
    # An entry that the log neither needs nor excludes widens the intervals of the others.
    possible = [trial, *(search.trials[other] for other, gain in search.gains.items()
                         if trial is search.chosen and other not in trial.entries
                         and gain > -CERTAIN)]
    for parameter in spec:
        each, ends, files = {}, {}, {}
        for unit, (*_, number) in enumerate(s.units):
            def reported(values, unit=unit, parameter=parameter):
                value = catalogue_values(values, robot)[name][parameter]
                return value - _constant(s, unit, values) if name == 'joint_offset' else value
            estimates = [_derived(one, unit, reported) for one in possible]
            each[str(number)] = estimates[0][0]
            ends[str(number)] = [min(value - WIDTH * error for value, error in estimates),
                                 max(value + WIDTH * error for value, error in estimates)]
            files[str(number)] = float(reported(file[number - 1]))
        low, high = np.median(list(ends.values()), axis=0)
        joined[parameter] = {
            'value': float(np.median(list(each.values()))), 'unit': spec[parameter].unit,
            'file': float(np.median(list(files.values()))),
            'interval': [max(float(low), spec[parameter].low), float(high)],
            'each': each, 'intervals': ends, 'files': files}
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
    """A function of a unit's parameter set, and its standard error by the delta method."""
    theta = trial.fit.theta[unit]
    covariance = trial.fit.spread()[unit]
    value, slopes = function(decoded(theta)), np.zeros(len(theta))
    for p in np.flatnonzero(mask(trial.entries)):
        step = STEP * max(np.sqrt(covariance[p, p]), 1e-9)
        moved = theta.copy()
        moved[p] += step
        slopes[p] = (function(decoded(moved)) - value) / step
    return float(value), float(np.sqrt(slopes @ covariance @ slopes))
