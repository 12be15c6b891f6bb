"""Identification of servos from response logs: results as plain data, tables and figures."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.inference.hierarchy import WIDTH
from beetle_omni_ros.identify.servo.fit import (
    error_rms,
    LOGARITHMIC,
    mask,
    rms,
    Search,
    select,
    ServoModel,
    Servos,
)
from beetle_omni_ros.identify.servo.log import FITTED, JointLog
from beetle_omni_ros.identify.servo.model import (
    ENTRIES,
    file_sets,
    held,
    INDEX,
    LIMITS,
    NAMES,
    simulate,
    TERMS,
)
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.figures import AFTER, BEFORE, FAINT, INK, legend, panels, STYLE, svg
from beetle_omni_ros.show.page import Grid, section

MILLI = 1e3
SMALL = {'s': 'm', 'rad': 'm'}      # unit -> prefix in tables
# Gains, delay, friction and a zero, which every servo has, ...
SERVO = 'joint_bandwidth', 'joint_command_latency', 'joint_friction', 'joint_offset'
# ... and the gain of a line. Without it, the damping takes up an error of 1 % of the amplitude of
# a slow motion, and predicts one of 10 % at three times its rate.
GAIN = 'reading_gain'
LOOSE = 1.5         # half width of an interval, in scales, below which no pair is reported
TRADED = 0.6        # least correlation of a pair that a log does not separate
DELAYS = np.arange(0.0, 0.12, 5e-4)     # [s] of a line
# RMS error -> its row of a table, model (the better one of servo and line: best) and part.
ERRORS = {
    'published_rms_rad': ('robot file, whole log', 'file', 'whole'),
    'published_heldout_rms_rad': ('robot file, held-out part', 'file', 'held out'),
    'fit_rms_rad': ('identified, fitted part', 'best', 'fitted'),
    'heldout_rms_rad': ('identified, held-out part', 'best', 'held out'),
    'servo_heldout_rms_rad': ('', 'servo', 'held out'),
    'published_validation_rms_rad': ('robot file, {}', 'file', 'further'),
    'validation_rms_rad': ('identified, {}', 'best', 'further')}
MOTIONS = {'angle_rad': 'angle [rad]', 'rate_rad_s': 'rate [rad/s]',
           'acceleration_rad_s2': 'acceleration [rad/s^2]'}


def identify(logs: Sequence[JointLog], robot: RobotParameters, as_file: bool = False) -> Search:
    """
    Identify the servos from the first part of some logs.

    The model with the largest evidence predicts best. The robot file as the simulator flies it is
    the centre of the prior. ``as_file``: with what a robot file states, which is one delay of all
    joints and no gain of the reading.
    """
    always = SERVO if as_file else (*SERVO, GAIN)
    allowed = [name for name in ENTRIES if name != GAIN]
    return select(Servos(logs, file_sets(robot, flown=True), as_file), always, allowed)


def interval(search: Search, trial: ServoModel, unit: int, name: str) -> tuple[float, float]:
    """95 % interval of a term of a unit; open for a limit that the logs did not reach."""
    p = INDEX[name]
    log = search.servos.logs[search.servos.units[unit][0]]
    if not mask(trial.entries)[p]:
        value, reached = float(search.values(trial)[unit, p]), log.reached()
        return (reached[name], np.inf) if name in reached else (value, value)
    width = WIDTH * np.sqrt(trial.fit.spread()[unit, p, p])
    ends = trial.fit.theta[unit, p] + width * np.array([-1, 1])
    low, high = np.exp(ends) if LOGARITHMIC[p] else ends
    return max(float(low), TERMS[name].low), min(float(high), TERMS[name].high)


def fitted_line(log: JointLog, joint: int, rows: np.ndarray) -> tuple[float, float, float]:
    """
    Delay, slope and offset of readings = slope command(t - delay) + offset at rows of a joint.

    The competitor of the servo model: 3 numbers without friction and bandwidth.
    """
    read, size = log.measured[joint, rows], np.inf
    for delay in DELAYS:
        late = np.stack([log.command_at(joint, log.read_t[rows] - delay), np.ones(len(rows))])
        slope, offset = np.linalg.lstsq(late.T, read, rcond=None)[0]
        error = np.mean((slope * late[0] + offset - read)**2)
        if error < size:
            size, best = error, (float(delay), float(slope), float(offset))
    return best


def line_at(line: tuple[float, float, float], log: JointLog, joint: int) -> np.ndarray:
    """Predictions (N,) of a line [rad]; nan in rows without a reading."""
    delay, slope, offset = line
    return slope * log.command_at(joint, log.read_t - delay) + offset


def left_out_rms(search: Search, unit: int) -> tuple[float, float]:
    """RMS errors [rad] of servo and line at kinds of motion that their fits leave out."""
    s, fit, (k, joint, _) = search.servos, search.chosen.fit, search.servos.units[unit]
    log, block, rows = s.logs[k], s.blocks[unit], s.rows[k]
    errors, slopes = s.errors(k, fit.theta, mask(search.chosen.entries))
    moved = slopes[:, joint].T @ fit.s[unit] @ fit.deviations.T
    servo = errors[joint] + moved[np.arange(len(rows)), block]
    line = [(line_at(fitted_line(log, joint, rows[block != b]), log, joint)
             - log.measured[joint])[rows[block == b]] for b in np.unique(block)]
    return rms(servo), rms(np.concatenate(line))


def joint_results(search: Search, validations: Sequence[JointLog], robot: RobotParameters) -> dict:
    """Return ``meta``, ``joints`` (those of the first log) and ``text``, their summary."""
    joints = [_joint(search, unit, validations, robot)
              for unit, (k, *_) in enumerate(search.servos.units) if k == 0]
    about: dict[str, list[str]] = {}    # sentence -> numbers of the joints that have it
    for joint in joints:
        for text in joint['text']:
            about.setdefault(text, []).append(str(joint['joint']))
    return {'meta': {'logs': [log.name for log in search.servos.logs],
                     'validate': [other.name for other in validations],
                     'converged': bool(search.chosen.fit.converged), 'version': __version__},
            'joints': joints, 'text': [
                f'Joint{"s" if len(numbers) > 1 else ""} {", ".join(numbers)}: {text}'
                for text, numbers in about.items()]}


def _joint(search, unit, validations, robot):
    log, (_, index, number) = search.servos.logs[0], search.servos.units[unit]
    file, is_held, values = file_sets(robot)[number - 1], held(robot), search.values()[unit]
    line, apart = fitted_line(log, index, search.servos.rows[0]), left_out_rms(search, unit)
    known = [(other, other.joints.index(number) if number in other.joints else None)
             for other in validations]

    def errors(predicted):
        here = predicted(log, index)
        return {'whole': error_rms(log, index, here),
                'fitted': error_rms(log, index, here, slice(0, log.end)),
                'held out': error_rms(log, index, here, slice(log.end, None)),
                'further': [None if k is None else error_rms(other, k, predicted(other, k))
                            for other, k in known]}

    of = {'file': errors(lambda log, k: simulate(log, k, file, is_held)[0]),
          'servo': errors(lambda log, k: simulate(log, k, values)[0]),
          'line': errors(lambda log, k: line_at(line, log, k))}
    best = 'servo' if apart[0] <= apart[1] else 'line'
    of['best'], traded = of[best], inseparable(search, unit)
    return {
        'joint': number, 'best': best,
        'left_out_rms_rad': dict(zip(('servo', 'line'), apart, strict=True)),
        'line': {'gain': line[1] - 1, 'offset_rad': line[2], 'delay_s': line[0],
                 'heldout_rms_rad': of['line']['held out']},
        'holds_for': log.first().motion(index),
        **{key: of[model][part] for key, (_, model, part) in ERRORS.items()},
        'terms': _terms(search, unit), 'traded': traded,
        'text': sentences(search, unit, traded, best)}


def _terms(search, unit):
    """Every term; a rejected one as fitted when its entry was tried last."""
    result = {}
    for entry in sorted(ENTRIES, key=lambda name: name in search.chosen.entries):
        kept = entry in search.chosen.entries
        trial = search.chosen if kept else search.trials.get(entry, search.chosen)
        for name in ENTRIES[entry]:
            low, high = interval(search, trial, unit, name)
            result[name] = {'value': float(search.values(trial)[unit, INDEX[name]]),
                            'unit': TERMS[name].unit, 'kept': kept,
                            'interval': [low, high if np.isfinite(high) else None]}
    return {name: result[name] for name in NAMES}


def inseparable(search: Search, unit: int) -> list[list[str]]:
    """Pairs of terms of a unit, both badly determined, that move together."""
    covariance = search.chosen.fit.spread()[unit]
    scale = np.array([term.scale for term in TERMS.values()])
    deviation = np.sqrt(np.diag(covariance))
    loose = [p for p in np.flatnonzero(mask(search.chosen.entries))
             if WIDTH * deviation[p] > LOOSE * scale[p]]
    return [sorted([NAMES[p], NAMES[o]]) for k, p in enumerate(loose) for o in loose[k + 1:]
            if abs(covariance[p, o]) > TRADED * deviation[p] * deviation[o]]


def sentences(search: Search, unit: int, traded: list[list[str]], best: str) -> list[str]:
    """Inseparable pairs, proposed log, limits that were not reached, and a better line."""
    text = []
    pairs = [' and '.join(TERMS[name].words or name for name in pair) for pair in traded]
    if pairs:
        text.append(f'This log does not separate {"; ".join(pairs)}: larger and smaller values '
                    'predict it equally well.')
    if ['delay', 'natural_frequency'] in traded:
        text.append('To separate delay and bandwidth, log a 3.8 Hz sine of 0.25 rad for 10 s.')
    unmet = [name for entry in LIMITS if entry not in search.chosen.entries
             for name in ENTRIES[entry]]
    if unmet:
        values = search.values()[unit]
        used = ' and '.join(f'{values[INDEX[name]]:.3g} {TERMS[name].unit}' for name in unmet)
        text.append(f'Not reached in this log: {" and ".join(TERMS[n].words for n in unmet)}; '
                    f'predictions use {used} as in the robot file.')
    if best == 'line':
        text.append('A line (gain, offset, delay) predicts left-out kinds of motion better than '
                    'the servo model and gives the errors above: the log does not determine the '
                    'servo. Log all its angles, in both directions, twice.')
    return text


def grids(results: dict) -> list[Grid]:
    """Errors, range of motion and terms of the model, a column for each joint."""
    joints = results['joints']
    header = ['', *(f'joint {joint["joint"]}' for joint in joints)]
    errors = [(text, [joint[key] for joint in joints])
              for key, (text, _, part) in ERRORS.items() if text and part != 'further']
    errors.append(('line (gain, offset, delay), held-out part',
                   [joint['line']['heldout_rms_rad'] for joint in joints]))
    errors += [(text.format(name), [joint[key][k] for joint in joints])
               for k, name in enumerate(results['meta']['validate'])
               for key, (text, _, part) in ERRORS.items() if part == 'further']
    return [
        Grid('Prediction error, RMS [mrad]', header, [
            [text, *('absent' if one is None else f'{MILLI * one:.2f}' for one in values)]
            for text, values in errors]),
        Grid('Motion of the fitted part, for which the model holds', header, [
            [text, *('{:.3g}..{:.3g}'.format(*joint['holds_for'][key]) for joint in joints)]
            for key, text in MOTIONS.items()]),
        Grid('Terms with 95 % interval', header, [
            [f'{name} [{SMALL.get(term["unit"], "") + term["unit"]}]',
             *(_value(joint['terms'][name]) for joint in joints)]
            for name, term in joints[0]['terms'].items() if term['kept']])]


def _value(term):
    factor = MILLI if term['unit'] in SMALL else 1.0
    numbers = [None if v is None else factor * v for v in (term['value'], *term['interval'])]
    value, low, high = ('inf' if v is None else f'{v:.{digits}g}' if abs(v) < 99.5 else f'{v:.0f}'
                        for v, digits in zip(numbers, (3, 2, 2), strict=True))
    return f'{value},\n{low}..{high}'      # two lines: four joints fit into 80 columns


def flown_errors(logs: Sequence[JointLog], robots: dict[str, RobotParameters]) -> Grid:
    """Errors of robots as the simulator flies them, behind its delays and with the logs' zeros."""
    numbers = sorted({number for log in logs for number in log.joints})

    def error(log, robot, number):
        if number not in log.joints:
            return 'absent'
        k, values = log.joints.index(number), file_sets(robot, flown=True)[number - 1]
        return f'{MILLI * np.std((simulate(log, k, values)[0] - log.measured[k])[log.fresh]):.1f}'

    return Grid('RMS error of the servos as simulated, without zeros [mrad]',
                ['', *(f'joint {number}' for number in numbers)],
                [[f'{log.name}, {name}', *(error(log, robot, number) for number in numbers)]
                 for log in logs for name, robot in robots.items()])


def sections(search: Search, others: Sequence[JointLog], robot: RobotParameters) -> list[str]:
    """A section with responses and errors of each log."""
    logs = search.servos.logs
    models = dict(zip(logs[0].joints, search.values(), strict=False))     # of the first log
    with matplotlib.rc_context(STYLE):
        return [section(
            other.name + (': fitted to the shaded part' if k < len(logs) else ': not fitted'),
            'Left: command (grey) and measured position. Right: simulations of the robot file and '
            'of the identified model minus measurement.',
            svg(_figure(other, models, robot, k < len(logs)), other.name))
            for k, other in enumerate([*logs, *others]) if models.keys() & set(other.joints)]


def _figure(log, models, robot, fitted) -> Figure:
    pairs = [(k, number) for k, number in enumerate(log.joints) if number in models]
    file, is_held = file_sets(robot), held(robot)
    figure, axes = panels(len(pairs), 2, height=1.7, sharex=True)
    t, read = log.t - log.t[0], log.read_t[log.fresh] - log.t[0]
    for (left, right), (k, number) in zip(axes, pairs, strict=True):
        left.plot(t, log.command[k], color=FAINT, lw=1.0)
        left.plot(t, log.measured[k], color=INK, lw=1.4)
        left.set_ylabel(f'joint {number} [rad]')
        for values, hold, colour, name in ((file[number - 1], is_held, BEFORE, 'robot file'),
                                           (models[number], True, AFTER, 'identified')):
            error = MILLI * (simulate(log, k, values[None], hold)[0] - log.measured[k])
            right.plot(read, error[log.fresh], color=colour, lw=0.8, label=name)
        right.set_ylabel('error [mrad]')
        if fitted:
            for axis in (left, right):
                axis.axvspan(0, FITTED * t[-1], color='#eef3f8', lw=0)
    for axis in axes[-1]:
        axis.set_xlabel('time [s]')
    legend(figure, axes[0, 1])
    return figure
