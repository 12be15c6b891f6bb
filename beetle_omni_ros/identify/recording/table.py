"""Flights as tables: CSV files whose columns a format declares."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.recording.parameters import shipped
from beetle_omni_ros.model.files import LogError, read_table
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import (
    bind,
    load_yaml,
    numbers,
    parameter,
    ParameterError,
    quoted,
    unknown,
)

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
          'quaternion': ('body_to_world', 'world_to_body'), 'specific_force': ('body', 'world'),
          'angular_velocity': ('body', 'world'), 'target_position': ('world',)}
ORDERS = {'xyzw': (0, 1, 2, 3), 'wxyz': (1, 2, 3, 0)}


@dataclass(frozen=True, eq=False)
class Signal:
    """One signal of a format."""

    columns: tuple = parameter(doc='its columns; null: this component is not recorded')
    unit: str = parameter('1', doc='unit of the columns')
    frame: str = parameter('', doc='frame of a vector, or direction of a quaternion')
    sign: np.ndarray = parameter([1.0], doc='1 or -1 for each column', low=-1, high=1)
    order: str = parameter('xyzw', doc='parts of the columns of a quaternion')
    full: float = parameter(1.0, doc='value of full duty')
    clock: str = parameter('log', doc='what stamps it; signals of one clock are synchronous')


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
        deviation = float(numbers(content.pop('clock_deviation', 0.0), f"{path}: key "
                                  "'clock_deviation'", {'low': 0, 'high': None, 'unit': 's'}))
        name = str(content.pop('name', path.stem))
        signals = {key: _signal(key, value, str(path)) for key, value in content.items()}
        if 'time' not in signals:
            raise ParameterError(f"{path}: key 'time' is missing: expected the column of the time")
        if 'thrust' in signals and 'duty' in signals:
            raise ParameterError(f"{path}: expected 'thrust' or 'duty', found both")
        if 'quaternion' not in signals:
            for key in turned_to_world(signals):
                raise ParameterError(f"{path}: key 'quaternion' is missing: expected the attitude "
                                     f'that turns {key!r} from world to body')
        return cls(name, signals, deviation)


def turned_to_world(signals: dict[str, Signal]) -> list[str]:
    """Readings of body axes that an estimator has turned by the attitude of the same row."""
    return [name for name, own in signals.items()
            if own.frame == 'world' and FRAMES[name][0] == 'body']


def _signal(name, content, path):
    if name not in SIGNALS:
        raise unknown(f'{path}: key {name!r}', 'signal', name, SIGNALS)
    if isinstance(content, dict):   # a single column, and the unit 1, need no list and no quotes
        content = content | {key: [value] if key == 'columns' else str(value)
                             for key, value in content.items()
                             if key in ('columns', 'unit') and isinstance(value, (str, int))}
    made, (width, units) = bind(Signal, content, path, f'{name}.'), SIGNALS[name]
    for key, fits, expected in (
            ('columns', len(made.columns) == width and all(
                isinstance(column, str | None) for column in made.columns),
             f'{width} names (null: not recorded)'),
            ('sign', len(made.sign) in (1, width) and (abs(made.sign) == 1).all(),
             f'{width} of 1 or -1'),
            *((key, getattr(made, key) in known, f"one of {', '.join(filter(None, known))}")
              for key, known in (('unit', units), ('frame', ('', *FRAMES.get(name, ()))),
                                 ('order', ORDERS)))):
        if not fits:
            raise ParameterError(f"{path}: key '{name}.{key}': expected {expected}, found "
                                 f'{quoted(getattr(made, key))}')
    return made


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


def columns_of(path: Path, form: Format) -> dict[str, np.ndarray]:
    """Columns of a file that the format names; LogError with file, row and column."""
    return read_table(path, partial(_wanted, form), 'the columns of the format', gaps=True)[0]


def table_of(path: Path, columns: dict[str, np.ndarray], form: Format) -> Table:
    """
    Flight of the columns of a file.

    Each row goes to the nearest point of a regular grid with the median period. An empty cell and
    a point without row are samples that do not exist.

    Raises:
        LogError: no increasing times, or not those of a flight.

    """
    count, values = len(next(iter(columns.values()))), {}
    for name, signal in form.signals.items():
        block = np.stack([columns[column] if column else np.full(count, np.nan)
                          for column in signal.columns], axis=1)
        block = block * signal.sign * SIGNALS[name][1][signal.unit] / signal.full
        if name == 'quaternion':
            block = block[:, ORDERS[signal.order]]
            block[~block.any(axis=1)] = np.nan      # a lost attitude
        values[name] = block * [-1, -1, -1, 1] if signal.frame == 'world_to_body' else block
    for name in turned_to_world(form.signals):
        values[name] = _in_body(values[name], values['quaternion'])
    t = values.pop('time')[:, 0]
    if len(t) < 10 or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise LogError(f'{path}: column {form.signals["time"].columns[0]!r}: expected at least 10 '
                       'increasing times without empty cells')
    period, (low, high) = float(np.median(np.diff(t))), shipped().period
    if not low <= period <= high:
        raise LogError(f"{path}: rows are {period:g} s apart, expected {low:g} to {high:g} s: key "
                       f"'time.unit' of the format {form.name}?")
    place = np.rint((t - t[0]) / period).astype(int)
    on_grid = {}
    for name, block in values.items():
        on_grid[name] = np.full((place[-1] + 1, block.shape[1]), np.nan)
        on_grid[name][place] = block
    return Table(path.name, period, on_grid, form)


def _in_body(vectors, quaternion):
    there = np.isfinite(quaternion).all(axis=1)
    body = np.full(vectors.shape, np.nan)
    body[there] = Rotation.from_quat(quaternion[there]).inv().apply(vectors[there])
    return body


def _wanted(form, header):
    names = [column for signal in form.signals.values() for column in signal.columns if column]
    for name in names:
        if name not in header:
            raise ParameterError(f'no column {name!r}, which the format {form.name} declares')
    return list(dict.fromkeys(names))
