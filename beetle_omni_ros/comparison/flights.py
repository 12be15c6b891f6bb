"""
Flights of a comparison: their plan, one flight with its metrics and samples, and many of them.

A flight is one controller, task, set of conditions and seed. It is the unit of computation and of
the cache. Flights are parallel, on the cores of this computer or on a Ray cluster. Both use joblib
with the same function and arguments, so that the numbers are equal.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
import hashlib
from itertools import product
import json
import os
from pathlib import Path
import platform
import re
import socket
import time
import warnings
import zipfile

import joblib
import numpy as np

from beetle_omni_ros.comparison.fingerprint import (
    code_fingerprint,
    COMPARED,
    file_digest,
    LENGTH,
    own_files,
    policy_file,
)
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.evaluation.command import fly
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.runs.log import errors, FlightLog, motion
from beetle_omni_ros.runs.metrics import metrics
from beetle_omni_ros.runs.tasks import make_task, Task

TASKS = ('random100', 'waypoints', 'lemniscate', 'force', 'torque', 'payload', 'hover')
CONDITIONS = ('nominal', 'published')
SEEDS = (0, 1)  # default; a long task is flown with the first one only
LONG = 50.0  # [s]

START_COST = 2.0  # core seconds to build simulator and controller
TRACE_PERIOD = 0.02  # [s] between samples of a trace
LONG_TRACE_PERIOD = 0.05  # [s] between samples in a long task
TRACED_FINELY = 300.0  # [s] longest task with TRACE_PERIOD
COMMAND_WINDOW = 2.0  # [s] of commands kept at the end of a flight
BACKENDS = ('processes', 'ray')
OBJECT_STORE = 200 * 2**20  # [byte] shared memory of a local Ray; traces are far smaller
REACH_TIMEOUT = 5.0  # [s] for an answer of a cluster


@dataclass(frozen=True, order=True)
class Flight:
    """
    One flight of a comparison.

    Attributes:
        task: name, or path of a pose file.
        conditions: 'nominal' or 'published'.
        controller: name in the results.
        seed: seed of the task's poses and of the simulation.
        policy: file in place of its shipped policy, '' for none.
        spec: reference to its class, '' for a registered controller.
        plant: robot file of the simulated plant, '' for the shipped one.

    """

    task: str
    conditions: str
    controller: str
    seed: int
    policy: str = ''
    spec: str = ''
    plant: str = ''

    @property
    def name(self) -> str:
        """Name in messages."""
        return f'{self.controller}, {self.task}, {self.conditions}, seed {self.seed}' \
            + f', {Path(self.plant).stem}' * bool(self.plant)

    @property
    def slug(self) -> str:
        """The name as part of a file name."""
        return re.sub(r'[^A-Za-z0-9.]+', '_', self.name)[-100:]

    @cached_property
    def cost(self) -> float:
        """Approximate duration of the computation [core seconds]."""
        return START_COST + registry.find(self.reference).cost * self.make_task().duration

    @property
    def reference(self) -> str:
        """Name or class of the controller, for the registry."""
        return self.spec or self.controller

    def make_task(self) -> Task:
        """Task of the flight."""
        return make_task(self.task, self.seed)


def plan(controllers: Sequence[str], tasks: Sequence[str] = TASKS,
         conditions: Sequence[str] = CONDITIONS, seeds: Sequence[int] | None = None,
         policy: Path | None = None, plant: Path | None = None) -> list[Flight]:
    """
    List all flights, longest first, so that none of the long ones remains at the end.

    Args:
        controllers: names, or references to classes.
        tasks: names, or paths of pose files.
        conditions: 'nominal', 'published'.
        seeds: numbers from 0; None: 0 and 1, but only 0 for tasks of more than 50 s.
        policy: file that replaces the shipped policy, for the controller of `--policy`.
        plant: robot file of the simulated plant.

    Raises:
        ParameterError: no entry or equal entries; unknown conditions or task.

    """
    for option, entries in (('--controllers', controllers), ('--tasks', tasks),
                            ('--conditions', conditions),
                            ('--seeds', SEEDS if seeds is None else seeds)):
        if not entries or len(set(entries)) != len(entries):
            text = ','.join(str(entry) for entry in entries)
            raise ParameterError(f"{option} '{text}': expected different entries, "
                                 'separated by commas')
    for entry in conditions:
        if entry not in CONDITIONS:
            raise ParameterError(f"--conditions '{entry}': expected {' or '.join(CONDITIONS)}")
    chosen = {task: seeds_of(task) for task in tasks}  # also refuses unknown tasks
    if seeds is not None:
        chosen = dict.fromkeys(tasks, seeds)
    other = {registry.owner('--policy'): str(policy)} if policy else {}
    entries = registry.find_all(controllers)
    flights = [Flight(task, condition, entry.name, seed, other.get(entry.name, ''), entry.spec,
                      str(plant or ''))
               for task in tasks for condition, entry, seed
               in product(conditions, entries, chosen[task])]
    return sorted(flights, key=lambda flight: -flight.cost)


def seeds_of(task: str) -> Sequence[int]:
    """Default seeds of a task."""
    return SEEDS[:1] if make_task(task).duration > LONG else SEEDS


def fly_flight(flight: Flight, task: Task, code: str | None = None) -> dict:
    """
    Fly a flight and compute its metrics; a failed flight has a result, too.

    Args:
        flight: the flight.
        task: its task, made on the computer with the pose file.
        code: required fingerprint of this computer's code, so that a cluster's workers cannot mix
            versions; None: any.

    Returns:
        A dictionary with ``failure`` (None or one line), ``metrics`` (None or as in INTERFACES,
        with ``steps``, the number of controller steps), ``cpu_s``, ``host`` and ``trace`` (name ->
        array, see :func:`trace`).

    """
    start = time.process_time()
    result = {'failure': None, 'metrics': None, 'trace': {}, 'host': platform.node()}
    if code is not None and code != code_fingerprint():
        result['failure'] = (f'{platform.node()} has another version of the code or its '
                             'parameters than the computer that started the sweep')
        return result
    try:
        robot = RobotParameters.load()
        plant = RobotParameters.load(flight.plant) if flight.plant else robot
        with warnings.catch_warnings():
            # An unstable flight may overflow; its metrics show the failure.
            warnings.simplefilter('ignore', RuntimeWarning)
            log = fly(flight.reference, task, robot=robot, plant=plant,
                      conditions=flight.conditions, seed=flight.seed,
                      options={flight.reference: ControllerOptions(
                          policy=Path(flight.policy) if flight.policy else None)},
                      meta={'task': flight.task, 'conditions': flight.conditions,
                            'seed': flight.seed})
            result['metrics'] = judged = metrics(log, task)
            judged['steps'] = log.compute.get(flight.controller, {}).get('count', 0)
            result['trace'] = trace(log, task)
    except (RunError, ParameterError) as error:
        result['failure'] = _line(error)
    except Exception as error:  # the other flights continue after any failure of a controller
        result['failure'] = f'{type(error).__name__}: {_line(error)}'
    result['cpu_s'] = time.process_time() - start
    return result


def _line(error):
    return ' '.join(str(error).split()) or type(error).__name__


def trace(log: FlightLog, task: Task) -> dict[str, np.ndarray]:
    """
    Samples of a flight for the figures.

    Returns:
        t (N,) since the first target [s], position (N, 3) [m], quaternion (N, 4), speed (N,)
        [m/s], rate (N,) [rad/s], position_error (N,) [m], orientation_error (N,) [deg], NaN
        without a target; and command_t (M,) [s], command_tilt (M, 4) [rad], command_thrust (M, 4)
        [N] of the last 2 s.

    """
    if not log.targets:
        return {}
    body, start = motion(log), log.targets[0].stamp
    every = LONG_TRACE_PERIOD if task.duration > TRACED_FINELY else TRACE_PERIOD
    end = min(body.t[-1], start + task.duration)
    index = np.unique(np.searchsorted(body.t, np.arange(start, end, every)))
    index = index[index < len(body.t)]
    apart = np.full((2, len(body.t)), np.nan)
    for target, until in zip(log.targets, [*(t.stamp for t in log.targets[1:]), np.inf],
                             strict=True):
        window = body.window(target.stamp, min(until, end))
        apart[:, window] = errors(body, target, window)
    recent = (log.command_t > end - COMMAND_WINDOW) & (log.command_t <= end)
    kept = {'t': body.t[index] - start, 'position': body.position[index],
            'quaternion': body.quaternion[index],
            'speed': np.linalg.norm(body.velocity[index], axis=1),
            'rate': np.linalg.norm(body.angular_velocity[index], axis=1),
            'position_error': apart[0, index], 'orientation_error': apart[1, index],
            'command_t': log.command_t[recent] - start,
            'command_tilt': log.command_tilt[recent],
            'command_thrust': log.command_thrust[recent]}
    return {name: values.astype(np.float32) for name, values in kept.items()}


def flight_key(flight: Flight) -> str:
    """Digest of everything that determines a flight's numbers."""
    own = own_files(flight.reference)
    parts = [code_fingerprint(None if own else flight.reference, (*COMPARED, *own)),
             flight.reference, flight.conditions, str(flight.seed),
             *(file_digest(path) for path in own)]      # anew, because it may change meanwhile
    is_file = Path(flight.task).is_file()
    parts.append(file_digest(flight.task) if is_file else flight.task)
    if policy := policy_file(flight.reference, flight.policy):
        parts.append(file_digest(policy))
    if flight.plant:
        parts.append(RobotParameters.load(flight.plant).hash())
    return hashlib.sha256('\n'.join(parts).encode()).hexdigest()[:LENGTH]


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
