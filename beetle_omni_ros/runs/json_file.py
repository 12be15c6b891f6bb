"""Result files in strict JSON."""

import json
from math import isfinite
import os
from pathlib import Path

from beetle_omni_ros.robot.schema import ParameterError


def check_writable(path: str | Path | None, what: str = 'result file') -> None:
    """
    Check that a file can be written, before its content is computed; None: none is wanted.

    Raises:
        ParameterError: it cannot; names the file and the reason.

    """
    if path is None:
        return
    path = Path(path)
    folder = path.absolute().parent
    if path.is_dir():
        reason = 'it is a folder'
    elif not folder.is_dir():
        reason = f'there is no folder {folder}'
    elif not os.access(path if path.exists() else folder, os.W_OK):
        reason = 'no permission'
    else:
        return
    raise ParameterError(f'{path}: cannot write the {what} there ({reason})')


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
