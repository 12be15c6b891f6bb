"""Results of a rotor identification: numbers, tables, figures and a robot file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.inference.robust import interval
from beetle_omni_ros.identify.robot_file import rounded, write_robot_file
from beetle_omni_ros.identify.rotor.lag import fit_lag, Lag
from beetle_omni_ros.identify.rotor.log import RotorLog
from beetle_omni_ros.identify.rotor.surface import (
    fit_surface, map_rows, Rows, settled_rows, Surface, temperature_drift, torque_ratio)
from beetle_omni_ros.pages.figures import FAINT, INK, legend, panels, STYLE, svg
from beetle_omni_ros.pages.page import page, section
from beetle_omni_ros.pages.table import ABSENT, Grid
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs.csv_table import LogError

LEVELS = (0.25, 0.5, 0.75, 1.0)     # of the largest thrust, for which the ratio is listed


@dataclass(frozen=True, eq=False)
class RotorModel:
    """All fits; None: the logs do not contain it."""

    logs: Sequence[RotorLog]
    rows: Rows | None
    thrust: Surface | None
    torque: Surface | None
    lags: list[Lag]


def identify_rotor(logs: Sequence[RotorLog]) -> RotorModel:
    """
    Fit surfaces to the settled rows of all logs together, and a lag to each time series.

    Raises:
        LogError: the logs show neither.

    """
    fits = [None if log.time is None else fit_lag(log) for log in logs]
    lags = [lag for lag in fits if lag]
    rows = settled_rows([log for log, lag in zip(logs, fits, strict=True)
                         if not (lag and lag.reason)])
    if rows is None and not lags:
        raise LogError(f'{logs[0].name}: expected settled rows of five duties or more, or a '
                       'time series in which thrust changes')
    surfaces = (None, None) if rows is None else (
        fit_surface(rows, rows.thrust), fit_surface(rows, rows.torque))
    return RotorModel(logs, rows, *surfaces, lags)


def rotor_results(model: RotorModel) -> dict:
    """Results as plain data."""
    rows, thrust, torque = model.rows, model.thrust, model.torque
    bad = [lag for lag in model.lags if lag.reason]
    notes = [f'{log.name}: {note}' for log in model.logs for note in log.notes]
    notes += [f'{lag.log}: {lag.reason}' for lag in bad]
    notes += [f'{lag.log}: the rotor starts from rest; its dead time contains the start of the '
              'motor' for lag in model.lags if lag.from_rest]
    results: dict = {
        'meta': {'log': ', '.join(log.name for log in model.logs), 'version': __version__},
        'verdict': 'bad_data' if bad and rows is None else 'identified',
        'reason': bad[0].reason if bad and rows is None else None, 'plateaus': [],
        'torque_to_thrust_ratio': None, 'surface': None, 'torque': None, 'temperature': None,
        'lag': {**_best(model.lags).result(), 'logs': [lag.result() for lag in model.lags]}
        if model.lags else None}
    if rows is not None and thrust is not None and torque is not None:
        ratio = torque_ratio(rows, thrust)
        talk = ratio.pop('cross_talk')
        results |= {
            'surface': {**_surface(thrust, 'N'),
                        'duty': [float(rows.duty.min()), float(rows.duty.max())],
                        'voltage_V': [float(rows.voltage.min()), float(rows.voltage.max())]},
            'plateaus': map_rows(rows, thrust), 'torque_to_thrust_ratio': ratio,
            'torque': {**_surface(torque, 'N_m'), 'cross_talk': talk,
                       'ratio_at': _ratios(rows, thrust, torque)},
            'temperature': temperature_drift(rows, thrust)}
        rest = np.median(rows.thrust[rows.duty < 0.01]) if (rows.duty < 0.01).sum() > 2 else 0.0
        if abs(rest) > 0.2:
            notes.append(f'at rest the stand reads {rest:.2f} N: tare it')
        low, high = ratio['interval']
        if ratio['at_rest_N_m'] is None and not low < ratio['with_free_offset'] < high:
            notes.append('no row at rest: with a free offset of the torque, the ratio would be '
                         f'{ratio["with_free_offset"]:.4f} m')
    return {**results, 'warnings': notes}


def _best(lags):
    """Lag of the log that shows most."""
    return min(lags, key=lambda lag: (not (lag.up and lag.down), bool(lag.reason), lag.rms[1]))


def _surface(surface, unit):
    limits = interval(surface.value, surface.left_out)
    names = ['u' + f'^{power}' * (power > 1) + ' duty' * more for power, more in surface.form]
    return {'terms': {name: {'value': float(value), 'interval': limits[k].tolist()}
                      for k, (name, value) in enumerate(zip(names, surface.value, strict=True))},
            f'rms_{unit}': surface.rms, f'left_out_rms_{unit}': surface.held_out}


def _ratios(rows, thrust, torque):
    """Ratio of both surfaces at some thrusts, at the median voltage."""
    duty, voltage = np.linspace(0.05, rows.duty.max(), 200), float(np.median(rows.voltage))
    level = thrust.at(duty, voltage)
    found = []
    for share in LEVELS:
        at = duty[np.argmin(np.abs(level - share * level.max()))]
        ratios = [torque.at(at, voltage, q) / thrust.at(at, voltage, f) for q, f in
                  [(torque.value, thrust.value), *zip(torque.left_out, thrust.left_out)]]
        found.append({'thrust_N': float(thrust.at(at, voltage)), 'value': float(ratios[0]),
                      'interval': interval(ratios[0], np.array(ratios[1:])).tolist()})
    return found


def grids(results: dict) -> list[Grid]:
    """Tables of the results."""
    found = []
    if surface := results['surface']:
        torque = results['torque']
        found.append(Grid(
            'thrust and torque over u = duty (0 to 1) x voltage [V]',
            ['', *(f'term {k + 1}' for k in range(max(len(surface['terms']),
                                                      len(torque['terms'])))),
             'RMS of rows', 'of steps, voltage left out'],
            [[name, *(f'{one["value"]:.4g} {term}' for term, one in part['terms'].items()),
              *[ABSENT] * (max(len(surface['terms']), len(torque['terms']))
                           - len(part['terms'])),
              f'{part["rms_" + unit]:.3f}', f'{part["left_out_rms_" + unit]:.3f}']
             for name, part, unit in (('thrust [N]', surface, 'N'),
                                      ('torque [N m]', torque, 'N_m'))]))
        header = ['V', 'max N', 'c3', 'c2', 'c1', 'c0', 'RMS [N]', '95 % band [N]']
        found.append(Grid(
            'duty [% of 2000 us] = c0 + c1 g + c2 g^2 + c3 g^3, g = thrust / 10 N', header,
            [[f'{p["voltage_V"]:.2f}', f'{p["thrust_max_N"]:.2f}',
              *(f'{p["coefficients"][f"c{k}"]["value"]:.4f}' for k in (3, 2, 1, 0)),
              f'{p["rms_N"]:.3f}', f'{p["thrust_half_width_N"]:.3f}']
             for p in results['plateaus']]))
    rows = [] if not surface else [
        _row('torque to thrust ratio [m]', results['torque_to_thrust_ratio'], 1, 5),
        *(_row(f'  at {one["thrust_N"]:.1f} N', one, 1, 5) for one in torque['ratio_at'])]
    if results['temperature']:
        rows.append(_row('change of thrust [%/K]', results['temperature'], 100, 3))
    for lag in results['lag']['logs'] if results['lag'] else ():
        rows += [_row(f'{name} [ms], {lag["log"]}', one, 1000, 0)
                 for name, one in (('lag', lag), ('lag up', lag['up']), ('lag down', lag['down']),
                                   ('dead time', lag['dead_time'])) if one and 'value' in one]
    return [*found, Grid('', ['', 'value', '95 %'], rows)]


def _row(name, one, unit, digits):
    low, high = one['interval']
    return [name, f'{unit * one["value"]:.{digits}f}',
            f'{unit * low:.{digits}f}..{unit * high:.{digits}f}']


def rotor_page(model: RotorModel, robot: RobotParameters, results: dict) -> str:
    """HTML page with surfaces, residuals, torque and lags."""
    sections = []
    with matplotlib.rc_context(STYLE):
        if model.rows is not None:
            sections = [section('Thrust', 'Dots: measured; line: surface at the mean voltage; '
                                'dashed: the robot file. Below: measured minus surface.',
                                svg(_over(model.rows, model.thrust, model.rows.thrust, '[N]',
                                          robot), 'thrust over mean voltage')),
                        section('Torque', 'Likewise.',
                                svg(_over(model.rows, model.torque, model.rows.torque, '[N m]'),
                                    'torque over mean voltage'))]
        sections += [section(f'Lag: {lag.log}', 'Thrust measured (grey) and of the model.',
                             svg(_lag(log, lag), 'thrust over time'))
                     for lag in model.lags for log in model.logs if log.name == lag.log]
    notes = [f'verdict: {results["verdict"]}', *results['warnings']]
    return page('Rotor', f'identified from {results["meta"]["log"]}', grids(results), notes,
                sections)


def _over(rows, surface, values, unit, robot=None):
    figure, axes = panels(2, height=2.6, sharex=True)
    u = rows.duty * rows.voltage
    axes[0, 0].scatter(u, values, s=6, c=rows.voltage, cmap='viridis')
    line = np.linspace(0, u.max(), 200)
    voltage = rows.voltage.mean()
    axes[0, 0].plot(line, surface.at(line / voltage, voltage), color=INK, label='surface')
    for known in robot.rotors.map if robot else ():
        thrust = np.linspace(0, known.thrust_max, 200)
        duty = np.polyval(known.coefficients[::-1], thrust / 10) / 50 - 1
        axes[0, 0].plot(duty * known.voltage, thrust, color=FAINT, lw=0.8, ls=(0, (4, 3)))
    axes[1, 0].scatter(u, values - surface.at(rows.duty, rows.voltage), s=6, c=rows.voltage,
                       cmap='viridis')
    axes[1, 0].set_xlabel('duty x voltage [V]')
    for axis in axes[:, 0]:
        axis.set_ylabel(unit)
    legend(figure, axes[0, 0])
    return figure


def _lag(log, lag):
    figure, axes = panels(1, height=2.8)
    axes[0, 0].plot(log.time, log.thrust, color=FAINT, lw=0.8, label='measured')
    axes[0, 0].plot(log.time, lag.fitted, color=INK, label='model')
    axes[0, 0].set(xlabel='time [s]', ylabel='[N]')
    legend(figure, axes[0, 0])
    return figure


def write_rotor_file(path: Path, results: dict, base: Path | None) -> None:
    """
    Write a robot file that extends ``base`` by what was identified; comments have intervals.

    Raises:
        LogError: nothing was identified.
        ParameterError: the file cannot be written.

    """
    rotors: dict = {}
    lines = [f'identified by `beetle_omni identify rotor` {__version__} from '
             f'{results["meta"]["log"]}']
    if results['surface']:
        ratio, surface = results['torque_to_thrust_ratio'], results['surface']
        rotors['torque_to_thrust_ratio'] = rounded(ratio['value'])
        rotors['map'] = [
            {'voltage': round(p['voltage_V'], 3), 'thrust_max': round(p['thrust_max_N'], 4),
             'coefficients': [round(p['coefficients'][f'c{k}']['value'], 8) for k in range(4)]}
            for p in results['plateaus']]
        lines += [_line('torque_to_thrust_ratio', ratio, 'm'),
                  'map: duty [% of 2000 us] = c0 + c1 g + c2 g^2 + c3 g^3, g = thrust / 10 N, from '
                  'the surface', f"with {surface['left_out_rms_N']:.2f} N RMS at a voltage left "
                  f"out; 95 % band of thrust "
                  f"{max(p['thrust_half_width_N'] for p in results['plateaus']):.2f} N"]
    lag = results['lag']
    if lag and 'value' in lag and results['verdict'] != 'bad_data':
        rotors['time_constant'] = rounded(lag['value'], 4)
        lines += [_line(name, one, f's, from {lag["log"]}')
                  for name, one in (('time_constant', lag), ('  rising', lag['up']),
                                    ('  falling', lag['down'])) if one]
        lines += ['  with its own gain for each window, because thrust and command do not belong '
                  'together'] * bool(lag['reason'])
    if not rotors:
        raise LogError(f'{results["meta"]["log"]}: nothing for a robot file was identified; '
                       f'verdict {results["verdict"]}')
    write_robot_file(path, ''.join(f'# {line}\n' for line in lines), {'rotors': rotors}, base)


def _line(name, one, unit):
    low, high = (rounded(value, 4) for value in one['interval'])
    return f'{name}: {rounded(one["value"], 4)} (95 %: {low} to {high}) {unit}'
