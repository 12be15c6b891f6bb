"""Results of a joint identification: numbers, sentences, tables, figures and a robot file."""

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.joint import error_rms, JointModel
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.joint_servos import FileServos
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.robot_file import rounded, write_robot_file
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, published_set, simulate, TERMS
from beetle_omni_ros.identify.servo_terms import CANDIDATES, LINEAR
from beetle_omni_ros.pages.figures import COLOURS, FAINT, INK, legend, line, panels, STYLE, svg
from beetle_omni_ros.pages.page import page, section
from beetle_omni_ros.pages.table import Grid
from beetle_omni_ros.robot.parameters import JointParameters

MILLI = 1e3


def joint_results(log: JointLog, validations: list[JointLog], models: list[JointModel],
                  published: JointParameters, servos: FileServos | None = None) -> dict:
    """
    Results of an identification as plain data.

    ``servos`` are those of the robot file with its effects; default: without effects.
    """
    if servos is None:
        servos = FileServos(np.tile(published_set(published), (len(models), 1)), held=False)
    joints = [_joint(log, k, validations, model, published, servos)
              for k, model in enumerate(models)]
    return {'meta': {'log': log.name, 'validate': [other.name for other in validations],
                     'fitted_part': shipped().servo.fitted, 'version': __version__},
            'joints': joints, 'text': _merged(joints)}


def _merged(joints):
    """Sentences of all joints without repetition, with the numbers of their joints."""
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
        'traded': model.inseparable,
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
    """Inseparable pairs, proposed experiment and limits that were not reached, in sentences."""
    text = []
    intervals = model.uncertainty.intervals
    for pair in model.inseparable:
        parts = [f'{TERMS[name].words or name} {_range(name, intervals[INDEX[name]])}'
                 for name in pair]
        text.append(f'This log does not separate {" and ".join(parts)}: a larger and a smaller '
                    'value predict it equally well.')
    if ['delay', 'natural_frequency'] in model.inseparable:
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
        text.append(f'Not reached in this log: {" and ".join(TERMS[n].words for n in unmet)}; '
                    f'predictions use {used} as published. A sine of 1.5 rad, fast enough for '
                    f'{1.2 * model.values[INDEX["velocity_limit"]]:.0f} rad/s, would show them.')
    return text


def _range(name, interval):
    if name == 'delay':
        return f'({1e3 * interval[0]:.0f} to {1e3 * interval[1]:.0f} ms)'
    return f'({interval[0]:.3g} to {interval[1]:.3g} {TERMS[name].unit})'.replace(' 1)', ')')


def write_joint_file(path: Path, results: dict, base: Path | None) -> None:
    """
    Write a robot file that extends ``base`` by the identified servo.

    A robot file has one servo for all joints: the median. Terms without a key in its joint model
    (delay, friction) are below ``provenance``, joint by joint.

    Args:
        path: output file.
        results: results of :func:`joint_results`.
        base: extended robot file; None: the shipped one.

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


def grids(results: dict, brief: bool = False) -> list[Grid]:
    """Errors and terms, a column for each joint; ``brief``: only terms of some joint's model."""
    joints = results['joints']
    header = ['', *(f'joint {joint["joint"]}' for joint in joints)]
    rows = [[text, *(_milli(joint[key]) for joint in joints)] for text, key in (
        ('published, whole log', 'published_rms_rad'),
        ('published, held-out part', 'published_heldout_rms_rad'),
        ('identified, fitted part', 'fit_rms_rad'),
        ('identified, held-out part', 'heldout_rms_rad'))]
    for k, name in enumerate(results['meta']['validate']):
        for text, key in (('published', 'published_validation_rms_rad'),
                          ('identified', 'validation_rms_rad')):
            rows.append([f'{text}, {name}', *(_milli(joint[key][k]) for joint in joints)])
    errors = Grid('Prediction error, RMS [mrad]', header, rows)
    names = [name for name in joints[0]['terms'] if not brief
             or any(joint['terms'][name]['kept'] for joint in joints)]
    rows = [[f'{name} [{_unit(joints[0]["terms"][name]["unit"])}]',
             *(_value(joint['terms'][name]) for joint in joints)] for name in names]
    unused = frozenset(k for k, name in enumerate(names)
                       if not any(joint['terms'][name]['kept'] for joint in joints))
    return [errors, Grid('Terms with 95 % interval; in brackets: not in the model, did not '
                         'improve the prediction of held-out data', header, rows, unused)]


def _milli(value):
    return 'absent' if value is None else f'{MILLI * value:.2f}'


def _unit(unit):
    return {'s': 'ms', 'rad': 'mrad'}.get(unit, unit)


def _value(term):
    factor = MILLI if term['unit'] in ('s', 'rad') else 1.0
    numbers = [None if v is None else factor * v for v in (term['value'], *term['interval'])]
    value, low, high = ('inf' if v is None else f'{v:.{digits}g}' if abs(v) < 99.5 else f'{v:.0f}'
                        for v, digits in zip(numbers, (3, 2, 2), strict=True))
    text = f'{value},\n{low}..{high}'      # two lines: four joints fit into 80 columns
    return text if term['kept'] else f'[{text}]'


def joint_page(log: JointLog, validations: list[JointLog], models: list[JointModel],
               published: FileServos, results: dict, head: str = '',
               tables: list[Grid] | tuple = ()) -> str:
    """HTML page with the tables, ``tables`` first, and figures."""
    with matplotlib.rc_context(STYLE):
        sections = []
        for k, other in enumerate([log, *validations]):
            end = shipped().servo.fitted if k == 0 else None
            title = other.name + (': fitted to the shaded part' if k == 0 else ': not fitted')
            sections.append(section(title, 'Command, measured position, and simulations of the '
                                    'published and the identified model.',
                                    svg(_responses(other, models, published, end), title)))
            sections.append(section(f'Errors, {other.name}', 'Model minus measurement.',
                                    svg(_errors(other, models, published, end), 'errors')))
        sections.append(section('Friction and lag', 'Position error over commanded speed: a line '
                                'means lag, a gap between the branches means a dead band.',
                                svg(_loops(log, models), 'position error over speed')))
    return page('Tilt servos', f'identified from {log.name}', [*tables, *grids(results)],
                results['text'], sections, head)


def _pairs(log, models):
    """(index in the log, index of the model, model) of the joints that both have."""
    return [(log.joints.index(model.joint), k, model) for k, model in enumerate(models)
            if model.joint in log.joints]


def _responses(log, models, published, end) -> Figure:
    pairs = _pairs(log, models)
    figure, axes = panels(len(pairs), height=1.9, sharex=True)
    for axis, (k, own, model) in zip(axes[:, 0], pairs, strict=True):
        t = log.t - log.t[0]
        _shade(axis, t, end)
        line(axis, t, log.command[k], color=FAINT, lw=1.0, label='command')
        line(axis, t, log.measured[k], color=INK, lw=1.4, label='measured')
        line(axis, t, simulate(log, k, published.sets[own], published.held)[0], color=COLOURS[1],
             lw=0.9, label='published model')
        line(axis, t, simulate(log, k, model.values[None])[0], color=COLOURS[0], lw=0.9,
             label='identified model')
        axis.set_ylabel(f'joint {model.joint} [rad]')
    axes[-1, 0].set_xlabel('time [s]')
    legend(figure, axes[0, 0])
    return figure


def _errors(log, models, published, end) -> Figure:
    pairs = _pairs(log, models)
    figure, axes = panels(len(pairs), 2, height=1.5, sharex=True)
    for row, (k, own, model) in zip(axes, pairs, strict=True):
        t = log.t - log.t[0]
        for axis, values, held, colour, name in (
                (row[0], published.sets[own], published.held, COLOURS[1], 'published'),
                (row[1], model.values, True, COLOURS[0], 'identified')):
            _shade(axis, t, end)
            error = MILLI * (simulate(log, k, values, held)[0] - log.measured[k])
            line(axis, t, error, color=colour, lw=0.8)
            axis.set_title(f'joint {model.joint}, {name}')
            axis.set_ylabel('error [mrad]')
    for axis in axes[-1]:
        axis.set_xlabel('time [s]')
    return figure


def _loops(log, models) -> Figure:
    pairs = _pairs(log, models)
    figure, axes = panels(1, len(pairs), height=2.8, sharey=True)
    for axis, (k, own, model) in zip(axes[0], pairs, strict=True):
        speed = np.gradient(log.command[k], log.t)
        axis.plot(speed, MILLI * (log.measured[k] - log.command[k]), color=INK, lw=0.8,
                  label='measured')
        predicted = simulate(log, k, model.values[None])[0]
        axis.plot(speed, MILLI * (predicted - log.command[k]), color=COLOURS[0], lw=0.8,
                  label='identified')
        axis.set_title(f'joint {model.joint}')
        axis.set_xlabel('commanded speed [rad/s]')
    axes[0, 0].set_ylabel('position error [mrad]')
    legend(figure, axes[0, 0])
    return figure


def _shade(axis, t, end):
    if end is not None:
        axis.axvspan(t[0], t[0] + end * (t[-1] - t[0]), color='#eef3f8', lw=0)
