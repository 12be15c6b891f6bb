"""CSV tables with units in the column names, and errors with row and column."""

from collections.abc import Callable
import csv
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot.schema import ParameterError


class LogError(ParameterError):
    """A measured log is unusable; the text states file, row or column, and expectation."""


@dataclass(frozen=True)
class Table:
    """
    Columns of numbers.

    Attributes:
        path: path of the file.
        columns: name -> (N,) values of the read columns.
        rows: (N,) line number of each row in the file.

    """

    path: Path
    columns: dict[str, np.ndarray]
    rows: np.ndarray

    def __len__(self):
        return len(self.rows)


def read_table(path: str | Path, wanted: Callable[[list[str]], list[str]], expected: str) -> Table:
    """
    Read columns of a CSV file; blank lines, comments and further columns are ignored.

    Args:
        path: path of the file.
        wanted: header -> names of the columns to read; may raise LogError without the path.
        expected: example of a header, for messages.

    Raises:
        LogError: no such file, no header, a missing or repeated column, or a field without a
        number.

    """
    path = Path(path)
    try:
        with open(path, newline='', encoding='utf-8-sig') as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except FileNotFoundError:
        raise LogError(f'{path}: no such file') from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = f"not a CSV text file ({getattr(error, 'strerror', None) or error})"
        raise LogError(f'{path}: {reason}') from None
    lines = [(number, row) for number, row in lines
             if any(row) and not row[0].startswith('#')]
    if not lines:
        raise LogError(f'{path}: empty; expected the header {expected}')
    number, header = lines.pop(0)
    if all(_is_number(cell) for cell in header):
        raise LogError(f'{path}: row {number}: the header is missing; expected {expected}')
    try:
        names = wanted(header)
    except LogError as error:
        raise LogError(f'{path}: row {number}: {error}; expected {expected}') from None
    for name in names:
        if header.count(name) > 1:
            raise LogError(f"{path}: row {number}: column '{name}' stands there twice")
    index = [header.index(name) for name in names]
    values = np.array([_values(path, line, row, header, index) for line, row in lines])
    values = values.reshape(len(lines), len(names))
    return Table(path, {name: values[:, k] for k, name in enumerate(names)},
                 np.array([line for line, _ in lines], dtype=int))


def _values(path, line, row, header, index):
    if len(row) != len(header):
        raise LogError(f'{path}: row {line}: expected {len(header)} values, found {len(row)}')
    for k in index:
        if not _is_number(row[k]) or not isfinite(float(row[k])):
            raise LogError(f'{path}: row {line}, column {header[k]}: expected a finite number, '
                           f"found '{row[k]}'")
    return [float(row[k]) for k in index]


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True


def missing(name: str, header: list[str]) -> LogError:
    """Error about a missing column; it mentions a column of the same name with another unit."""
    stem = name.rpartition('_')[0]
    other = [cell for cell in header if stem and cell.rpartition('_')[0] == stem]
    hint = f" ('{other[0]}' has another unit)" if other else ''
    return LogError(f"column '{name}' is missing{hint}")
