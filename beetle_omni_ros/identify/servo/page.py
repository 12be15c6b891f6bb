"""Tables, figures and pages about identified servos."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros.identify.flights.page import head
from beetle_omni_ros.identify.servo.fit import Found
from beetle_omni_ros.identify.servo.log import FITTED, JointLog, read_joint_log
from beetle_omni_ros.identify.servo.model import simulate
from beetle_omni_ros.identify.servo.robot import file_sets, held
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.figures import COLOURS, FAINT, INK, legend, panels, STYLE, svg
from beetle_omni_ros.show.page import Grid, page, section

MILLI = 1e3


def grids(results: dict) -> list[Grid]:
    """Errors, range of motion and terms of the model, a column for each joint."""
    joints = results['joints']
    header = ['', *(f'joint {joint["joint"]}' for joint in joints)]
    rows = [[text, *(_milli(joint[key]) for joint in joints)] for text, key in (
        ('robot file, whole log', 'published_rms_rad'),
        ('robot file, held-out part', 'published_heldout_rms_rad'),
        ('identified, fitted part', 'fit_rms_rad'),
        ('identified, held-out part', 'heldout_rms_rad'))]
    rows.append(['line (gain, offset, delay), held-out part',
                 *(_milli(joint['line']['heldout_rms_rad']) for joint in joints)])
    for k, name in enumerate(results['meta']['validate']):
        for text, key in (('robot file', 'published_validation_rms_rad'),
                          ('identified', 'validation_rms_rad')):
            rows.append([f'{text}, {name}', *(_milli(joint[key][k]) for joint in joints)])
    errors = Grid('Prediction error, RMS [mrad]', header, rows)
    motion = Grid('Motion of the fitted part, for which the model holds', header, [
        [text, *('{:.3g}..{:.3g}'.format(*joint['holds_for'][key]) for joint in joints)]
        for text, key in (('angle [rad]', 'angle_rad'), ('rate [rad/s]', 'rate_rad_s'),
                          ('acceleration [rad/s^2]', 'acceleration_rad_s2'))])
    names = [name for name, term in joints[0]['terms'].items() if term['kept']]
    rows = [[f'{name} [{_unit(joints[0]["terms"][name]["unit"])}]',
             *(_value(joint['terms'][name]) for joint in joints)] for name in names]
    return [errors, motion, Grid('Terms with 95 % interval', header, rows)]


def _milli(value):
    return 'absent' if value is None else f'{MILLI * value:.2f}'


def _unit(unit):
    return {'s': 'ms', 'rad': 'mrad'}.get(unit, unit)


def _value(term):
    factor = MILLI if term['unit'] in ('s', 'rad') else 1.0
    numbers = [None if v is None else factor * v for v in (term['value'], *term['interval'])]
    value, low, high = ('inf' if v is None else f'{v:.{digits}g}' if abs(v) < 99.5 else f'{v:.0f}'
                        for v, digits in zip(numbers, (3, 2, 2), strict=True))
    return f'{value},\n{low}..{high}'      # two lines: four joints fit into 80 columns


def flown_errors(logs: Sequence[JointLog], robots: dict[str, RobotParameters]) -> Grid:
    """Errors of robots as the simulator flies them, behind its delays and with the logs' zeros."""
    rows = []
    for log in logs:
        for name, robot in robots.items():
            sets = file_sets(robot, flown=True)[np.array(log.joints) - 1]
            error = simulate(log, np.arange(len(sets)), sets) - log.measured
            rows.append([f'{log.name}, {name}', *(f'{MILLI * np.std(one[log.fresh]):.1f}'
                                                  for one in error)])
    return Grid('RMS error of the servos as simulated, without zeros [mrad]',
                ['', *(f'joint {number}' for number in logs[0].joints)], rows)


def joint_page(found: Found, validations: Sequence[JointLog], robot: RobotParameters,
               results: dict) -> str:
    """HTML page about an identification."""
    logs = found.servos.logs
    names = ', '.join(each.name for each in logs)
    return page('Tilt servos', f'identified from {names}', grids(results), results['text'],
                joint_sections(found, validations, robot))


def gap_log_page(apart: Found, result: dict, tables: Sequence[Grid], robot: RobotParameters
                 ) -> str:
    """HTML page about a log and a robot file; ``apart``: the identification of the log."""
    others = [read_joint_log(path) for path in [*result['meta']['runs'][1:],
                                                *result['meta']['holdout']]]
    return page('Tilt servos', f'{apart.servos.logs[0].name} against the robot file',
                [*tables, *grids(result | {'meta': {'validate': [o.name for o in others]}})],
                result['text'], joint_sections(apart, others, robot), head(result, ''))


def joint_sections(found: Found, others: Sequence[JointLog], robot: RobotParameters) -> list[str]:
    """A section with responses and errors of each log."""
    logs = found.servos.logs
    models = dict(zip(logs[0].joints, found.values(), strict=False))     # of the first log
    with matplotlib.rc_context(STYLE):
        return [section(
            other.name + (': fitted to the shaded part' if k < len(logs) else ': not fitted'),
            'Left: command (grey) and measured position. Right: simulations of the robot file and '
            'of the identified model minus measurement.',
            svg(_figure(other, models, robot, k < len(logs)), other.name))
            for k, other in enumerate([*logs, *others])]


def _figure(log, models, robot, fitted) -> Figure:
    pairs = [(k, number) for k, number in enumerate(log.joints) if number in models]
    file, is_held = file_sets(robot), held(robot)
    figure, axes = panels(len(pairs), 2, height=1.7, sharex=True)
    t, read = log.t - log.t[0], log.read_t[log.fresh] - log.t[0]
    for (left, right), (k, number) in zip(axes, pairs, strict=True):
        left.plot(t, log.command[k], color=FAINT, lw=1.0)
        left.plot(t, log.measured[k], color=INK, lw=1.4)
        left.set_ylabel(f'joint {number} [rad]')
        for values, hold, colour, name in ((file[number - 1], is_held, COLOURS[1], 'robot file'),
                                           (models[number], True, COLOURS[0], 'identified')):
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
