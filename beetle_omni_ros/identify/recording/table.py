"""Flights as tables: CSV files whose columns a format declares."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
import math
from pathlib import Path

import numpy as np

from beetle_omni_ros.model.files import LogError, read_table
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import load_yaml, ParameterError, quoted

G = 9.80665     # [m/s^2] of a unit 'g', standard gravity
# Signal -> width, and unit -> factor to SI.
SIGNALS: dict[str, tuple[int, dict[str, float]]] = {
    'time': (1, {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}),
    'position': (3, {'m': 1.0, 'mm': 1e-3}),
    'velocity': (3, {'m/s': 1.0, 'mm/s': 1e-3}),
    'acceleration': (3, {'m/s^2': 1.0, 'g': G}),
    'quaternion': (4, {'1': 1.0}),
    'attitude': (3, {'rad': 1.0, 'deg': math.pi / 180}),
    'specific_force': (3, {'m/s^2': 1.0, 'g': G}),
    'angular_velocity': (3, {'rad/s': 1.0, 'deg/s': math.pi / 180}),
    'thrust': (4, {'N': 1.0, 'g': G / 1e3}),
    'duty': (4, {'1': 1.0}),
    'tilt': (4, {'rad': 1.0, 'deg': math.pi / 180}),
    'voltage': (1, {'V': 1.0, 'mV': 1e-3}),
    'target_position': (3, {'m': 1.0, 'mm': 1e-3}),
    'attitude_target': (3, {'rad': 1.0, 'deg': math.pi / 180})}
# Signal -> frames that it may have, the first one by default.
FRAMES = {'position': ('world',), 'velocity': ('world', 'body'), 'acceleration': ('world',),
          'quaternion': ('body_to_world', 'world_to_body'), 'specific_force': ('body',),
          'angular_velocity': ('body',), 'target_position': ('world',)}
ORDERS = {'xyzw': (0, 1, 2, 3), 'wxyz': (1, 2, 3, 0)}
KEYS = ('columns', 'unit', 'frame', 'sign', 'order', 'full', 'clock')


@dataclass(frozen=True)
class Signal:
    """
    One signal of a format.

    Attributes:
        columns: names of its columns; None: this component is not recorded.
        factor: (n,) factors from the column's unit to SI, with the declared sign.
        frame: frame of a vector, or the direction of a quaternion.
        order: index of x, y, z, w among the columns of a quaternion.
        clock: name of the clock that stamps it; signals of one clock are synchronous.

    """

    columns: tuple[str | None, ...]
    factor: np.ndarray
    frame: str = ''
    order: tuple[int, ...] = ()
    clock: str = 'log'


@dataclass(frozen=True)
class Format:
    """
    Columns of a table of a flight.

    Attributes:
        name: name of the format.
        signals: signal -> its columns.
        clock_deviation: standard deviation of the stamps within one clock, over a flight [s].

    """

    name: str
    signals: dict[str, Signal]
    clock_deviation: float = 0.0

    @classmethod
    def load(cls, name: str) -> Format:
        """
        Read a shipped format by name, or a file.

        Raises:
            ParameterError: with file, key and expected value.

        """
        path = Path(name)
        if path.suffix not in ('.yaml', '.yml'):
            path = share_path('params/formats') / f'{name}.yaml'
        if not path.is_file():
            shipped = sorted(f.stem for f in share_path('params/formats').glob('*.yaml'))
            raise ParameterError(f'--format {name}: no such file; expected a YAML file or one of '
                                 f"the shipped formats {', '.join(shipped)}")
        content = load_yaml(path)
        deviation = _number(content.pop('clock_deviation', 0.0), f"{path}: key 'clock_deviation'")
        name = str(content.pop('name', path.stem))
        signals = {key: _signal(key, value, str(path)) for key, value in content.items()}
        if 'time' not in signals:
            raise ParameterError(f"{path}: key 'time' is missing: expected the column of the time")
        if 'thrust' in signals and 'duty' in signals:
            raise ParameterError(f"{path}: expected 'thrust' or 'duty', found both")
        return cls(name, signals, deviation)


def _number(value, where):
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ParameterError(f'{where}: expected a number, found {quoted(value)}')
    return float(value)


def _signal(name, content, path):
    where = f'{path}: key {name!r}'
    if name not in SIGNALS:
        raise ParameterError(f"{where}: unknown signal; expected one of {', '.join(SIGNALS)}")
    width, units = SIGNALS[name]
    if not isinstance(content, dict) or not set(content) <= set(KEYS):
        raise ParameterError(f"{where}: expected a mapping with keys of {', '.join(KEYS)}, found "
                             f'{quoted(content)}')
    columns = content.get('columns')
    columns = [columns] if isinstance(columns, str) else columns
    if not isinstance(columns, list) or len(columns) != width or not all(
            column is None or isinstance(column, str) for column in columns):
        raise ParameterError(f"{where}: 'columns': expected {width} names (null: not recorded), "
                             f'found {quoted(columns)}')
    sign = content.get('sign', [1] * width)
    if not isinstance(sign, list) or len(sign) != width or not all(s in (1, -1) for s in sign):
        raise ParameterError(f"{where}: 'sign': expected {width} of 1 or -1, found "
                             f'{quoted(sign)}')
    frames = FRAMES.get(name, ('',))
    unit = _one_of(units, content, 'unit', '1', where)
    frame = _one_of(frames, content, 'frame', frames[0], where)
    order = _one_of(ORDERS, content, 'order', 'xyzw', where)
    full = _number(content.get('full', 1.0), f"{where}: 'full'")
    return Signal(tuple(columns), np.array(sign) * units[unit] / full, frame,
                  ORDERS[order] if name == 'quaternion' else (), str(content.get('clock', 'log')))


def _one_of(allowed, content, key, default, where):
    value = str(content.get(key, default))
    if value not in allowed:
        raise ParameterError(f"{where}: {key!r}: expected one of {', '.join(allowed)}, found "
                             f'{quoted(value)}')
    return value


@dataclass(frozen=True, eq=False)
class Table:
    """
    One flight on a regular grid of time.

    Attributes:
        name: name of the file.
        period: of the grid [s].
        values: signal -> (N, width) in SI; NaN: there is no sample.
        format: format of the file.

    """

    name: str
    period: float
    values: dict[str, np.ndarray]
    format: Format = field(repr=False)

    def __len__(self) -> int:
        """Count of the grid's points."""
        return len(next(iter(self.values.values())))


def read_flight(path: Path, form: Format) -> Table:
    """
    Read a CSV file, plain or compressed by gzip.

    Each row goes to the nearest point of a regular grid with the median period. An empty cell and
    a point without row are samples that do not exist.

    Raises:
        LogError: with file, row and column.

    """
    columns, _ = read_table(path, partial(_wanted, form), 'the columns of the format', gaps=True)
    count, values = len(next(iter(columns.values()))), {}
    for name, signal in form.signals.items():
        block = np.stack([columns[column] if column else np.full(count, np.nan)
                          for column in signal.columns], axis=1) * signal.factor
        block = block[:, signal.order] if signal.order else block
        values[name] = block * [-1, -1, -1, 1] if signal.frame == 'world_to_body' else block
    t = values.pop('time')[:, 0]
    if len(t) < 10 or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise LogError(f'{path}: column {form.signals["time"].columns[0]!r}: expected at least 10 '
                       'increasing times without empty cells')
    period = float(np.median(np.diff(t)))
    place = np.rint((t - t[0]) / period).astype(int)
    on_grid = {}
    for name, block in values.items():
        on_grid[name] = np.full((place[-1] + 1, block.shape[1]), np.nan)
        on_grid[name][place] = block
    return Table(path.name, period, on_grid, form)


def _wanted(form, header):
    names = [column for signal in form.signals.values() for column in signal.columns if column]
    for name in names:
        if name not in header:
            raise ParameterError(f'no column {name!r}, which the format {form.name} declares')
    return list(dict.fromkeys(names))
