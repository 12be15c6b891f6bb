"""Results of a rotor identification: numbers, tables and figures."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.robot_file import Measured, rounded
from beetle_omni_ros.identify.rotor.fits import (
    estimate,
    fit_lag,
    fit_surface,
    map_rows,
    Rows,
    settled_rows,
    temperature_drift,
    torque_ratio,
)
from beetle_omni_ros.identify.rotor.log import RotorLog
from beetle_omni_ros.model.files import LogError
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show.figures import FAINT, INK, legend, panels, STYLE, svg
from beetle_omni_ros.show.page import Grid, section

LEVELS = (0.25, 0.5, 0.75, 1.0)     # of the largest duty, for which the ratio is listed
QUANTITIES = {'thrust': 'N', 'torque': 'N_m'}


@dataclass(frozen=True, eq=False)
class RotorModel:
    """All fits: settled rows and their surfaces, if any, and lags with their logs."""

    logs: Sequence[RotorLog]
    rows: Rows
    surfaces: dict
    lags: list[tuple[RotorLog, dict]]


def identify_rotor(logs: Sequence[RotorLog]) -> RotorModel:
    """
    Fit surfaces to the settled rows of all logs together, and a lag to each time series.

    Raises:
        LogError: the logs show neither.

    """
    fits = [(log, fit_lag(log)) for log in logs]
    lags = [(log, lag) for log, lag in fits if lag]
    rows = settled_rows([log for log, lag in fits if not (lag and lag['reason'])]) or {}
    if not rows and not lags:
        raise LogError(f'{logs[0].name}: expected settled rows of five duties or more, or a '
                       'time series in which thrust changes')
    return RotorModel(logs, rows, {name: fit_surface(rows, name)
                                   for name in QUANTITIES if rows}, lags)


def rotor_results(model: RotorModel) -> dict:
    """Results as plain data."""
    rows, bad = model.rows, [lag['reason'] for _, lag in model.lags if lag['reason']]
    notes = [f'{log.name}: {note}' for log in model.logs for note in log.notes]
    notes += [f'{log.name}: {lag["reason"]}' for log, lag in model.lags if lag['reason']]
    notes += [f'{log.name}: the dead time contains the start of the motor from rest'
              for log, lag in model.lags if lag['from_rest']]
    lags = [{key: one for key, one in lag.items() if key != 'fitted'} for _, lag in model.lags]
    best = min(lags, key=lambda one: (not (one['up'] and one['down']), bool(one['reason']),
                                      one['rms_N']), default=None)
    useless = bool(bad) and not rows
    results = {'meta': {'log': ', '.join(log.name for log in model.logs), 'version': __version__},
               'verdict': 'bad_data' if useless else 'identified',
               'reason': bad[0] if useless else None, 'warnings': notes,
               'plateaus': [], 'torque_to_thrust_ratio': None, 'surface': None, 'torque': None,
               'temperature': None, 'lag': best and {**best, 'logs': lags}}
    if not rows:
        return results
    surface, torque = (_surface(model, name) for name in QUANTITIES)
    thrust, duty = model.surfaces['thrust'], rows['duty'].max() * np.array(LEVELS)
    level = thrust.at(duty, np.median(rows['voltage']))
    ratios = model.surfaces['torque'].at(duty, np.median(rows['voltage'])) / level
    torque['ratio_at'] = [{'thrust_N': float(at[0]), **estimate(one, 'm')}
                          for at, one in zip(level, ratios, strict=True)]
    ratio = torque_ratio(rows)
    low, high = ratio['interval']
    if ratio['at_rest_N_m'] is None and not low < ratio['with_free_offset'] < high:
        notes.append('no row at rest: with a free offset of the torque, the ratio would be '
                     f'{ratio["with_free_offset"]:.4f} m')
    return results | {'surface': surface, 'plateaus': map_rows(rows, thrust), 'torque': torque,
                      'torque_to_thrust_ratio': ratio,
                      'temperature': temperature_drift(rows, thrust)}


def _surface(model, name):
    surface, unit = model.surfaces[name], QUANTITIES[name]
    names = ['u' + f'^{power}' * (power > 1) + ' duty' * more for power, more in surface.form]
    return {'terms': {term: estimate(surface.every[:, k]) for k, term in enumerate(names)},
            f'rms_{unit}': surface.rms, f'left_out_rms_{unit}': surface.left_out}


def measured(results: dict) -> list[Measured]:
    """Keys of ``rotors`` in a robot file."""
    found = []
    lag, ratio, logs = (
        results['lag'], results['torque_to_thrust_ratio'], results['meta']['log'].split(', '))
    if ratio:
        found.append(Measured(
            'rotors.torque_to_thrust_ratio', rounded(ratio['value']),
            rounded(ratio['interval'], 4), logs, 'slope of torque over thrust of settled steps'))
        rows = results['plateaus']
        found.append(Measured('rotors.map', [
            {'voltage': round(row['voltage_V'], 3), 'thrust_max': round(row['thrust_max_N'], 4),
             'coefficients': [round(row['coefficients'][f'c{k}']['value'], 8) for k in range(4)]}
            for row in rows], None, logs, (
            'cubics of the surface of settled steps, to the largest of their thrusts; 95 % band '
            f'{max(row["thrust_half_width_N"] for row in rows):.2f} N, at a voltage left out '
            f'{results["surface"]["left_out_rms_N"]:.2f} N RMS')))
    if lag and 'value' in lag and results['verdict'] != 'bad_data':
        shown = [one for one in lag['logs'] if 'value' in one]
        low, high = zip(*(one['interval'] for one in shown), strict=True)
        found.append(Measured(
            'rotors.time_constant', rounded(lag['value'], 4), rounded([min(low), max(high)], 4),
            [one['log'] for one in shown], f'both directions of {lag["log"]}' + (
                ' with a gain for each window, as thrust and command do not belong together'
                if lag['reason'] else '') + '; interval: of all these logs'))
    return found


def grids(results: dict) -> list[Grid]:
    """Tables of the results."""
    tables, rows = [], []
    if surface := results['surface']:
        torque = results['torque']
        tables = [Grid('surfaces over u = duty (0 to 1) x voltage [V]',
                       ['', 'terms', 'RMS', 'RMS of steps at a voltage left out'],
                       [[name, ' + '.join(f'{one["value"]:.4g} {term}'
                                          for term, one in part['terms'].items()),
                         f'{part["rms_" + unit]:.3f}', f'{part["left_out_rms_" + unit]:.3f}']
                        for name, part, unit in (('thrust [N]', surface, 'N'),
                                                 ('torque [N m]', torque, 'N_m'))]),
                  Grid('duty [% of 2000 us] = c0 + c1 g + c2 g^2 + c3 g^3, g = thrust / 10 N',
                       ['V', 'max N', 'c3', 'c2', 'c1', 'c0', 'RMS [N]', '95 % band [N]'],
                       [[f'{p["voltage_V"]:.2f}', f'{p["thrust_max_N"]:.2f}',
                         *(f'{p["coefficients"][f"c{k}"]["value"]:.4f}' for k in (3, 2, 1, 0)),
                         f'{p["rms_N"]:.3f}', f'{p["thrust_half_width_N"]:.3f}']
                        for p in results['plateaus']])]
        rows = [('torque to thrust ratio [m]', results['torque_to_thrust_ratio'], 1, 5),
                *((f'  at {one["thrust_N"]:.1f} N', one, 1, 5) for one in torque['ratio_at']),
                ('change of thrust [%/K]', results['temperature'], 100, 3)]
    for lag in results['lag']['logs'] if results['lag'] else ():
        rows += [(f'{name} [ms], {lag["log"]}', one, 1000, 0)
                 for name, one in (('lag', lag), ('lag up', lag['up']), ('lag down', lag['down']),
                                   ('dead time', lag['dead_time']))]
    return [*tables, Grid('', ['', 'value', '95 %'], [
        [name, f'{unit * one["value"]:.{digits}f}',
         '..'.join(f'{unit * end:.{digits}f}' for end in one['interval'])]
        for name, one, unit, digits in rows if one and 'value' in one])]


def sections(model: RotorModel, robot: RobotParameters) -> list[str]:
    """Sections with surfaces, residuals and lags."""
    with matplotlib.rc_context(STYLE):
        surfaces = [section(
            name.capitalize(), 'Dots: measured; line: surface at the mean voltage; dashed: the '
            'robot file. Below: measured minus surface.', svg(_over(model, name, robot), name))
            for name in model.surfaces]
        return surfaces + [section(f'Lag: {log.name}', 'Thrust over time.',
                                   svg(_lag(log, lag), 'lag')) for log, lag in model.lags]


def _over(model, name, robot):
    figure, axes = panels(2, height=2.6, sharex=True)
    rows, surface = model.rows, model.surfaces[name]
    u, fitted = rows['duty'] * rows['voltage'], surface.at(rows['duty'], rows['voltage'])[:, 0]
    line, voltage = np.linspace(0, u.max(), 200), rows['voltage'].mean()
    axes[0, 0].plot(line, surface.at(line / voltage, voltage)[:, 0], color=INK)
    for known in robot.rotors.map:
        thrust = np.linspace(0, known.thrust_max, 200)
        duty = np.polyval(known.coefficients[::-1], thrust / 10) / 50 - 1
        ratio = robot.rotors.torque_to_thrust_ratio if name == 'torque' else 1
        axes[0, 0].plot(duty * known.voltage, ratio * thrust, color=FAINT, lw=0.8, ls='--')
    for axis, values in zip(axes[:, 0], (rows[name], rows[name] - fitted), strict=True):
        axis.scatter(u, values, s=6, c=rows['voltage'], cmap='viridis')
        axis.set_ylabel(QUANTITIES[name].replace('_', ' '))
    axes[1, 0].set_xlabel('duty x voltage [V]')
    return figure


def _lag(log, lag):
    figure, axes = panels(1, height=2.8)
    time = log.columns['time']
    axes[0, 0].plot(time, log.columns['thrust'], color=FAINT, lw=0.8, label='measured')
    axes[0, 0].plot(time, lag['fitted'], color=INK, label='model')
    axes[0, 0].set(xlabel='time [s]', ylabel='thrust [N]')
    legend(figure, axes[0, 0])
    return figure
