"""Which recordings were given: each must exist, and stand there once."""

from __future__ import annotations

import hashlib
from pathlib import Path

from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag_reader import bag_files


def check_apart(runs: list[Path]) -> None:
    """
    Refuse a recording that is given twice, under whatever name.

    A flight that is fitted and judges as well would confirm whatever was fitted to it.

    Raises:
        BagError: no recording there, in one line.
        ParameterError: the same recording twice, naming both.

    """
    known: dict[tuple, Path] = {}
    for run in runs:
        files = [run] if run.suffix.lower() == '.csv' else bag_files(run)
        if not all(file.is_file() for file in files):
            continue        # whoever reads it says what is missing
        size = tuple(file.stat().st_size for file in files)
        digest = tuple(_digest(file) for file in files)
        if (size, digest) in known:
            raise ParameterError(f'{known[size, digest]} and {run}: the same recording twice; '
                                 'expected different flights, each once')
        known[size, digest] = run


def _digest(file):
    with file.open('rb') as stream:
        return hashlib.file_digest(stream, 'sha256').hexdigest() \
            if hasattr(hashlib, 'file_digest') else hashlib.sha256(stream.read()).hexdigest()
