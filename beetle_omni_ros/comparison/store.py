"""Finished flights on disk, so that an interrupted or repeated comparison flies none twice."""

from __future__ import annotations

import json
import os
from pathlib import Path
import zipfile

import numpy as np

from beetle_omni_ros.comparison.fingerprint import flight_key
from beetle_omni_ros.comparison.plan import Flight
from beetle_omni_ros.robot.schema import ParameterError


class Store:
    """
    A folder with one file for each finished flight.

    A file is found again only while code, parameters, policy, task and seed are those that
    it was flown with. Failures are not kept: they are tried again.
    """

    def __init__(self, folder: Path):
        """Make the folder; raise ParameterError where that cannot be."""
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ParameterError(f'{folder}: cannot keep finished flights there '
                                 f'({error.strerror})') from None

    def _path(self, flight):
        return self.folder / f'{flight.slug}_{flight_key(flight)}.npz'

    def load(self, flight: Flight) -> dict | None:
        """Return the result of :func:`fly_flight`; None where it is not kept or not readable."""
        try:
            with np.load(self._path(flight), allow_pickle=False) as file:
                result = json.loads(str(file['result']))
                result['trace'] = {name.removeprefix('trace_'): file[name]
                                   for name in file.files if name.startswith('trace_')}
                return result
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def save(self, flight: Flight, result: dict) -> None:
        """Keep a result; raise ParameterError where it cannot be written."""
        if result['failure']:
            return
        path = self._path(flight)
        temporary = path.with_name(path.name + f'.{os.getpid()}.tmp')
        plain = {key: value for key, value in result.items() if key != 'trace'}
        try:
            for old in self.folder.glob(f'{flight.slug}_*.npz'):
                old.unlink()
            with open(temporary, 'wb') as file:
                np.savez_compressed(file, result=np.array(json.dumps(plain)),
                                    **{f'trace_{k}': v for k, v in result['trace'].items()})
            temporary.replace(path)
        except OSError as error:
            raise ParameterError(f'{path}: cannot keep the flight ({error.strerror})') from None
