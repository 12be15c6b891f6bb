"""`beetle_omni compare`: flies every experiment with several controllers and writes the page."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
import platform
import shlex
import sys
import time
import warnings

import numpy as np
from rich.console import Console

from beetle_omni_ros import __version__
from beetle_omni_ros.bags.log import FlightLog, target_errors
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.control.tasks import make_task, Task
from beetle_omni_ros.flight import campaign
from beetle_omni_ros.flight import comparison_page as page
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.flight.summary import summarise
from beetle_omni_ros.model.files import write_json, write_text
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import commit
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.show.page import print_end, print_grids, rendered, Terminal

# --- flights -------------------------------------------------------------------------------------

TASKS = ('random100', 'waypoints', 'lemniscate', 'force', 'torque', 'wind', 'pushes', 'payload',
         'hover')
CONDITIONS = ('nominal', 'published')
# Longest task [s] -> default number of seeds. A comparison of all then takes at most 90 minutes on
# two cores: three lists of 100 poses, ten flights of a short task.
SEEDS = {50.0: 10, 300.0: 6, np.inf: 3}

START_COST, COST = 2.0, 0.1  # core seconds to build simulator and controller; for a second
TRACE_PERIOD = 0.05  # [s] between samples of a trace


@dataclass(frozen=True, order=True)
class ComparedFlight:
    """One flight of a comparison."""

    task: str           # name, or path of a pose file
    conditions: str     # 'nominal' or 'published'
    controller: str     # name in the results
    seed: int           # of the task's poses and of the simulation
    policy: str = ''    # file in place of its shipped policy, '' for none
    spec: str = ''      # reference to its class, '' for a registered controller
    plant: str = ''     # robot file of the simulated plant, '' for that of ``robot``
    robot: str = ''     # robot file of estimator and controller, '' for the shipped one

    @property
    def name(self) -> str:
        """Name in messages and of its file."""
        return f'{self.controller}, {self.task}, {self.conditions}, seed {self.seed}' \
            + f', {Path(self.plant).stem}' * bool(self.plant)

    @property
    def key(self) -> str:
        """Digest of everything that determines its numbers."""
        return campaign.flight_key(
            fly_flight, self.reference, self.conditions, str(self.seed),
            campaign.file_digest(self.task) if Path(self.task).is_file() else self.task,
            RobotParameters.load(self.robot).hash() if self.robot else '',
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
         policy: Path | None = None, plant: Path | None = None) -> list[ComparedFlight]:
    """
    List all flights, longest first, so that none of the long ones remains at the end.

    Seeds are those of ``SEEDS`` by default. ``policy`` is for the controller of `--policy`. A
    ParameterError reports unknown conditions or an unknown task.
    """
    for entry in conditions:
        if entry not in CONDITIONS:
            raise ParameterError(f"--conditions '{entry}': expected {' or '.join(CONDITIONS)}")
    other = {registry.OWNER['policy']: str(policy)} if policy else {}
    entries, flights = registry.find_all(controllers), []
    for task in tasks:
        duration = make_task(task).duration
        usual = range(next(count for longest, count in SEEDS.items() if duration <= longest))
        flights += [ComparedFlight(task, condition, entry.name, seed, other.get(entry.name, ''),
                           entry.spec, str(plant or ''))
                    for condition, entry, seed in product(
                        conditions, entries, usual if seeds is None else seeds)]
    return sorted(flights, key=lambda flight: -flight.cost)


def fly_flight(flight: ComparedFlight, task: Task) -> dict:
    """
    Fly a flight and compute its metrics; ``task`` was made on the computer with the pose file.

    Returned are ``failure`` (None or one line), ``metrics`` (None or as `evaluate --json`),
    ``cpu_s``, ``host`` and ``trace``, see :func:`trace`.
    """
    start = time.process_time()
    result = {'failure': None, 'metrics': None, 'trace': {}, 'host': platform.node()}
    try:
        robot = RobotParameters.load(flight.robot or None)
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
        [deg].

    """
    if not log.targets:
        return {}
    start, (t, *apart) = log.targets[0].stamp, target_errors(log)
    until = min(t[-1], start + task.duration)
    index = np.unique(np.searchsorted(t, np.arange(start, until, TRACE_PERIOD)))
    return {name: values[index].astype(np.float32) for name, values in zip(
        ('t', 'position_error', 'orientation_error'), (t - start, *apart), strict=True)}


# --- command -------------------------------------------------------------------------------------

PAGE, NUMBERS, TEXT = 'comparison.html', 'comparison.json', 'README.md'
FLIGHTS = '.flights'  # default folder of finished flights, in the output folder


def run_compare(*, output: Path, controllers: list[str] | None = None,
                tasks: list[str] | None = None, conditions: list[str] | None = None,
                seeds: list[int] | None = None, jobs: int | None = None,
                cache: Path | None = None, policy: Path | None = None,
                plant: Path | None = None, json_path: Path | None = None,
                console: Console | None = None) -> dict:
    """
    Fly the missing flights, then write page, pictures and numbers.

    Arguments are the options of `beetle_omni compare`; None is their default.

    Returns:
        content of ``comparison.json``.

    Raises:
        ParameterError: unusable input.
        RunError: a worker was lost.

    """
    console = console or Terminal()
    RobotParameters.load(plant)     # refuses an unusable file before any work
    available, skipped = _available(controllers or registry.COMPARED, policy,
                                    refuse=controllers is not None)
    for name, reason in skipped.items():
        print(f'beetle_omni: {name} is left out: {reason}', file=sys.stderr)
    flights = plan([entry.reference for entry in available], tasks or TASKS,
                   conditions or CONDITIONS, seeds, policy, plant)
    output = Path(output)
    store = campaign.Store(cache or output / FLIGHTS)
    try:
        output.mkdir(parents=True, exist_ok=True)
        made = campaign.sweep(fly_flight, [(flight, flight.make_task()) for flight in flights],
                              store=store, jobs=jobs, console=console,
                              line=lambda flight, result, kept: f'{flight.name}: ' + (
                         result['failure'] or ('kept' if kept else f"{result['cpu_s']:.0f} s")))
    except KeyboardInterrupt:
        print(f'beetle_omni: finished flights are kept in {store.folder}; the same command '
              'continues from there', file=sys.stderr)
        raise
    except OSError as error:
        raise ParameterError(f'{output}: cannot write there ({error.strerror})') from None
    flown = dict(zip(flights, made, strict=True))
    results = results_of(flown, tasks or TASKS, conditions or CONDITIONS,
                         {entry.name: text for entry, text in available.items()}, skipped)
    write(results, flown, output, console)
    write_json(json_path, results)
    return results


def _available(names, policy, refuse):
    """Build each controller once, which also fills the cache of compiled code for the workers."""
    # Returns the entries that can fly with the text of their guidance, and the reason for each
    # other one. With ``refuse`` the first reason is raised instead.
    robot, available, skipped = RobotParameters.load(), {}, {}
    learnt = registry.OWNER['policy']
    for entry in registry.find_all(names):
        try:
            available[entry] = guidance_of(entry.make(robot, ControllerOptions(
                policy=policy if entry.name == learnt else None)))
        except (ParameterError, FileNotFoundError) as error:
            if refuse:
                raise ParameterError(str(error)) from None
            skipped[entry.name] = ' '.join(str(error).split())
    if policy and learnt not in {entry.name for entry in available}:
        raise ParameterError(f"--policy {policy}: for the controller '{learnt}', which does not "
                             'fly')
    return available, skipped


def results_of(flown: dict, tasks: Sequence[str], conditions: Sequence[str],
               guidance: dict[str, str], skipped: dict) -> dict:
    """
    Content of the JSON file, from plain values, so that it is equal after reading.

    ``guidance`` is that of each controller, ``skipped`` the reason for each other one.
    """
    order = {name: k for k, name in enumerate((*tasks, *conditions, *guidance))}
    flights = sorted(flown, key=lambda flight: (
        order[flight.task], order[flight.conditions], order[flight.controller], flight.seed))
    files = {flight.controller: campaign.policy_file(flight.reference, flight.policy)
             for flight in flights}
    return {
        'meta': {'version': __version__, 'commit': commit(),
                 'command': shlex.join(['beetle_omni', *sys.argv[1:]]),
                 'controllers': list(guidance), 'guidance': guidance, 'skipped': skipped,
                 'specs': {flight.controller: flight.spec for flight in flights if flight.spec},
                 'tasks': list(tasks), 'conditions': list(conditions),
                 'seeds': sorted({flight.seed for flight in flights}),
                 'plant': flights[0].plant,
                 'policies': {name: f'{file.name} ({campaign.file_digest(file)})'
                              for name, file in files.items() if file},
                 'cpu_s': sum(result.get('cpu_s', 0.0) for result in flown.values()),
                 'processor': _processor(), 'versions': campaign.versions()},
        'summary': summarise({flight: flown[flight] for flight in flights}),
        'flights': [{'task': flight.task, 'conditions': flight.conditions,
                     'controller': flight.controller, 'seed': flight.seed,
                     **{key: flown[flight].get(key) for key in (
                         'failure', 'cpu_s', 'host', 'metrics')}} for flight in flights]}


def _processor():
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
        return next(line.partition(':')[2].strip() for line in lines if 'model name' in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def write(results: dict, flown: dict, output: Path, console: Console) -> None:
    """Write page, pictures, text and numbers, and print the table of all experiments."""
    controllers = results['meta']['controllers']
    sections = page.sections(results, {flight: flown[flight] for flight in sorted(
        flown, key=lambda flight: (controllers.index(flight.controller), flight))})
    for block in (block for section in sections for block in section['blocks']):
        if isinstance(block, dict):
            (output / f"{block['name']}.png").write_bytes(block['data'])
    content = page.content(results, sections)
    for name in (PAGE, TEXT):
        write_text(output / name, rendered(f'comparison{Path(name).suffix}', **content), 'page')
    write_json(output / NUMBERS, results)
    print_grids([page.glance(results)], console)
    broken = sum(bool(result['failure']) for result in flown.values())
    if broken:
        console.print(f'{broken} of {len(flown)} flights failed, see above and on the page',
                      style='red', highlight=False)
    print_end(console, [output / name for name in (PAGE, TEXT, NUMBERS)],
              f'open {output / PAGE} in a browser; the same command flies only what is missing')
