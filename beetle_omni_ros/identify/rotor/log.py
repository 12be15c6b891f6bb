"""Logs of one rotor on a force-torque stand: columns, signs, units, unusable telemetry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import re

import numpy as np

from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.csv_table import LogError, missing, read_table

P = shipped().rotor
PWM_PERCENT = 0.05      # [%/us] 2000 us are 100 % of duty, the unit of the map in robot.yaml
# Quantity -> columns with the factor to SI units (duty: %); 0: the sign is that of thrust.
COLUMNS: dict[str, dict[str, float]] = {
    'time': {'t_s': 1, 'timestep': 1},
    'duty': {'pwm_us': PWM_PERCENT, 'duty_percent': 1},
    'target': {'target_thrust': 1, 'target_thrust_N': 1},
    'thrust': {'force_N': 1, 'thrust_N': 1, 'fz': -1, 'force_z': -1},
    'torque': {'torque_N_m': 0, 'torque_Nm': 0, 'tz': 0, 'torque_z': 0},
    'voltage': {'voltage_V': 1, 'voltage': 1, 'esc_voltage': 1},
    'temperature': {'temperature': 1, 'temperature_C': 1},
    'speed': {'rpm': 1},
    'pack': {'file_voltage': 1, 'pack_V': 1},
    **{name: {name: 1, name.replace('f', 'force_').replace('t', 'torque_'): 1}
       for name in ('fx', 'fy', 'tx', 'ty')}}
SIDE = ('fx', 'fy', 'tx', 'ty')
EXPECTED = 'pwm_us (or duty_percent, target_thrust),force_N (or fz),torque_N_m (or tz),voltage_V'
UNITS = {'thrust': 'newtons, thrust positive (grams?); see --column',
         'torque': 'newton metres', 'duty': 'duty of 2000 us, stop at 1000 us or 50 percent'}


@dataclass(frozen=True, eq=False)
class RotorLog:
    """
    One log; rows (N,).

    Attributes:
        name: name of the file.
        time: [s]; None: settled rows.
        asked: commanded thrust [N], or None if the command is a duty.
        duty: duty from stop 0 to full 1; None if the command is a thrust.
        thrust: measured thrust [N].
        torque: reaction torque, with the sign of thrust [N m].
        voltage: pack voltage [V]; ones if the log has none.
        temperature: [deg C] or None.
        pack: label of the pack.
        side: (N, 0 to 4) forces and torques across the axis.
        settled: whether thrust has followed the command.
        fresh: whether the force sample is new.
        notes: remarks on masked or recognised data.

    """

    name: str
    time: np.ndarray | None
    asked: np.ndarray | None
    duty: np.ndarray | None
    thrust: np.ndarray
    torque: np.ndarray
    voltage: np.ndarray
    temperature: np.ndarray | None
    pack: np.ndarray
    side: np.ndarray
    settled: np.ndarray
    fresh: np.ndarray
    notes: list[str]

    @property
    def command(self) -> np.ndarray:
        """Commanded thrust, or duty times voltage, the mean voltage at the motor [V]."""
        return self.asked if self.duty is None else self.duty * self.voltage


def chosen(columns: Sequence[str]) -> dict[str, tuple[str, float]]:
    """
    Columns of the option --column: quantity -> column and factor.

    Raises:
        ParameterError: another form than QUANTITY=[-]COLUMN[*FACTOR].

    """
    found = {}
    for text in columns:
        match = re.fullmatch(r'(\w+)=(-?)([^*]+?)(?:\*([-+.\deE]+))?', text)
        try:
            quantity, sign, column, factor = match.groups() if match else ('', '', '', '')
            found[quantity] = column, (-1.0 if sign else 1.0) * float(factor or 1)
        except ValueError:
            quantity = ''
        if quantity not in COLUMNS:
            raise ParameterError(f"--column {text}: expected QUANTITY=[-]COLUMN[*FACTOR] with "
                                 f"a quantity of {', '.join(COLUMNS)}, e.g. thrust=-fz")
    return found


def read_rotor_log(path: str | Path, columns: Mapping[str, tuple[str, float]] | None = None,
                   rate: float | None = None) -> RotorLog:
    """
    Read a log.

    Args:
        path: CSV file.
        columns: columns of some quantities with factors, see :func:`chosen`.
        rate: rows a second of a time series without times.

    Raises:
        LogError: with file, row or column, and expectation.

    """
    source: dict[str, tuple[str, float]] = {}
    table = read_table(path, lambda header: _wanted(header, columns or {}, source), EXPECTED)
    if len(table) < P.least_rows:
        raise LogError(f'{path}: {len(table)} rows are too few; expected at least {P.least_rows}')
    data = {quantity: table.columns[name] * (factor or 1)
            for quantity, (name, factor) in source.items()}
    for quantity, low, high in (('thrust', -P.largest_force / 10, P.largest_force),
                                ('torque', -P.largest_torque, P.largest_torque),
                                ('duty', *P.duty)):
        bad = np.flatnonzero((data.get(quantity, low) < low) | (data.get(quantity, low) > high))
        if bad.size:
            name = source[quantity][0]
            raise LogError(f'{path}: row {table.rows[bad[0]]}, column {name}: found '
                           f'{table.columns[name][bad[0]]:g}; expected {UNITS[quantity]}')
    notes: list[str] = []
    _telemetry(path, data, notes)
    duty = None if 'duty' not in data else data['duty'] / 50 - 1
    voltage = data.get('voltage', np.ones(len(table)))
    side = np.array([data[name] for name in SIDE if name in data]).T.reshape(len(table), -1)
    log = RotorLog(
        table.path.name, _time(path, data, table, rate), data['target'] if duty is None else None,
        duty, data['thrust'], data['torque'], voltage, data.get('temperature'),
        data.get('pack', np.zeros(len(table))), side,
        np.ones(len(table), dtype=bool), np.ones(len(table), dtype=bool), notes)
    if log.time is not None:
        log = _series(log)
    return replace(log, torque=_signed(path, log, source['torque'][1]))


def _wanted(header, columns, source):
    for quantity, names in COLUMNS.items():
        found = [(cell, factor) for cell in header for name, factor in names.items()
                 if re.fullmatch(rf'(rotor\d+_)?{name}', cell)]
        if quantity in columns:
            found = [columns[quantity]]
            if found[0][0] not in header:
                raise LogError(f"column '{found[0][0]}' of --column is missing")
        if len(found) > 1:
            raise LogError(f"columns '{found[0][0]}' and '{found[1][0]}' mean the same; choose "
                           f'one by --column {quantity}=COLUMN')
        if found:
            source[quantity] = found[0]
    if 'duty' not in source and 'target' not in source:
        raise missing('pwm_us', header)
    for quantity in ('thrust', 'torque') + (('voltage',) if 'duty' in source else ()):
        if quantity not in source:
            raise missing(next(iter(COLUMNS[quantity])), header)
    return list(dict.fromkeys(name for name, _ in source.values()))


def _time(path, data, table, rate):
    """Times [s] of a time series, None for settled rows."""
    if 'time' in data:
        early = np.flatnonzero(np.diff(data['time']) <= 0)
        if early.size:
            raise LogError(f'{path}: row {table.rows[early[0] + 1]}: the time does not increase')
        return data['time'] - data['time'][0]
    command = data.get('duty', data.get('target'))
    edges = np.flatnonzero(np.diff(command, prepend=np.nan, append=np.nan) != 0)
    start, count = max(zip(edges[:-1], np.diff(edges), strict=True), key=lambda one: one[1])
    first, last = (np.median(data['thrust'][k:k + max(count // 3, 1)])
                   for k in (start, start + count - count // 3))
    if count < P.least_rows or abs(last - first) < 0.3 * np.ptp(data['thrust']):
        return None
    if not rate:
        raise LogError(f'{path}: thrust goes from {first:.1f} to {last:.1f} N at one command, so '
                       'this is a time series; expected a column t_s, or --rate ROWS_A_SECOND')
    return np.arange(len(command)) / rate


def _telemetry(path, data, notes):
    """Replace impossible readings by interpolation, and count those and held ones."""
    bounds = {'voltage': P.voltage, 'speed': (0, P.largest_speed), 'temperature': P.temperature}
    there = [name for name in bounds if name in data]
    if not there:
        return
    bad = np.any([(data[name] < bounds[name][0]) | (data[name] > bounds[name][1])
                  for name in there], axis=0)
    if bad.mean() > 0.5:
        worst = max(there, key=lambda name: np.abs(data[name]).max())
        raise LogError(f'{path}: {bad.mean():.0%} of the telemetry is impossible ({worst} '
                       f'{np.median(data[worst]):g}); expected volts, rpm, deg C (millivolts?)')
    # A held reading is no new reading: values between two new ones are interpolated.
    held = np.all([np.diff(data[name], prepend=np.nan) == 0 for name in there], axis=0)
    if bad.any():
        extremes = ', '.join(f'{name} {data[name].min():g} to {data[name].max():g}'
                             for name in there)
        notes.append(f'{bad.sum()} of {len(bad)} rows ({bad.mean():.0%}) have impossible '
                     f'telemetry ({extremes}): masked, bridged by the neighbours')
    if 'time' in data and held.any():
        longest = np.diff(data['time'][np.append(np.flatnonzero(~held), -1)]).max()
        notes.append(f'{held.sum()} of {len(held)} rows ({held.mean():.0%}) repeat the telemetry '
                     f'of the row before, for up to {longest:.2f} s: masked')
    keep = np.flatnonzero(~bad & ~(held & ('time' in data)))
    for name in there:
        data[name] = np.interp(np.arange(len(bad)), keep, data[name][keep])


def _series(log):
    """Mark repeated samples of force, and rows at which thrust has followed the command."""
    channels = np.column_stack([log.thrust, log.torque, log.side])
    fresh = np.append(True, (np.diff(channels, axis=0) != 0).any(axis=1))
    if not fresh.all():
        log.notes.append(f'{(~fresh).sum()} of {len(fresh)} rows ({(~fresh).mean():.0%}) repeat '
                         'the force of the row before: masked')
    command = log.asked if log.duty is None else log.duty
    lagged, level = np.empty(len(command)), 0.0     # the command before the log is unknown
    for k, step in enumerate(np.diff(log.time, prepend=log.time[0])):
        level += (command[k] - level) * -np.expm1(-4 * step / P.settling)
        lagged[k] = level
    settled = np.abs(command - lagged) < P.still * np.abs(command).max()
    return replace(log, fresh=fresh, settled=settled & fresh)


def _signed(path, log, factor):
    """Torque with the sign of thrust, unless --column gives the sign."""
    if np.std(log.torque) == 0 or np.std(log.thrust) == 0:
        raise LogError(f'{path}: force or torque never changes; is the stand connected?')
    command = log.asked if log.duty is None else log.duty
    if np.ptp(command) == 0:
        raise LogError(f'{path}: the command never changes; expected a sweep')
    rise, likeness = (np.corrcoef(pair)[0, 1] for pair in ((command, log.thrust),
                                                           (log.thrust, log.torque)))
    least = 0.5 if log.time is None else 0.0    # of a series, whose lag lowers it
    if rise < least:
        raise LogError(f'{path}: thrust does not rise with the command (correlation {rise:.2f}); '
                       'are sign and unit right? See --column')
    if abs(likeness) < least:
        raise LogError(f'{path}: torque does not follow thrust (correlation {likeness:.2f}); '
                       'expected nearly proportional columns')
    if factor and likeness < -least:
        raise LogError(f'{path}: torque falls with thrust; expected the other sign in --column')
    return log.torque * np.sign(likeness)
