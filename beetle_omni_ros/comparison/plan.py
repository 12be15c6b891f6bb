"""
Flights of a comparison.

A flight is one controller, task, set of conditions and seed. It is the unit of computation and of
the cache.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
import re

from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.tasks import make_task, Task

TASKS = ('random100', 'waypoints', 'lemniscate', 'force', 'torque', 'payload', 'hover')
CONDITIONS = ('nominal', 'published')
SEEDS = (0, 1)  # default; a long task is flown with the first one only
LONG = 50.0  # [s]

START_COST = 2.0  # core seconds to build simulator and controller


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
