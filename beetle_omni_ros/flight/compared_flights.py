"""Flights of a comparison: their plan, and one flight with its metrics and samples."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
import platform
import time
import warnings

import numpy as np

from beetle_omni_ros.bags.log import errors, FlightLog, motion
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.control.tasks import make_task, Task
from beetle_omni_ros.flight.campaign import file_digest, flight_key
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError, RunError

TASKS = ('random100', 'waypoints', 'lemniscate', 'force', 'torque', 'wind', 'pushes', 'payload',
         'hover')
CONDITIONS = ('nominal', 'published')
# Longest task [s] -> default number of seeds. A comparison of all then takes at most 90 minutes on
# two cores: three lists of 100 poses, ten flights of a short task.
SEEDS = {50.0: 10, 300.0: 6, np.inf: 3}

START_COST, COST = 2.0, 0.1  # core seconds to build simulator and controller; for a second
TRACE_PERIOD = 0.05  # [s] between samples of a trace


@dataclass(frozen=True, order=True)
class Flight:
    """One flight of a comparison."""

    task: str           # name, or path of a pose file
    conditions: str     # 'nominal' or 'published'
    controller: str     # name in the results
    seed: int           # of the task's poses and of the simulation
    policy: str = ''    # file in place of its shipped policy, '' for none
    spec: str = ''      # reference to its class, '' for a registered controller
    plant: str = ''     # robot file of the simulated plant, '' for the shipped one

    @property
    def name(self) -> str:
        """Name in messages and of its file."""
        return f'{self.controller}, {self.task}, {self.conditions}, seed {self.seed}' \
            + f', {Path(self.plant).stem}' * bool(self.plant)

    @property
    def key(self) -> str:
        """Digest of everything that determines its numbers."""
        return flight_key(
            fly_flight, self.reference, self.conditions, str(self.seed),
            file_digest(self.task) if Path(self.task).is_file() else self.task,
            policy=self.policy, plant=self.plant)

    @cached_property
    def cost(self) -> float:
        """Approximate duration of the computation [core seconds]."""
        return START_COST + COST * self.make_task().duration

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

    Seeds are those of ``SEEDS`` by default. ``policy`` is for the controller of `--policy`. A
    ParameterError reports unknown conditions or an unknown task.
    """
    for entry in conditions:
        if entry not in CONDITIONS:
            raise ParameterError(f"--conditions '{entry}': expected {' or '.join(CONDITIONS)}")
    other = {registry.OWNER['--policy']: str(policy)} if policy else {}
    entries, flights = registry.find_all(controllers), []
    for task in tasks:
        duration = make_task(task).duration
        usual = range(next(count for longest, count in SEEDS.items() if duration <= longest))
        flights += [Flight(task, condition, entry.name, seed, other.get(entry.name, ''),
                           entry.spec, str(plant or ''))
                    for condition, entry, seed in product(
                        conditions, entries, usual if seeds is None else seeds)]
    return sorted(flights, key=lambda flight: -flight.cost)


def fly_flight(flight: Flight, task: Task) -> dict:
    """
    Fly a flight and compute its metrics; ``task`` was made on the computer with the pose file.

    Returned are ``failure`` (None or one line), ``metrics`` (None or as `evaluate --json`),
    ``cpu_s``, ``host`` and ``trace``, see :func:`trace`.
    """
    start = time.process_time()
    result = {'failure': None, 'metrics': None, 'trace': {}, 'host': platform.node()}
    try:
        robot = RobotParameters.load()
        with warnings.catch_warnings():
            # An unstable flight may overflow; its metrics show the failure.
            warnings.simplefilter('ignore', RuntimeWarning)
            log = fly(flight.reference, task, robot=robot,
                      plant=RobotParameters.load(flight.plant) if flight.plant else robot,
                      conditions=flight.conditions, seed=flight.seed,
                      options={flight.reference: ControllerOptions(
                          policy=Path(flight.policy) if flight.policy else None)},
                      meta={'task': flight.task, 'conditions': flight.conditions,
                            'seed': flight.seed})
            result['metrics'] = metrics(log, task)
            result['trace'] = trace(log, task)
    except Exception as error:  # the other flights continue after any failure of a controller
        text = ' '.join(str(error).split())
        known = isinstance(error, (RunError, ParameterError))
        result['failure'] = text if known else f'{type(error).__name__}: {text}'
    result['cpu_s'] = time.process_time() - start
    return result


def trace(log: FlightLog, task: Task) -> dict[str, np.ndarray]:
    """
    Samples of a flight for the figures.

    Returns:
        t (N,) since the first target [s], position_error (N,) [m] and orientation_error (N,)
        [deg], NaN without a target.

    """
    if not log.targets:
        return {}
    body, start = motion(log), log.targets[0].stamp
    end = min(body.t[-1], start + task.duration)
    index = np.unique(np.searchsorted(body.t, np.arange(start, end, TRACE_PERIOD)))
    index = index[index < len(body.t)]
    apart = np.full((2, len(body.t)), np.nan)
    for target, until in zip(log.targets, [*(t.stamp for t in log.targets[1:]), np.inf],
                             strict=True):
        window = body.window(target.stamp, min(until, end))
        apart[:, window] = errors(body, target, window)
    kept = {'t': body.t[index] - start, 'position_error': apart[0, index],
            'orientation_error': apart[1, index]}
    return {name: values.astype(np.float32) for name, values in kept.items()}
