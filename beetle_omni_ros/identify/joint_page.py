"""Tables and figures of a joint identification."""

from __future__ import annotations

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.identify.joint import JointModel
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.joint_servos import FileServos
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_model import simulate
from beetle_omni_ros.pages.figures import COLOURS, FAINT, INK, legend, line, panels, STYLE, svg
from beetle_omni_ros.pages.page import page, section
from beetle_omni_ros.pages.table import Grid

MILLI = 1e3


def grids(results: dict, brief: bool = False) -> list[Grid]:
    """Errors and terms, a column for each joint; ``brief``: only terms that some joint has."""
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
    return [errors, Grid('Terms, with 95 % interval; in brackets: not in the model, did not '
                         'improve the prediction of unseen data', header, rows, unused)]


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
    """HTML page with the tables, further ones first, what cannot be told, and figures."""
    with matplotlib.rc_context(STYLE):
        sections = []
        for k, other in enumerate([log, *validations]):
            end = shipped().servo.fitted if k == 0 else None
            title = other.name + (': fitted to the shaded part' if k == 0 else ': not fitted')
            sections.append(section(title, 'Command, measured position, published and identified '
                                    'model, which run freely from the first sample on.',
                                    svg(_responses(other, models, published, end), title)))
            sections.append(section(f'Errors, {other.name}', 'Model minus measurement.',
                                    svg(_errors(other, models, published, end), 'errors')))
        sections.append(section('Friction and lag', 'Position error over commanded speed: a '
                                'straight line is lag, the gap between the branches a dead band.',
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
