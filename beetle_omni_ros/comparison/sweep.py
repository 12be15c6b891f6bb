"""
Parallel flights, on the cores of this computer or on a Ray cluster.

Both use joblib with the same function and arguments, so that the numbers are equal. Each result is
stored as soon as it is finished.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
import os
from pathlib import Path
import socket
import warnings
import zipfile

import joblib
import numpy as np

from beetle_omni_ros.comparison.fingerprint import code_fingerprint, flight_key
from beetle_omni_ros.comparison.flight import fly_flight
from beetle_omni_ros.comparison.plan import Flight
from beetle_omni_ros.robot.schema import ParameterError, RunError

BACKENDS = ('processes', 'ray')
OBJECT_STORE = 200 * 2**20  # [byte] shared memory of a local Ray; traces are far smaller
REACH_TIMEOUT = 5.0  # [s] for an answer of a cluster


class Store:
    """
    A folder with one file for each finished flight.

    A file is valid for the same code, parameters, policy, task and seed only. Failed flights are
    not stored, so that they are repeated.
    """

    def __init__(self, folder: Path):
        """Create the folder; raise ParameterError on failure."""
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ParameterError(f'{folder}: cannot keep finished flights there '
                                 f'({error.strerror})') from None

    def _path(self, flight):
        return self.folder / f'{flight.slug}_{flight_key(flight)}.npz'

    def load(self, flight: Flight) -> dict | None:
        """Result of :func:`fly_flight`; None if it is absent or unreadable."""
        try:
            with np.load(self._path(flight), allow_pickle=False) as file:
                result = json.loads(str(file['result']))
                result['trace'] = {name.removeprefix('trace_'): file[name]
                                   for name in file.files if name.startswith('trace_')}
                return result
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def save(self, flight: Flight, result: dict) -> None:
        """Store a result; raise ParameterError if it cannot be written."""
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


def check_backend(backend: str) -> None:
    """Raise a ParameterError for an unknown backend."""
    if backend not in BACKENDS:
        raise ParameterError(f"--backend '{backend}': expected {' or '.join(BACKENDS)}")


def sweep(flights: list[Flight], *, store: Store, backend: str = 'processes',
          jobs: int | None = None, fresh: bool = False, address: str | None = None,
          done: Callable[[Flight, dict, bool], None] = lambda flight, result, kept: None,
          ) -> dict[Flight, dict]:
    """
    Fly all flights that are not stored.

    Args:
        flights: the flights, in the order of their start.
        store: store of finished flights.
        backend: 'processes' or 'ray'.
        jobs: number of parallel flights; None: one on each core, also of a cluster.
        fresh: whether to repeat stored flights.
        address: address of a running Ray cluster; None: a Ray on this computer.
        done: called with each flight, its result and whether it was stored before.

    Returns:
        The result of :func:`fly_flight` for each flight, in the order of ``flights``.

    Raises:
        ParameterError: unknown backend, or Ray is absent or not reachable.
        RunError: a worker was killed.

    """
    check_backend(backend)
    results: dict[Flight, dict] = {}
    for flight in flights:
        kept = None if fresh else store.load(flight)
        if kept is not None:
            results[flight] = kept
            done(flight, kept, True)
    missing = [flight for flight in flights if flight not in results]
    if missing:
        with workers(backend, jobs, address):
            for flight, result in _fly_all(missing):
                store.save(flight, result)
                results[flight] = result
                done(flight, result, False)
    return {flight: results[flight] for flight in flights}


def _fly_all(flights: list[Flight]) -> Iterator[tuple[Flight, dict]]:
    code = code_fingerprint()
    calls = (joblib.delayed(_fly_numbered)(k, flight, flight.make_task(), code)
             for k, flight in enumerate(flights))
    finished = 0
    parallel = joblib.Parallel(return_as='generator_unordered', batch_size=1, pre_dispatch='all')
    try:
        for k, result in parallel(calls):
            finished += 1
            yield flights[k], result
    except (OSError, RuntimeError) as error:
        if type(error).__name__ not in ('TerminatedWorkerError', 'BrokenProcessPool',
                                        'RayActorError', 'ActorDiedError', 'OutOfMemoryError'):
            raise
        raise RunError(
            f'a worker was lost, possibly for lack of memory; {finished} of {len(flights)} '
            'flights are kept and the same command continues; --jobs 1 needs the least '
            'memory') from None


def _fly_numbered(k, flight, task, code):
    return k, fly_flight(flight, task, code)


@contextmanager
def workers(backend, jobs, address):
    """Configure joblib with one thread for the numerical libraries of each worker."""
    if backend == 'processes':
        with joblib.parallel_config('loky', n_jobs=jobs or -1, inner_max_num_threads=1):
            yield
        return
    ray = _start_ray(jobs, address)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # Ray warns about its own future
            with joblib.parallel_config('beetle_omni_ray', n_jobs=_ray_workers(ray, jobs)):
                yield
    finally:
        ray.shutdown()


def _start_ray(jobs, address):
    os.environ.setdefault('RAY_USAGE_STATS_ENABLED', '0')
    os.environ.setdefault('RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO', '0')
    try:
        import ray
        from ray.util.joblib import register_ray
        from ray.util.joblib.ray_backend import RayBackend
    except ImportError:
        raise ParameterError("--backend ray: the module 'ray' is not installed; pip install "
                             "'beetle_omni_ros[ray]' brings it") from None

    class Backend(RayBackend):
        """Ray's backend, with the callbacks that joblib's generators need."""

        supports_return_generator = True

    register_ray()
    joblib.register_parallel_backend('beetle_omni_ray', Backend)
    quiet = {'logging_level': 'ERROR', 'log_to_driver': False}
    try:
        if address:
            _reach(address)
            ray.init(address=address, **quiet)
        else:
            ray.init(address='local', num_cpus=max(2, jobs or joblib.cpu_count()),
                     include_dashboard=False, object_store_memory=OBJECT_STORE, **quiet)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        text = ' '.join(str(error).split())[:200]
        raise ParameterError(f"--backend ray: cannot use the cluster at '{address or 'local'}' "
                             f'({text})') from None
    return ray


def _reach(address):
    """Connect first, because Ray itself tries for a minute and prints many lines."""
    host, _, port = address.rpartition('://')[2].rpartition(':')
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=REACH_TIMEOUT).close()


def _ray_workers(ray, jobs):
    """At least two if available, because joblib runs a single job in this process."""
    cores = int(ray.cluster_resources().get('CPU', 1))
    return min(max(2, jobs or cores), cores)
