"""`beetle_omni identify joint`: results of an identification as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.inference.hierarchy import WIDTH
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo.fit import (
    encoded,
    ENTRIES,
    error_rms,
    Found,
    LIMITS,
    LOGARITHMIC,
    mask,
    select,
    Servos,
    Trial,
)
from beetle_omni_ros.identify.servo.log import JointLog
from beetle_omni_ros.identify.servo.model import INDEX, NAMES, simulate, TERMS
from beetle_omni_ros.identify.servo.robot import catalogue_values, file_sets, held
from beetle_omni_ros.robot.parameters import RobotParameters

ALWAYS = tuple(ENTRIES)[:3]     # gains, delay and friction, which every servo has
# An error that changes with the angle presupposes a constant one, as a slope does an intercept.
AFTER = {'joint_encoder_error': 'joint_offset', 'joint_load': 'joint_offset'}
DELAYS = np.arange(0.0, 0.12, 5e-4)     # [s] of a line
RATE = 100.0        # [Hz] of a proposed log


@dataclass(frozen=True)
class Plan:
    """A sine on the joints, and the half widths of the intervals that it would give."""

    frequency: float
    amplitude: float
    delay: float
    natural_frequency: float


def identify(logs: Sequence[JointLog], robot: RobotParameters,
             fitted: float | None = None, one_delay: bool = False) -> Found:
    """
    Identify the servos from the first part of some logs.

    The model with the largest evidence predicts best; the robot file is the centre of the prior.
    """
    return select(Servos(logs, file_sets(robot), fitted, one_delay), ALWAYS, list(ENTRIES),
                  after=AFTER)


def interval(found: Found, trial: Trial, unit: int, name: str) -> tuple[float, float]:
    """95 % interval of a term of a unit; open for a limit that the logs did not reach."""
    p = INDEX[name]
    log = found.servos.logs[found.servos.units[unit][0]]
    if not mask(trial.entries)[p]:
        reached = {'velocity_limit': log.speed().max(),
                   'torque_limit': np.abs(log.command - log.measured).max()}
        value = float(found.values(trial)[unit, p])
        return (float(reached[name]), np.inf) if name in reached else (value, value)
    width = WIDTH * np.sqrt(trial.fit.spread()[unit, p, p])
    ends = trial.fit.theta[unit, p] + width * np.array([-1, 1])
    low, high = np.exp(ends) if LOGARITHMIC[p] else ends
    return max(float(low), TERMS[name].low), min(float(high), TERMS[name].high)


def line(log: JointLog, joint: int, rows: np.ndarray) -> dict:
    """
    Fit readings = (1 + gain) command(t - delay) + offset to some rows of a joint.

    The competitor of the servo model: 3 numbers without friction and bandwidth.
    """
    rest = np.setdiff1d(np.flatnonzero(log.fresh), np.arange(rows[-1] + 1))
    best: tuple = (np.inf,)
    for delay in DELAYS:
        late, after = (np.stack([log.command_at(joint, log.read_t[part] - delay),
                                 np.ones(len(part))], axis=1) for part in (rows, rest))
        fitted = np.linalg.lstsq(late, log.measured[joint, rows], rcond=None)[0]
        size = np.mean((late @ fitted - log.measured[joint, rows])**2)
        if size < best[0]:
            best = size, delay, fitted, np.mean((after @ fitted - log.measured[joint, rest])**2)
    _, delay, (slope, offset), error = best
    return {'gain': float(slope - 1), 'offset_rad': float(offset), 'delay_s': float(delay),
            'heldout_rms_rad': float(np.sqrt(error))}


def joint_results(found: Found, validations: Sequence[JointLog], robot: RobotParameters) -> dict:
    """Return ``meta``, ``joints`` (those of the first log) and ``text``, their summary."""
    log, plan = found.servos.logs[0], separating_sine(found)
    joints = [_joint(found, unit, validations, robot, plan)
              for unit, (k, *_) in enumerate(found.servos.units) if k == 0]
    return {'meta': {'log': log.name, 'logs': [each.name for each in found.servos.logs],
                     'validate': [other.name for other in validations],
                     'fitted_part': shipped().servo.fitted, 'version': __version__},
            'joints': joints, 'text': _merged(joints)}


def _joint(found, unit, validations, robot, plan):
    log, (_, index, number) = found.servos.logs[0], found.servos.units[unit]
    file, is_held = file_sets(robot)[number - 1], held(robot)
    values, end = found.values()[unit], log.end_of(shipped().servo.fitted)
    first, last = slice(0, end), slice(end, None)
    known = [(other, other.joints.index(number) if number in other.joints else None)
             for other in validations]
    derived = catalogue_values(values, robot)
    traded, straight = inseparable(found, unit), line(log, index, found.servos.rows[0])
    heldout = error_rms(log, index, values, part=last)
    return {
        'joint': number, 'line': straight, 'holds_for': log.first(shipped().servo.fitted).motion(
            index), 'best': 'servo' if heldout <= straight['heldout_rms_rad'] else 'line',
        'published_rms_rad': error_rms(log, index, file, is_held),
        'fit_rms_rad': error_rms(log, index, values, part=first),
        'heldout_rms_rad': heldout,
        'validation_rms_rad': [None if k is None else error_rms(other, k, values)
                               for other, k in known],
        'published_heldout_rms_rad': error_rms(log, index, file, is_held, part=last),
        'published_validation_rms_rad': [
            None if k is None else error_rms(other, k, file, is_held) for other, k in known],
        'terms': _terms(found, unit),
        'traded': traded,
        'text': sentences(found, unit, traded, plan) + beaten(heldout, straight),
        'experiment': {'frequency_Hz': plan.frequency, 'amplitude_rad': plan.amplitude,
                       'duration_s': shipped().servo.sine_time, 'delay_half_width_s': plan.delay,
                       'natural_frequency_half_width_rad_s': plan.natural_frequency},
        'derived': {'inertia_kg_m2': robot.joints.inertia,
                    'kp_N_m_per_rad': derived['joint_bandwidth']['kp'],
                    'kd_N_m_s_per_rad': derived['joint_bandwidth']['kd'],
                    'coulomb_friction_N_m': derived['joint_friction']['coulomb']}}


def _terms(found, unit):
    """Every term; a rejected one as fitted when its entry was tried last."""
    result = {}
    for entry, names in ENTRIES.items():
        kept = entry in found.chosen.entries
        trial = found.chosen if kept else found.trials.get(entry, found.chosen)
        for name in names:
            low, high = interval(found, trial, unit, name)
            result[name] = {'value': float(found.values(trial)[unit, INDEX[name]]),
                            'unit': TERMS[name].unit, 'kept': kept,
                            'interval': [low, high if np.isfinite(high) else None]}
    return {name: result[name] for name in NAMES}


def inseparable(found: Found, unit: int) -> list[list[str]]:
    """Pairs of terms of a unit, both badly determined, that move together."""
    covariance = found.chosen.fit.spread()[unit]
    scale = np.array([term.scale for term in TERMS.values()])
    deviation = np.sqrt(np.diag(covariance))
    loose = [p for p in np.flatnonzero(mask(found.chosen.entries))
             if WIDTH * deviation[p] > shipped().servo.loose * scale[p]]
    return [sorted([NAMES[p], NAMES[o]]) for k, p in enumerate(loose) for o in loose[k + 1:]
            if abs(covariance[p, o]) > shipped().servo.traded * deviation[p] * deviation[o]]


def separating_sine(found: Found) -> Plan:
    """
    The sine that would determine the delay best, by the information that it adds.

    It moves all joints at once with the fitted values and noise of the first log.
    """
    p, fit, s = shipped().servo, found.chosen.fit, found.servos
    first = np.array(s.labels['log']) == 0
    values, active = found.values()[first], mask(found.chosen.entries)
    plans = []
    for frequency in p.sines:
        amplitude = min(p.sine_amplitude, p.sine_speed / (2 * np.pi * frequency))
        t = np.arange(0.0, p.sine_time, 1 / RATE)
        command = np.tile(amplitude * np.sin(2 * np.pi * frequency * t), (len(values), 1))
        blank = JointLog('sine', t, s.logs[0].joints, command, command)
        log = JointLog('sine', t, s.logs[0].joints,
                       simulate(blank, np.arange(len(values)), values), command)
        plan = Servos([log], np.tile(values[0], (4, 1)), fitted=1.0)
        plan.sigma = s.sigma[first] * np.sqrt(s.inflation)
        _, slopes = plan(encoded(values), active)
        more = sum(part.T @ (j @ j.T) @ part
                   for part, j in zip(fit.s[first], slopes, strict=True))
        spread = fit.s @ np.linalg.inv(np.linalg.inv(fit.covariance()) + more) \
            @ fit.s.transpose(0, 2, 1)
        width = WIDTH * np.sqrt(np.diagonal(spread, axis1=1, axis2=2)[first].max(axis=0))
        plans.append(Plan(float(frequency), float(amplitude), float(width[INDEX['delay']]),
                          float(width[0] * values[:, 0].mean())))
    return min(plans, key=lambda plan: plan.delay)


def sentences(found: Found, unit: int, traded: list[list[str]], plan: Plan) -> list[str]:
    """Inseparable pairs, proposed experiment and limits that were not reached, in sentences."""
    text = []
    pairs = [' and '.join(
        f'{TERMS[name].words or name} {_range(name, interval(found, found.chosen, unit, name))}'
        for name in pair) for pair in traded]
    if pairs:
        text.append(f'This log does not separate {"; ".join(pairs)}: larger and smaller values '
                    'predict it equally well.')
    if ['delay', 'natural_frequency'] in traded:
        text.append(
            f'To separate delay and bandwidth, log a sine of {plan.frequency:g} Hz and '
            f'{plan.amplitude:.2f} rad for {shipped().servo.sine_time:g} s (several reversals a '
            f'second): it would give the delay to +-{1e3 * plan.delay:.1f} ms and the natural '
            f'frequency to +-{plan.natural_frequency:.1f} rad/s.')
    unmet = [name for entry in LIMITS if entry not in found.chosen.entries
             for name in ENTRIES[entry]]
    if unmet:
        values = found.values()[unit]
        used = ' and '.join(f'{values[INDEX[name]]:.3g} {TERMS[name].unit}' for name in unmet)
        text.append(f'Not reached in this log: {" and ".join(TERMS[n].words for n in unmet)}; '
                    f'predictions use {used} as in the robot file.')
    return text


def beaten(heldout: float, straight: dict) -> list[str]:
    """A sentence if the line predicts the held-out part better than the servo model."""
    error = straight['heldout_rms_rad']
    return [] if heldout <= error else [
        f'A line (gain {1 + straight["gain"]:.3f}, offset {1e3 * straight["offset_rad"]:.1f} '
        f'mrad, delay {1e3 * straight["delay_s"]:.1f} ms) predicts the held-out part better, '
        f'{1e3 * error:.1f} instead of {1e3 * heldout:.1f} mrad: the fitted part does not '
        'determine the servo for that motion. Log all its angles, in both directions, twice.']


def _range(name, ends):
    if name == 'delay':
        return f'({1e3 * ends[0]:.0f} to {1e3 * ends[1]:.0f} ms)'
    return f'({ends[0]:.3g} to {ends[1]:.3g} {TERMS[name].unit})'.replace(' 1)', ')')


def _merged(joints):
    """Sentences of all joints without repetition, with the numbers of their joints."""
    about: dict[str, list[str]] = {}
    for joint in joints:
        for text in joint['text']:
            about.setdefault(text, []).append(str(joint['joint']))
    return [f'Joint{"s" if len(numbers) > 1 else ""} {", ".join(numbers)}: {text}'
            for text, numbers in about.items()]
