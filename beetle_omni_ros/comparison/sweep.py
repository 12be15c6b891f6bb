"""
Many flights at once: on the cores of this computer, or on a Ray cluster.

Both go through joblib and run the same function on the same arguments, so the numbers are
the same. Results come back one by one, as they are finished, and are kept at once.
"""

from __future__ import annotations

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
from beetle_omni_ros.robot.schema import ParameterError

BACKENDS = ('processes', 'ray')
OBJECT_STORE = 200 * 2**20  # [byte] that a Ray of our own may share; traces are far smaller
REACH_TIMEOUT = 5.0  # [s] for a cluster to answer


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


class SweepError(RuntimeError):
    """Workers were lost; the text says what is kept."""


def check_backend(backend: str) -> None:
    """Refuse an unknown backend with a ParameterError."""
    if backend not in BACKENDS:
        raise ParameterError(f"--backend '{backend}': expected {' or '.join(BACKENDS)}")


def sweep(flights: list[Flight], *, store: Store, backend: str = 'processes',
          jobs: int | None = None, fresh: bool = False, address: str | None = None,
          done: Callable[[Flight, dict, bool], None] = lambda flight, result, kept: None,
          ) -> dict[Flight, dict]:
    """
    Fly what is not kept yet.

    Args:
        flights: which, in the order in which they start.
        store: where finished flights are kept.
        backend: 'processes' or 'ray'.
        jobs: how many at a time; None is every core, of the cluster too.
        fresh: fly again what is kept.
        address: of a running Ray cluster; None starts a Ray on this computer alone.
        done: called with each flight, its result and whether that was kept from before.

    Returns:
        The result of :func:`fly_flight` for each flight, in the order given.

    Raises:
        ParameterError: unknown backend, Ray absent or not reachable.
        SweepError: a worker was killed.

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
        raise SweepError(
            f'a worker was lost, maybe for want of memory; {finished} of {len(flights)} flights '
            'are kept, the same command goes on from there, --jobs 1 needs the least') from None


def _fly_numbered(k, flight, task, code):
    return k, fly_flight(flight, task, code)


@contextmanager
def workers(backend, jobs, address):
    """Set joblib up; numerical libraries in workers keep to one thread each."""
    if backend == 'processes':
        with joblib.parallel_config('loky', n_jobs=jobs or -1, inner_max_num_threads=1):
            yield
        return
    ray = _start_ray(jobs, address)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of Ray, about its own future
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
        """Ray's, whose pool calls back for each result, as joblib's generators need."""

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
    """Knock first: Ray itself tries for a minute, with many lines."""
    host, _, port = address.rpartition('://')[2].rpartition(':')
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=REACH_TIMEOUT).close()


def _ray_workers(ray, jobs):
    """Two where the cluster has them, because joblib runs single jobs in this process instead."""
    cores = int(ray.cluster_resources().get('CPU', 1))
    return min(max(2, jobs or cores), cores)
