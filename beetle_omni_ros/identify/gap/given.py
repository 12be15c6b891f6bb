"""Which recordings were given: each must exist, and stand there once."""

from __future__ import annotations

import hashlib
from pathlib import Path

from beetle_omni_ros.identify.gap.ingest import Flight
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.bag_files import bag_files


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


def names_of(runs: list[Path]) -> list[str]:
    """As much of each path, from its end, as tells the recordings apart."""
    paths = [run.absolute().parts for run in runs]
    for depth in range(1, max((len(parts) for parts in paths), default=1) + 1):
        names = ['/'.join(parts[-depth:]) for parts in paths]
        if len(set(names)) == len(names):
            break
    return names


def check_flights(runs: list[Path], flights: list[Flight], same: float) -> None:
    """
    Refuse one flight in two recordings, whose files differ: cut, converted or recorded twice.

    Args:
        runs: paths, for the message.
        flights: what was read there.
        same: part of the IMU's readings that only one flight has in common.

    Raises:
        ParameterError: naming both recordings.

    """
    readings = [{row.tobytes() for row in flight.imu} for flight in flights]
    for k, own in enumerate(readings):
        for j in range(k):
            if len(own & readings[j]) > same * min(len(own), len(readings[j])):
                raise ParameterError(f'{runs[j]} and {runs[k]}: the same flight in two '
                                     'recordings; expected different flights, each once')


def _digest(file):
    with file.open('rb') as stream:
        return hashlib.file_digest(stream, 'sha256').hexdigest() \
            if hasattr(hashlib, 'file_digest') else hashlib.sha256(stream.read()).hexdigest()
