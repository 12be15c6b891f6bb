"""Results of a joint identification: what INTERFACES fixes, sentences, and a robot file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.joint import error_rms, JointModel
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.joint_servos import FileServos
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.robot_file import rounded, write_robot_file
from beetle_omni_ros.identify.selection import CANDIDATES, LINEAR
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, published_set, TERMS
from beetle_omni_ros.robot.parameters import JointParameters


def joint_results(log: JointLog, validations: list[JointLog], models: list[JointModel],
                  published: JointParameters, servos: FileServos | None = None) -> dict:
    """
    Results of an identification as plain data.

    Args:
        log: fitted log.
        validations: further logs of the same servos.
        models: models of the log's joints, in its order.
        published: gains and limits of the robot file.
        servos: servos of the robot file with its effects; default: without effects.

    """
    if servos is None:
        servos = FileServos(np.tile(published_set(published), (len(models), 1)), held=False)
    joints = [_joint(log, k, validations, model, published, servos)
              for k, model in enumerate(models)]
    return {'meta': {'log': log.name, 'validate': [other.name for other in validations],
                     'fitted_part': shipped().servo.fitted, 'version': __version__},
            'joints': joints, 'text': _merged(joints)}


def _merged(joints):
    """Sentences of all joints, each once, with the joints that it is about."""
    about: dict[str, list[str]] = {}
    for joint in joints:
        for text in joint['text']:
            about.setdefault(text, []).append(str(joint['joint']))
    return [f'Joint{"s" if len(numbers) > 1 else ""} {", ".join(numbers)}: {text}'
            for text, numbers in about.items()]


def _joint(log, index, validations, model, published, servos):
    end = log.end_of(shipped().servo.fitted)
    first, last = slice(0, end), slice(end, None)
    start, held, inertia = servos.sets[index], servos.held, published.inertia
    wn, zeta = (model.values[INDEX[name]] for name in LINEAR)
    kp = inertia * wn**2
    known = [(other, other.joints.index(model.joint) if model.joint in other.joints else None)
             for other in validations]
    return {
        'joint': model.joint,
        'published_rms_rad': error_rms(log, index, start, held),
        'fit_rms_rad': error_rms(log, index, model.values, part=first),
        'heldout_rms_rad': error_rms(log, index, model.values, part=last),
        'validation_rms_rad': [None if k is None else error_rms(other, k, model.values)
                               for other, k in known],
        'published_heldout_rms_rad': error_rms(log, index, start, held, part=last),
        'published_validation_rms_rad': [
            None if k is None else error_rms(other, k, start, held) for other, k in known],
        'terms': {name: _term(model, name) for name in NAMES},
        'traded': model.traded,
        'text': sentences(model),
        'experiment': {'frequency_Hz': model.experiment.frequency,
                       'amplitude_rad': model.experiment.amplitude,
                       'duration_s': model.experiment.duration,
                       'delay_half_width_s': model.experiment.delay_width,
                       'natural_frequency_half_width_rad_s': model.experiment.frequency_width},
        'derived': {'inertia_kg_m2': inertia, 'kp_N_m_per_rad': kp,
                    'kd_N_m_s_per_rad': 2 * zeta * wn * inertia,
                    'coulomb_friction_N_m': kp * model.values[INDEX['coulomb_friction']]}}


def _term(model, name):
    kept = name in LINEAR or any(name in CANDIDATES[c].members for c in model.kept)
    value = model.values[INDEX[name]] if kept else model.estimates[INDEX[name]]
    low, high = model.uncertainty.intervals[INDEX[name]]
    return {'value': float(value), 'unit': TERMS[name].unit, 'kept': kept,
            'interval': [float(v) if np.isfinite(v) else None for v in (low, high)]}


def sentences(model: JointModel) -> list[str]:
    """What a person should know beside the numbers."""
    text = []
    intervals = model.uncertainty.intervals
    for pair in model.traded:
        parts = [f'{TERMS[name].words or name} {_range(name, intervals[INDEX[name]])}'
                 for name in pair]
        text.append(f'This log trades {" against ".join(parts)}: more of one with less of the '
                    'other predicts it equally well.')
    if ['delay', 'natural_frequency'] in model.traded:
        plan = model.experiment
        text.append(
            f'To separate delay and bandwidth, log a sine of {plan.frequency:g} Hz and '
            f'{plan.amplitude:.2f} rad for {plan.duration:g} s (several reversals a second): it '
            f'would give the delay to +-{1e3 * plan.delay_width:.1f} ms and the natural frequency '
            f'to +-{plan.frequency_width:.1f} rad/s.')
    unmet = [name for name in ('velocity_limit', 'torque_limit') if name not in model.kept]
    if unmet:
        used = ' and '.join(f'{model.values[INDEX[name]]:.3g} {TERMS[name].unit}'
                            for name in unmet)
        text.append(f'Not met in this log: {" and ".join(TERMS[name].words for name in unmet)}; '
                    f'predictions use {used} as published. A sine of 1.5 rad, fast enough for '
                    f'{1.2 * model.values[INDEX["velocity_limit"]]:.0f} rad/s, would show them.')
    return text


def _range(name, interval):
    if name == 'delay':
        return f'({1e3 * interval[0]:.0f} to {1e3 * interval[1]:.0f} ms)'
    return f'({interval[0]:.3g} to {interval[1]:.3g} {TERMS[name].unit})'.replace(' 1)', ')')


def write_joint_file(path: Path, results: dict, base: Path | None) -> None:
    """
    Write a robot file with the identified servo on top of the one that was believed.

    A robot file has one servo for all joints: the median. What its joint model has no key for
    (delay, friction) stands under ``provenance``, joint by joint.

    Args:
        path: to write.
        results: of :func:`joint_results`.
        base: the robot file that was believed; None: the shipped one.

    Raises:
        ParameterError: the file cannot be written.

    """
    joints = results['joints']
    middle = {key: float(np.median([joint['derived'][key] for joint in joints]))
              for key in ('kp_N_m_per_rad', 'kd_N_m_s_per_rad')}
    servo = {'kp': rounded(middle['kp_N_m_per_rad']), 'kd': rounded(middle['kd_N_m_s_per_rad'])}
    limits = [joint['terms']['velocity_limit'] for joint in joints]
    if all(term['kept'] for term in limits):
        servo['velocity_limit'] = rounded(float(np.median([t['value'] for t in limits])))
    torque = [joint['terms']['torque_limit'] for joint in joints]
    if all(term['kept'] for term in torque):
        servo['effort_limit'] = rounded(servo['kp'] * float(np.median(
            [term['value'] for term in torque])))
    content = {'joints': servo,
               'provenance': {'log': results['meta']['log'], 'version': __version__,
                              'heldout_rms_rad': [rounded(j['heldout_rms_rad']) for j in joints],
                              'joint_terms': {f'gimbal{j["joint"]}': {
                                  name: rounded(term['value'])
                                  for name, term in j['terms'].items() if term['kept']}
                                  for j in joints}}}
    head = ('# Tilt servos identified by `beetle_omni identify joint`. SI units: kp [N m/rad],\n'
            '# kd [N m s/rad] for the inertia of the file below; angles [rad], delay [s].\n')
    write_robot_file(path, head, content, base)
