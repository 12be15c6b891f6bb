"""Results of a rotor identification: numbers, tables, figures and a robot file."""

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.robot_file import write_robot_file
from beetle_omni_ros.identify.rotor import crossings, inverse, MapRow, Ratio
from beetle_omni_ros.identify.rotor_log import RotorLog
from beetle_omni_ros.pages.figures import FAINT, INK, legend, panels, STYLE, svg
from beetle_omni_ros.pages.page import page, section
from beetle_omni_ros.pages.table import Grid
from beetle_omni_ros.robot.parameters import RobotParameters


def rotor_results(log: RotorLog, rows: list[MapRow], ratio: Ratio) -> dict:
    """Results as plain data."""
    warnings = [*log.warnings, *crossings(rows)]
    warnings += [f'at {row.voltage:.2f} V the slope is at its lower bound: the sweep does not '
                 'determine a cubic' for row in rows if row.held]
    if abs(ratio.tare) > 0.05 * ratio.value * max(row.thrust_max for row in rows):
        warnings.append(f'without thrust the stand reads {ratio.tare:.3f} N m: tare it')
    return {'meta': {'log': log.name, 'version': __version__},
            'plateaus': [{
                'voltage_V': row.voltage, 'rows': row.rows, 'thrust_max_N': row.thrust_max,
                'coefficients': {f'c{k}': {'value': float(value), 'unit': '%',
                                           'interval': [float(v) for v in row.intervals[k]]}
                                 for k, value in enumerate(row.coefficients)},
                'rms_N': row.rms, 'thrust_half_width_N': row.half_width,
                'round_trip_error': row.inverse_error, 'monotone': True}
                         for row in rows],
            'torque_to_thrust_ratio': {'value': ratio.value, 'unit': 'm',
                                       'interval': list(ratio.interval), 'rms_N_m': ratio.rms},
            'warnings': warnings}


def grids(results: dict) -> list[Grid]:
    """Tables of the map and the torque ratio."""
    header = ['V', 'max N', 'c3', 'c2', 'c1', 'c0', 'rows', 'RMS [N]', '95 % band [N]']
    rows = [[f'{p["voltage_V"]:.2f}', f'{p["thrust_max_N"]:.2f}',
             *(f'{p["coefficients"][f"c{k}"]["value"]:.4f}' for k in (3, 2, 1, 0)),
             str(p['rows']), f'{p["rms_N"]:.3f}', f'{p["thrust_half_width_N"]:.3f}']
            for p in results['plateaus']]
    ratio = results['torque_to_thrust_ratio']
    return [Grid('duty [% of 2000 us] = c0 + c1 g + c2 g^2 + c3 g^3, g = thrust / 10 N', header,
                 rows),
            Grid('', ['', 'value', '95 %'], [[
                'torque to thrust ratio [m]', f'{ratio["value"]:.5f}',
                f'{ratio["interval"][0]:.5f}..{ratio["interval"][1]:.5f}']])]


def rotor_page(log: RotorLog, rows: list[MapRow], ratio: Ratio, robot: RobotParameters,
               results: dict) -> str:
    """HTML page with the map, residuals and torque."""
    with matplotlib.rc_context(STYLE):
        sections = [
            section('Map', 'Dots: measured; lines: fitted; dashed: the robot file.',
                    svg(_maps(log, rows, robot), 'thrust over duty')),
            section('Residuals', 'Measured thrust minus the map at the commanded duty.',
                    svg(_residuals(log, rows), 'residual over thrust')),
            section('Torque', 'Reaction torque over thrust, and its residual.',
                    svg(_torque(log, ratio), 'torque over thrust'))]
    return page('Rotor', f'identified from {log.name}', grids(results), results['warnings'],
                sections)


def _colours(count):
    return [matplotlib.colormaps['viridis'](0.9 * k / max(count - 1, 1)) for k in range(count)]


def _maps(log, rows, robot) -> Figure:
    figure, axes = panels(1, height=4.0)
    axis = axes[0, 0]
    for row, plateau, colour in zip(rows, log.plateaus, _colours(len(rows)), strict=True):
        axis.plot(plateau.duty, plateau.force, '.', ms=2.5, color=colour, alpha=0.6)
        thrust = np.linspace(0, row.thrust_max, 200)
        axis.plot(row.duty(thrust), thrust, color=colour, label=f'{row.voltage:.2f} V')
    for known in robot.rotors.map:
        thrust = np.linspace(0, known.thrust_max, 200)
        axis.plot(np.polyval(known.coefficients[::-1], thrust / 10), thrust, color=FAINT, lw=0.8,
                  ls=(0, (4, 3)))
    axis.set_xlabel('duty [% of 2000 us]')
    axis.set_ylabel('thrust [N]')
    legend(figure, axis)
    return figure


def _residuals(log, rows) -> Figure:
    figure, axes = panels(len(rows), height=1.3, sharex=True)
    for axis, row, plateau, colour in zip(axes[:, 0], rows, log.plateaus, _colours(len(rows)),
                                          strict=True):
        fitted = inverse(row.coefficients, plateau.duty, 1.1 * row.thrust_max)
        axis.axhline(0, color=INK, lw=0.6)
        axis.plot(fitted, plateau.force - fitted, '.', ms=2.5, color=colour)
        axis.set_ylabel('[N]')
        axis.set_title(f'{row.voltage:.2f} V')
    axes[-1, 0].set_xlabel('thrust [N]')
    return figure


def _torque(log, ratio) -> Figure:
    figure, axes = panels(1, 2, height=2.8)
    for plateau, colour in zip(log.plateaus, _colours(len(log.plateaus)), strict=True):
        line = ratio.value * plateau.force + ratio.tare
        axes[0, 0].plot(plateau.force, plateau.torque, '.', ms=2.5, color=colour)
        axes[0, 1].plot(plateau.force, plateau.torque - line, '.', ms=2.5, color=colour)
    ends = np.array([0, max(row.force.max() for row in log.plateaus)])
    axes[0, 0].plot(ends, ratio.value * ends + ratio.tare, color=INK)
    axes[0, 0].set_ylabel('torque [N m]')
    axes[0, 1].set_ylabel('torque minus line [N m]')
    for axis in axes[0]:
        axis.set_xlabel('thrust [N]')
    return figure


def write_rotor_file(path: Path, results: dict, base: Path | None) -> None:
    """
    Write a robot file that extends ``base`` by the identified map.

    Raises:
        ParameterError: the file cannot be written.

    """
    rows = [{'voltage': round(p['voltage_V'], 3), 'thrust_max': round(p['thrust_max_N'], 4),
             'coefficients': [round(p['coefficients'][f'c{k}']['value'], 8) for k in range(4)]}
            for p in results['plateaus']]
    ratio = results['torque_to_thrust_ratio']
    content = {'rotors': {'torque_to_thrust_ratio': round(ratio['value'], 6), 'map': rows},
               'provenance': {'log': results['meta']['log'], 'version': __version__,
                              'torque_to_thrust_ratio_interval': [
                                  round(v, 6) for v in ratio['interval']],
                              'rms_N': [round(p['rms_N'], 4) for p in results['plateaus']]}}
    head = ('# Rotor map identified by `beetle_omni identify rotor`: duty [% of 2000 us] =\n'
            '# c0 + c1 g + c2 g^2 + c3 g^3, g = thrust / 10 N, coefficients c0 to c3;\n'
            '# voltage [V], thrust_max [N], torque_to_thrust_ratio [m].\n')
    write_robot_file(path, head, content, base)
