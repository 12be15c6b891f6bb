"""Bench logs of one rotor on a force-torque stand, and their voltage plateaus."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.runs.csv_table import LogError, missing, read_table

HEADER = 'pwm_us (or duty_percent),force_N,torque_N_m,voltage_V'
ALTERNATIVES = {'force_N': ('force_N', 'thrust_N'), 'torque_N_m': ('torque_N_m', 'torque_Nm'),
                'voltage_V': ('voltage_V',), 'pwm': ('duty_percent', 'pwm_us')}
FULL_PULSE = 2000.0     # [us] of 100 % duty, the unit of the map in params/robot.yaml


@dataclass(frozen=True)
class Plateau:
    """
    Rows at one voltage.

    Attributes:
        voltage: median voltage [V].
        duty: (N,) duty [% of 2000 us].
        force: (N,) thrust [N].
        torque: (N,) reaction torque, positive [N m].

    """

    voltage: float
    duty: np.ndarray
    force: np.ndarray
    torque: np.ndarray


@dataclass(frozen=True)
class RotorLog:
    """
    One bench log.

    Attributes:
        name: name of the file.
        plateaus: plateaus with decreasing voltage.
        warnings: remarks about usable data.

    """

    name: str
    plateaus: list[Plateau]
    warnings: list[str]


def read_rotor_log(path: str | Path) -> RotorLog:
    """
    Read a bench log and divide it into voltage plateaus.

    Raises:
        LogError: with file, row or column, and expectation.

    """
    p = shipped().rotor
    table = read_table(path, _wanted, HEADER)
    # read_table has checked that each column exists.
    column = {wanted: next(table.columns[name] for name in names if name in table.columns)
              for wanted, names in ALTERNATIVES.items()}
    duty = column['pwm'] if 'duty_percent' in table.columns else 100 * column['pwm'] / FULL_PULSE
    if len(table) < p.least_rows:
        raise LogError(f'{path}: {len(table)} rows are too few; expected at least {p.least_rows}')
    pwm_name = 'duty_percent' if 'duty_percent' in table.columns else 'pwm_us'
    unit = ('percent of 2000 us, 50 at stop' if pwm_name == 'duty_percent'
            else 'microseconds, 1000 at stop')
    _check(table, pwm_name, duty, p.duty, unit)
    _check(table, 'force_N', column['force_N'], (-5.0, p.largest_force),
           'newtons, thrust positive (grams?)')
    _check(table, 'torque_N_m', np.abs(column['torque_N_m']), (0.0, p.largest_torque),
           'newton metres')
    _check(table, 'voltage_V', column['voltage_V'], p.voltage, 'volts (millivolts?)')
    if np.ptp(duty) < 5:
        raise LogError(f'{path}: {pwm_name} spans {np.ptp(duty):.2g} % of duty only; expected a '
                       'sweep from stop to full')
    warnings: list[str] = []
    torque = _positive(path, column['torque_N_m'], column['force_N'])
    settled = _settled(table, duty, warnings)
    stopped = duty < 50.5
    if stopped.sum() >= 5 and abs(np.median(column['force_N'][stopped])) > 0.2:
        warnings.append(f'at stop the stand reads {np.median(column["force_N"][stopped]):.2f} N: '
                        'tare it')
    plateaus = _plateaus(path, column['voltage_V'][settled], duty[settled],
                         column['force_N'][settled], torque[settled], warnings)
    return RotorLog(table.path.name, plateaus, warnings)


def _wanted(header):
    names = []
    for wanted, choices in ALTERNATIVES.items():
        found = [name for name in choices if name in header]
        if not found:
            raise missing(choices[-1] if wanted == 'pwm' else choices[0], header)
        if len(found) > 1:
            raise LogError(f"columns '{found[0]}' and '{found[1]}' mean the same")
        names += found
    return names + (['t_s'] if 't_s' in header else [])


def _check(table, name, values, bounds, expected):
    low, high = bounds
    bad = np.flatnonzero((values < low) | (values > high))
    if bad.size:
        header = next((n for n in ALTERNATIVES.get(name, (name,)) if n in table.columns), name)
        raw = table.columns[header][bad[0]]
        raise LogError(f'{table.path}: row {table.rows[bad[0]]}, column {header}: found {raw:g}; '
                       f'expected {expected}')


def _positive(path, torque, force):
    """Torque with the sign that increases with thrust; conventions of stands differ."""
    if np.std(torque) == 0 or np.std(force) == 0:
        raise LogError(f'{path}: force or torque never changes; is the stand connected?')
    correlation = np.corrcoef(torque, force)[0, 1]
    if abs(correlation) < 0.5:
        raise LogError(f'{path}: torque does not follow thrust (correlation {correlation:.2f}); '
                       'expected nearly proportional columns')
    return torque * np.sign(correlation)


def _settled(table, duty, warnings):
    if 't_s' not in table.columns:
        return np.ones(len(duty), dtype=bool)
    t = table.columns['t_s']
    if (np.diff(t) < 0).any():
        k = int(np.argmax(np.diff(t) < 0)) + 1
        raise LogError(f'{table.path}: row {table.rows[k]}, column t_s: {t[k]:g} s comes before '
                       f'{t[k - 1]:g} s; expected increasing times')
    changes = t[1:][np.abs(np.diff(duty)) > 0.2]
    last = np.searchsorted(changes, t, side='right') - 1
    since = np.where(last >= 0, t - changes[np.maximum(last, 0)] if changes.size else np.inf,
                     np.inf)
    settled = since >= shipped().rotor.settling
    if settled.mean() < 0.2:
        warnings.append('PWM changes all the time: all rows are used in spite of the rotor lag')
        return np.ones(len(duty), dtype=bool)
    return settled


def _plateaus(path, voltage, duty, force, torque, warnings):
    """Divide the rows at minima of the voltage density."""
    p = shipped().rotor
    grid = np.arange(voltage.min() - 0.5, voltage.max() + 0.5, p.plateau_width / 4)
    counts, _ = np.histogram(voltage, np.append(grid, grid[-1] + p.plateau_width / 4))
    kernel = np.exp(-0.5 * (np.arange(-16, 17) / 4.0)**2)
    density = np.convolve(counts, kernel, mode='same')
    peaks = [k for k in range(1, len(grid) - 1) if density[k - 1] < density[k] >= density[k + 1]]
    edges: list[float] = []
    last = None
    for peak in sorted(peaks):
        if last is not None:
            valley = last + int(np.argmin(density[last:peak + 1]))
            if density[valley] > p.valley * min(density[last], density[peak]):
                last = max(last, peak, key=lambda k: density[k])
                continue
            edges.append(grid[valley])
        last = peak
    group = np.searchsorted(edges, voltage)
    found = []
    for k in np.unique(group):
        rows = group == k
        middle = float(np.median(voltage[rows]))
        if rows.sum() < p.least_rows or np.ptp(force[rows]) < 0.3 * np.ptp(force):
            warnings.append(f'{rows.sum()} rows at {middle:.2f} V are too few, or too short a '
                            'sweep, for a row of the map: not used')
            continue
        found.append(Plateau(middle, duty[rows], force[rows], torque[rows]))
    if not found:
        raise LogError(f'{path}: no voltage plateau with {p.least_rows} rows and a sweep of '
                       f'thrust; voltages span {voltage.min():.2f} to {voltage.max():.2f} V')
    return sorted(found, key=lambda plateau: -plateau.voltage)
