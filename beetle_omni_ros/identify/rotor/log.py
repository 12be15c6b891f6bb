"""Logs of one rotor on a force-torque stand: columns, signs, units, unusable telemetry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import re

import numpy as np

from beetle_omni_ros.model.files import LogError, missing, read_table
from beetle_omni_ros.model.schema import ParameterError

# Quantity -> columns with the factor to SI units. 2000 us are 100 % of duty. The sign of a torque
# with the factor 0 becomes that of thrust.
COLUMNS: dict[str, dict[str, float]] = {
    'time': {'t_s': 1, 'timestep': 1}, 'duty': {'pwm_us': 0.05, 'duty_percent': 1},
    'target': {'target_thrust': 1, 'target_thrust_N': 1},
    'thrust': {'force_N': 1, 'thrust_N': 1, 'fz': -1, 'force_z': -1},
    'torque': {'torque_N_m': 0, 'torque_Nm': 0, 'tz': 0, 'torque_z': 0},
    'voltage': {'voltage_V': 1, 'voltage': 1, 'esc_voltage': 1}, 'rpm': {'rpm': 1},
    'temperature': {'temperature': 1}, 'pack': {'file_voltage': 1}}
EXPECTED = 'pwm_us (or duty_percent, target_thrust),force_N (or fz),torque_N_m (or tz),voltage_V'
LARGEST_FORCE = 200.0       # [N]
LARGEST_TORQUE = 20.0       # [N m]
DUTY = 40.0, 101.0          # [%] of 2000 us
# Telemetry outside these ranges is masked [V, rpm, deg C].
POSSIBLE = {'voltage': (5.0, 60.0), 'temperature': (-40.0, 200.0), 'rpm': (0.0, 60000.0)}
LEAST_ROWS = 20
SETTLING = 0.5      # [s] after a change of command, until thrust has settled
STILL = 0.02        # share of the largest command by which its lagged value may differ then
UNITS = {'thrust': 'newtons, thrust positive (grams?); see --column', 'torque': 'newton metres',
         'duty': 'duty of 2000 us, stop at 1000 us or 50 percent'}


class UntimedError(LogError):
    """A time series without times, whose rows a second are not given."""


@dataclass(frozen=True, eq=False)
class RotorLog:
    """
    One log.

    Attributes:
        name: name of the file.
        command: quantity that was commanded, duty or target.
        columns: quantity -> (N,) values; the duty is 0 at stop and 1 at full.
        series: whether the rows are a time series, not settled rows.
        fresh: (N,) whether the sample of thrust is new.
        settled: (N,) whether thrust has followed the command.
        notes: remarks on masked data.

    """

    name: str
    command: str
    columns: dict[str, np.ndarray]
    series: bool
    fresh: np.ndarray
    settled: np.ndarray
    notes: list[str]


def chosen(columns: Sequence[str]) -> dict[str, tuple[str, float]]:
    """
    Columns of the option --column: quantity -> column and factor.

    Raises:
        ParameterError: another form than QUANTITY=[-]COLUMN[*FACTOR].

    """
    chosen_columns = {}
    for text in columns:
        match = re.fullmatch(r'(\w+)=(-?)([^*]+?)(?:\*(\d+\.?\d*|\.\d+))?', text)
        if not match or match[1] not in COLUMNS:
            raise ParameterError(f"--column {text}: expected QUANTITY=[-]COLUMN[*FACTOR] with "
                                 f"a quantity of {', '.join(COLUMNS)}, e.g. thrust=-fz")
        chosen_columns[match[1]] = match[3], float(match[2] + (match[4] or '1'))
    return chosen_columns


def read_rotor_log(path: str | Path, columns: Mapping[str, tuple[str, float]] | None = None,
                   rate: float | None = None) -> RotorLog:
    """
    Read a log; ``columns`` as of :func:`chosen`, ``rate`` [Hz] of a time series without times.

    Raises:
        LogError: with file, row or column, and expectation.

    """
    source: dict[str, tuple[str, float]] = {}
    table, rows = read_table(path, lambda header: _wanted(header, columns or {}, source), EXPECTED)
    if len(rows) < LEAST_ROWS:
        raise LogError(f'{path}: {len(rows)} rows are too few; expected at least {LEAST_ROWS}')
    data = {name: table[column] * (factor or 1) for name, (column, factor) in source.items()}
    for name, low, high in (('thrust', -LARGEST_FORCE / 10, LARGEST_FORCE),
                            ('torque', -LARGEST_TORQUE, LARGEST_TORQUE), ('duty', *DUTY)):
        bad = np.flatnonzero((data.get(name, low) < low) | (data.get(name, low) > high))
        if bad.size:
            raise LogError(f'{path}: row {rows[bad[0]]}, column {source[name][0]}: found '
                           f'{table[source[name][0]][bad[0]]:g}; expected {UNITS[name]}')
    command = 'duty' if 'duty' in data else 'target'
    if command == 'duty':
        data['duty'] = data['duty'] / 50 - 1
    if min(np.ptp(data[name]) for name in (command, 'thrust', 'torque')) == 0:
        raise LogError(f'{path}: command, force or torque never changes; expected a sweep')
    if 'time' in data and np.diff(data['time']).min() <= 0:
        row = rows[np.argmax(np.diff(data['time']) <= 0) + 1]
        raise LogError(f'{path}: row {row}: the time does not increase')
    notes: list[str] = []
    _telemetry(path, data, notes)
    if 'time' not in data and _transient(path, data[command], data['thrust'], rate):
        data['time'] = np.arange(len(rows)) / (rate or 1)
    series = 'time' in data
    fresh = settled = np.ones(len(rows), dtype=bool)
    if series:
        force = np.column_stack([data['thrust'], data['torque']])
        fresh = np.append(True, (np.diff(force, axis=0) != 0).any(axis=1))
        if not fresh.all():
            notes.append(f'{(~fresh).sum()} of {len(fresh)} rows ({(~fresh).mean():.0%}) repeat '
                         'the force of the row before: masked')
        settled = fresh & _settled(data['time'], data[command])
    data['torque'] = _checked(path, data, command, source['torque'][1], series)
    return RotorLog(Path(path).name, command, data, series, fresh, settled, notes)


def _wanted(header, columns, source):
    for quantity, names in COLUMNS.items():
        named = [(cell, factor) for cell in header for name, factor in names.items()
                 if re.fullmatch(rf'(rotor\d+_)?{name}', cell)]
        if quantity in columns:
            named = [columns[quantity]]
            if named[0][0] not in header:
                raise LogError(f"column '{named[0][0]}' of --column is missing")
        if len(named) > 1:
            raise LogError(f"columns '{named[0][0]}' and '{named[1][0]}' mean the same; choose "
                           f'one by --column {quantity}=COLUMN')
        source.update({quantity: one for one in named})
    if 'duty' not in source and 'target' not in source:
        raise missing('pwm_us', header)
    for quantity in ('thrust', 'torque') + ('voltage',) * ('duty' in source):
        if quantity not in source:
            raise missing(next(iter(COLUMNS[quantity])), header)
    return list(dict.fromkeys(name for name, _ in source.values()))


def _telemetry(path, data, notes):
    """Replace impossible and held readings by interpolation between new ones."""
    there = [name for name in POSSIBLE if name in data]
    if not there:
        return
    bad = np.any([(data[name] < POSSIBLE[name][0]) | (data[name] > POSSIBLE[name][1])
                  for name in there], axis=0)
    ranges = ', '.join(f'{name} {data[name].min():g} to {data[name].max():g}' for name in there)
    if bad.mean() > 0.5:
        raise LogError(f'{path}: {bad.mean():.0%} of the rows have impossible telemetry '
                       f'({ranges}); expected volts, rpm, deg C (millivolts?)')
    if bad.any():
        notes.append(f'{bad.sum()} of {len(bad)} rows ({bad.mean():.0%}) have impossible '
                     f'telemetry ({ranges}): masked')
    held = np.zeros(len(bad), dtype=bool)
    if 'time' in data:
        held = np.all([np.diff(data[name], prepend=np.nan) == 0 for name in there], axis=0)
        longest = np.diff(data['time'][np.append(np.flatnonzero(~held), -1)]).max()
        if held.any():
            notes.append(f'{held.sum()} of {len(held)} rows ({held.mean():.0%}) hold the '
                         f'telemetry of the row before, for up to {longest:.2f} s: masked')
    new = np.flatnonzero(~bad & ~held)
    for name in there:
        data[name] = np.interp(np.arange(len(bad)), new, data[name][new])


def _transient(path, command, thrust, rate):
    """Whether rows without times are a time series: thrust moves while a command is held."""
    edges = np.flatnonzero(np.diff(command, prepend=np.nan, append=np.nan) != 0)
    longest = np.argmax(np.diff(edges))
    count, held = np.diff(edges)[longest], thrust[edges[longest]:edges[longest + 1]]
    first, last = np.median(held[:count // 3 + 1]), np.median(held[-(count // 3) - 1:])
    if count < LEAST_ROWS or abs(last - first) < 0.3 * np.ptp(thrust):
        return False
    if not rate:
        raise UntimedError(f'{path}: thrust goes from {first:.1f} to {last:.1f} N at one command, '
                           'so this is a time series; expected a column t_s, or --rate '
                           'ROWS_A_SECOND')
    return True


def _settled(time, command):
    lagged, level = np.empty(len(command)), 0.0     # the command before the log is unknown
    for k, step in enumerate(np.diff(time, prepend=time[0])):
        level += (command[k] - level) * -np.expm1(-4 * step / SETTLING)
        lagged[k] = level
    return np.abs(command - lagged) < STILL * np.abs(command).max()


def _checked(path, data, command, factor, series):
    """Torque with the sign of thrust, unless --column gives the sign."""
    rise, likeness = (np.corrcoef(data[one], data['thrust'])[0, 1] for one in (command, 'torque'))
    least = 0.0 if series else 0.5      # the lag of a series lowers it
    if rise < least:
        raise LogError(f'{path}: thrust does not rise with the command (correlation {rise:.2f}); '
                       'are sign and unit right? See --column')
    if abs(likeness) < least or factor and likeness < -least:
        raise LogError(f'{path}: torque does not follow thrust (correlation {likeness:.2f}); '
                       'expected nearly proportional columns')
    return data['torque'] * (1 if factor else np.sign(likeness))
