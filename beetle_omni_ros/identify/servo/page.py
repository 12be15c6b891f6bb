"""Tables, figures and pages about identified servos."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
from matplotlib.figure import Figure

from beetle_omni_ros.identify.flights.page import head
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo.fit import Found
from beetle_omni_ros.identify.servo.log import JointLog, read_joint_log
from beetle_omni_ros.identify.servo.model import simulate
from beetle_omni_ros.identify.servo.robot import file_sets, held
from beetle_omni_ros.pages.figures import COLOURS, FAINT, INK, legend, panels, STYLE, svg
from beetle_omni_ros.pages.page import Grid, page, section
from beetle_omni_ros.robot.parameters import RobotParameters

MILLI = 1e3
UNITS = {'rad': ('mrad', MILLI), 's': ('ms', MILLI), 'N m': ('mN m', MILLI)}


def grids(results: dict, brief: bool = False) -> list[Grid]:
    """Errors and terms, a column for each joint; ``brief``: only terms of some joint's model."""
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
    names = [name for name in joints[0]['terms'] if not brief
             or any(joint['terms'][name]['kept'] for joint in joints)]
    rows = [[f'{name} [{_unit(joints[0]["terms"][name]["unit"])}]',
             *(_value(joint['terms'][name]) for joint in joints)] for name in names]
    unused = frozenset(k for k, name in enumerate(names)
                       if not any(joint['terms'][name]['kept'] for joint in joints))
    return [errors, motion, Grid(
        'Terms with 95 % interval; in brackets: not in the model, did not improve the prediction '
        'of other motion', header, rows, unused)]


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


def joint_page(found: Found, validations: Sequence[JointLog], robot: RobotParameters,
               results: dict) -> str:
    """HTML page about an identification."""
    log, logs = found.servos.logs[0], found.servos.logs
    models = dict(zip(log.joints, found.of_log(0), strict=True))
    with matplotlib.rc_context(STYLE):
        sections = []
        for k, other in enumerate([*logs, *validations]):
            end = shipped().servo.fitted if k < len(logs) else None
            title = other.name + (': fitted to the shaded part' if end else ': not fitted')
            sections.append(section(title, 'Command, measured position, and simulations of the '
                                    'robot file and of the identified model.',
                                    svg(_responses(other, models, robot, end), title)))
            sections.append(section(f'Errors, {other.name}', 'Model minus measurement.',
                                    svg(_errors(other, models, robot, end), 'errors')))
    names = ', '.join(each.name for each in logs)
    return page('Tilt servos', f'identified from {names}', grids(results), results['text'],
                sections)


def gap_log_page(apart: Found, result: dict, tables: Sequence[Grid], robot: RobotParameters
                 ) -> str:
    """HTML page about a log and a robot file; ``apart``: the identification of the log."""
    others = [read_joint_log(path) for path in [*result['meta']['runs'][1:],
                                                *result['meta']['holdout']]]
    with matplotlib.rc_context(STYLE):
        log = apart.servos.logs[0]
        models = dict(zip(log.joints, apart.of_log(0), strict=True))
        sections = [section(
            f'Errors, {other.name}', 'Simulated servos of the robot file, and identified ones, '
            'minus measurement.', svg(_errors(other, models, robot, shipped().servo.fitted
                                              if k == 0 else None), 'errors'))
            for k, other in enumerate([log, *others])]
    return page('Tilt servos', f'{log.name} against the robot file',
                [*tables, *grids(result | {'meta': {'validate': [o.name for o in others]}})],
                result['text'], sections, head(result, ''))


def _responses(log, models, robot, end) -> Figure:
    pairs = [(k, number) for k, number in enumerate(log.joints) if number in models]
    file, is_held = file_sets(robot), held(robot)
    figure, axes = panels(len(pairs), height=1.9, sharex=True)
    for axis, (k, number) in zip(axes[:, 0], pairs, strict=True):
        t = log.t - log.t[0]
        _shade(axis, t, end)
        axis.plot(t, log.command[k], color=FAINT, lw=1.0, label='command')
        axis.plot(t, log.measured[k], color=INK, lw=1.4, label='measured')
        axis.plot(t, simulate(log, k, file[number - 1][None], is_held)[0], color=COLOURS[1],
             lw=0.9, label='robot file')
        axis.plot(t, simulate(log, k, models[number][None])[0], color=COLOURS[0], lw=0.9,
             label='identified')
        axis.set_ylabel(f'joint {number} [rad]')
    axes[-1, 0].set_xlabel('time [s]')
    legend(figure, axes[0, 0])
    return figure


def _errors(log, models, robot, end) -> Figure:
    pairs = [(k, number) for k, number in enumerate(log.joints) if number in models]
    file, is_held = file_sets(robot), held(robot)
    figure, axes = panels(len(pairs), 2, height=1.5, sharex=True)
    t = log.read_t[log.fresh] - log.t[0]
    for row, (k, number) in zip(axes, pairs, strict=True):
        for axis, values, hold, colour, name in (
                (row[0], file[number - 1], is_held, COLOURS[1], 'robot file'),
                (row[1], models[number], True, COLOURS[0], 'identified')):
            _shade(axis, t, end)
            error = MILLI * (simulate(log, k, values[None], hold)[0] - log.measured[k])
            axis.plot(t, error[log.fresh], color=colour, lw=0.8)
            axis.set_title(f'joint {number}, {name}')
            axis.set_ylabel('error [mrad]')
    for axis in axes[-1]:
        axis.set_xlabel('time [s]')
    return figure


def _shade(axis, t, end):
    if end is not None:
        axis.axvspan(t[0], t[0] + end * (t[-1] - t[0]), color='#eef3f8', lw=0)


def change_grids(rows: Sequence[dict]) -> list[Grid]:
    """One table for each further log: before, after and difference."""
    result = []
    for log in dict.fromkeys(row['log'] for row in rows):
        cells = []
        for row in (r for r in rows if r['log'] == log):
            unit, factor = UNITS.get(row['unit'], (row['unit'], 1.0))
            old, new, difference, low, high = (factor * x for x in (
                row['before'], row['after'], row['difference'], *row['interval']))
            cells.append([str(row['joint']), f"{row['parameter']} [{unit}]", f'{old:.3g}',
                          f'{new:.3g}', f'{difference:+.3g}', f'{low:.3g}..{high:.3g}',
                          'yes' if row['significant'] else ''])
        result.append(Grid(f'Changes to {log}', ['joint', 'parameter', 'before', 'after',
                                                 'difference', '95 %', 'significant'], cells,
                           note='dead_band: friction over stiffness. ramp_lag: lag behind a ramp, '
                                'from delay and damping. significant: two logs without a change '
                                'have any such row in at most 5 of 100 cases.'))
    return result
