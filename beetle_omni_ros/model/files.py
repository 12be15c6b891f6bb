"""CSV tables with units in the column names, and result files in strict JSON."""

from collections.abc import Callable
import csv
import gzip
import json
from math import isfinite
from pathlib import Path
import re

import numpy as np

from beetle_omni_ros.model.schema import ParameterError, quoted

LogError = ParameterError   # its name in identify


def read_table(path: str | Path, wanted: Callable[[list[str]], list[str]], expected: str, *,
               check: Callable[[list[float]], str] = lambda values: '', gaps: bool = False
               ) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """
    Read columns of a CSV file, plain or compressed by gzip.

    Blank lines, comments (#) and further columns are ignored. The header may be the last comment
    before the first row, as numpy.savetxt writes it. A column ``a`` whose cells are lists
    of numbers, as pandas writes arrays, is the columns ``a[0]``, ``a[1]`` and so on.

    Args:
        path: path of the file.
        wanted: header -> names of the columns to read; may raise ParameterError without the path.
        expected: example of a header, for messages.
        check: values of a row -> text about an unusable row after its number, or ''.
        gaps: whether a field may be empty or not finite; empty is NaN.

    Returns:
        Name -> (N,) values of the read columns, and (N,) line number of each row in the file.

    Raises:
        ParameterError: no such file, no header, a missing or repeated column, or a field without
        a number; names file, row or column, and expectation.

    """
    try:
        opened = gzip.open if Path(path).suffix == '.gz' else open
        with opened(path, 'rt', newline='', encoding='utf-8-sig') as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except FileNotFoundError:
        raise ParameterError(f'{path}: no such file') from None
    except (OSError, EOFError, UnicodeDecodeError, csv.Error) as cause:
        reason = f"not a CSV text file ({getattr(cause, 'strerror', None) or cause})"
        raise ParameterError(f'{path}: {reason}') from None
    lines = _spread(_with_header([(number, row) for number, row in lines if any(row)]))
    if not lines:
        raise ParameterError(f'{path}: empty; expected the header {expected}')
    number, header = lines.pop(0)
    try:
        if all(map(_is_number, header)):
            raise ParameterError('the header is missing')
        names = wanted(header)
        for name in names:
            if header.count(name) > 1:
                raise ParameterError(f"column '{name}' occurs twice")
    except ParameterError as cause:
        raise ParameterError(f'{path}: row {number}: {cause}; expected {expected}') from None
    index, values = [header.index(name) for name in names], []
    for line, row in lines:
        row = [cell or 'nan' for cell in row] if gaps else row
        reason = _unusable(row, header, index, gaps)
        if not reason:
            values.append([float(row[k]) for k in index])
            reason = check(values[-1])
        if reason:
            raise ParameterError(f'{path}: row {line}{reason}')
    table = np.array(values).reshape(len(lines), len(names))
    return ({name: table[:, k] for k, name in enumerate(names)},
            np.array([line for line, _ in lines], dtype=int))


def _with_header(lines):
    """Lines that are no comments; before numbers alone, a comment of as many cells is a header."""
    rows = [line for line in lines if not line[1][0].startswith('#')]
    if not rows or not all(not cell or _is_number(cell) for cell in rows[0][1]):
        return rows
    before = [(number, row) for number, row in lines if number < rows[0][0]][-1:]
    return [(number, [row[0].lstrip('# '), *row[1:]]) for number, row in before
            if len(row) == len(rows[0][1])] + rows


def _spread(lines):
    """Rows in which a cell with a list is a cell for each element."""
    first = lines[1][1] if len(lines) > 1 else []
    lists = {k: cell.count(',') + 1 for k, cell in enumerate(first) if cell.startswith('[')}
    if not lists:
        return lines
    (number, header), *rows = lines
    header = [part for k, name in enumerate(header) for part in (
        [f'{name}[{j}]' for j in range(lists[k])] if k in lists else [name])]
    return [(number, header), *((number, [
        part for k, cell in enumerate(row) for part in (
            re.split(r',\s*', re.sub(r'[\[\]]', '', cell)) if k in lists else [cell])])
        for number, row in rows)]


def _unusable(row, header, index, gaps):
    if len(row) != len(header):
        return f': expected {len(header)} values, found {len(row)}'
    bad = next((k for k in index if not _is_number(row[k]) or not (
        gaps or isfinite(float(row[k])))), None)
    return '' if bad is None else f', column {header[bad]}: expected a ' \
        f'{"" if gaps else "finite "}number, found {quoted(row[bad])}'


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True


def missing(name: str, header: list[str]) -> ParameterError:
    """Error about a missing column; it mentions a column of the same name with another unit."""
    stem = name.rpartition('_')[0]
    other = [cell for cell in header if stem and cell.rpartition('_')[0] == stem]
    hint = f" ('{other[0]}' has another unit)" if other else ''
    return ParameterError(f"column '{name}' is missing{hint}")


def write_json(path: str | Path | None, results: dict) -> None:
    """
    Write results as strict JSON: non-finite numbers become null; None: no file is wanted.

    Raises:
        ParameterError: the file cannot be written.

    """
    if path is not None:
        write_text(path, json.dumps(_strict(results), indent=1) + '\n')


def write_text(path: str | Path, text: str, what: str = 'result file') -> None:
    """
    Write a file atomically.

    Raises:
        ParameterError: the file cannot be written.

    """
    path = Path(path)
    temporary = path.with_name(path.name + '.tmp')
    try:
        temporary.write_text(text, encoding='utf-8')
        temporary.replace(path)
    except OSError as error:
        raise ParameterError(f'{path}: cannot write the {what} ({error.strerror})') from None


def _strict(value):
    if isinstance(value, dict):
        return {str(key): _strict(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(entry) for entry in value]
    if isinstance(value, float) and not isfinite(value):
        return None
    return value
