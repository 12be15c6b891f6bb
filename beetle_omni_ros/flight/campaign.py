"""
Many flights: parallel, each with a file of its result.

A file belongs to one key: a digest of code, parameters, libraries and everything that was given.
A repeated campaign flies only the flights without a file.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
import hashlib
from importlib import metadata
import inspect
import json
import os
from pathlib import Path
import platform
import re
import zipfile

import joblib
import numpy as np
from rich.console import Console
from rich.progress import Progress

from beetle_omni_ros.control import registry
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import PACKAGE, share_path
from beetle_omni_ros.model.schema import ParameterError, RunError

LIBRARIES = ('casadi', 'mujoco', 'numpy', 'onnxruntime', 'scipy')
SOURCE = Path(__file__).resolve().parents[1]
# Folders whose code decides the numbers of a flight and its metrics.
FLOWN = ('bags', 'control', 'estimation', 'flight', 'model', 'sim', 'supervisor')
# Code in them that decides none.
PAGES = {SOURCE / 'flight' / name for name in ('comparison_page.py', 'faults.py', 'summary.py')}
LENGTH = 16  # hexadecimal digits kept of a digest
LOST_WORKER = 'TerminatedWorkerError', 'BrokenProcessPool'


def digest(*parts: str | bytes) -> str:
    """Digest of texts and bytes."""
    made = hashlib.sha256()
    for part in parts:
        made.update(part if isinstance(part, bytes) else f'{part}\n'.encode())
    return made.hexdigest()[:LENGTH]


def file_digest(path: str | Path) -> str:
    """Digest of a file's content; 'absent' without the file."""
    try:
        return digest(Path(path).read_bytes())
    except OSError:
        return 'absent'


@cache
def code_fingerprint(file: str) -> str:
    """Digest of libraries, parameters, the folders FLOWN without pages, and a flying ``file``."""
    files = [path for folder in FLOWN for path in (SOURCE / folder).rglob('*')
             if path.suffix in ('.py', '.c', '.h', '.yaml') and path not in PAGES]
    files += [Path(file), *share_path('params').glob('*.yaml')]
    return digest(platform.machine(), *map(str, versions().values()), *(
        part for path in sorted(files, key=lambda path: (path.parent.name, path.name))
        for part in (path.name, path.read_bytes())))


def flight_key(function: Callable, controller: str, *given: str, policy: str = '',
               plant: str = '') -> str:
    """
    Digest of everything that determines the result of a flight by ``function``.

    ``policy`` and ``plant`` are files, '' for the shipped ones; ``given`` are its other inputs.
    """
    file = policy_file(controller, policy)
    return digest(
        code_fingerprint(inspect.getfile(function)), controller, *given,
        *map(file_digest, own_files(controller)), file_digest(file) if file else '',
        RobotParameters.load(plant).hash() if plant else '')


def policy_file(controller: str, other: str | Path | None = None) -> Path | None:
    """Policy of a controller: ``other``, the shipped one, or None if it needs none or has none."""
    shipped = registry.find(controller).policy_file
    if not shipped:
        return None
    try:
        return Path(other) if other else share_path(shipped)
    except FileNotFoundError:
        return None


def own_files(controller: str) -> tuple[Path, ...]:
    """Code of a controller outside the package; nothing for a shipped one."""
    if controller in registry.SHIPPED:
        return ()
    file = Path(inspect.getfile(registry.find(controller).builder))
    top = file.parent
    while (top / '__init__.py').is_file():
        top = top.parent
    return (file,) if top == file.parent else tuple(sorted(
        (top / file.relative_to(top).parts[0]).rglob('*.py')))


def versions() -> dict[str, str]:
    """Versions of the package, Python and the libraries."""
    return {PACKAGE: metadata.version(PACKAGE), 'python': platform.python_version(),
            **{library: metadata.version(library) for library in LIBRARIES}}


class Store:
    """
    A folder with one file for each finished flight: its result as JSON, arrays of its 'trace'.

    Flights have a ``name`` and a ``key``. Failed flights are not stored, thus flown again.
    """

    def __init__(self, folder: Path):
        """Create the folder; raise ParameterError on failure."""
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ParameterError(f'{folder}: cannot keep finished flights there '
                                 f'({error.strerror})') from None

    def _stem(self, flight):
        return re.sub(r'[^A-Za-z0-9.]+', '_', flight.name)[-100:]

    def load(self, flight) -> dict | None:
        """Result of a flight; None if it is absent or unreadable."""
        try:
            with np.load(self.folder / f'{self._stem(flight)}_{flight.key}.npz') as file:
                return {**json.loads(str(file['result'])), 'trace': {
                    name.removeprefix('trace_'): file[name] for name in file.files
                    if name.startswith('trace_')}}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def save(self, flight, result: dict) -> None:
        """Store a result in place of older ones; raise ParameterError if it cannot be written."""
        if result.get('failure'):
            return
        path = self.folder / f'{self._stem(flight)}_{flight.key}.npz'
        temporary = path.with_name(f'{path.name}.{os.getpid()}.tmp')
        plain = {key: value for key, value in result.items() if key != 'trace'}
        try:
            for old in self.folder.glob(f'{self._stem(flight)}_{"?" * LENGTH}.npz'):
                old.unlink()
            with open(temporary, 'wb') as file:
                np.savez_compressed(file, result=np.array(json.dumps(plain)), **{
                    f'trace_{name}': values for name, values in result.get('trace', {}).items()})
            temporary.replace(path)
        except OSError as error:
            raise ParameterError(f'{path}: cannot keep the flight ({error.strerror})') from None


def sweep(function: Callable[..., dict], calls: Sequence[tuple], *, store: Store | None = None,
          jobs: int | None = None, console: Console | None = None,
          line: Callable[[object, dict, bool], str] = lambda flight, result, kept: '',
          ) -> list[dict]:
    """
    Fly all flights that are not stored, with a progress bar; return the results of all.

    Args:
        function: function at the top of a module that flies one flight.
        calls: its arguments for each flight, in the order of their start; the first is the
            flight, with ``name``, ``key`` and ``cost``, its approximate duration.
        store: store of finished flights; None: nothing is stored.
        jobs: number of parallel flights; None: one on each core.
        console: console for the progress and the lines.
        line: text about a flight from its result and whether it was stored before; '' for none.

    Raises:
        RunError: a worker was killed.

    """
    results: dict[int, dict] = {}
    with Progress(console=console or Console(quiet=True), transient=True,
                  speed_estimate_period=1200) as progress:
        bar = progress.add_task('', total=sum(call[0].cost for call in calls))

        def done(k, result, kept):
            flight = calls[k][0]
            results[k] = result
            progress.update(bar, advance=flight.cost,
                            description=f'{len(results)} of {len(calls)} flights')
            if text := line(flight, result, kept):
                progress.console.print(text, highlight=False, markup=False, style=(
                    'red' if result.get('failure') else 'dim' if kept else None))

        for k, call in enumerate(calls):
            if store and (known := store.load(call[0])) is not None:
                done(k, known, True)
        missing = [k for k in range(len(calls)) if k not in results]
        for at, result in _fly_all(function, [calls[k] for k in missing], jobs):
            if store:
                store.save(calls[missing[at]][0], result)
            done(missing[at], result, False)
    return [results[k] for k in range(len(calls))]


def _fly_all(function, calls, jobs) -> Iterator[tuple[int, dict]]:
    if not calls:
        return
    finished = 0
    try:
        with workers(jobs):
            for k, result in joblib.Parallel(return_as='generator_unordered', batch_size=1,
                                             pre_dispatch='all')(
                    joblib.delayed(lambda k, call: (k, function(*call)))(k, call)
                    for k, call in enumerate(calls)):
                finished += 1
                yield k, result
    except (OSError, RuntimeError) as error:
        if type(error).__name__ not in LOST_WORKER:
            raise
        raise RunError(
            f'a worker was lost, possibly for lack of memory; {finished} of {len(calls)} '
            'flights are kept and the same command continues; --jobs 1 needs the least '
            'memory') from None


def workers(jobs: int | None = None):
    """Configure joblib with one thread for the numerical libraries of each worker."""
    return joblib.parallel_config('loky', n_jobs=jobs or -1, inner_max_num_threads=1)
