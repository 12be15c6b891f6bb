"""`beetle_omni evaluate`: flies tasks in one process with one or several controllers."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from time import monotonic, time
from types import MappingProxyType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from beetle_omni_ros import __version__
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of, reach_of
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.messages.topics import topics_with
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.urdf import description
from beetle_omni_ros.runs import metrics as metrics_of_runs
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.files import write_json
from beetle_omni_ros.runs.log import FlightLog, LogRecorder, Tee
from beetle_omni_ros.runs.targets import check_steps
from beetle_omni_ros.runs.tasks import make_task, Task
from beetle_omni_ros.sim.fault_lists import load_faults
from beetle_omni_ros.sim.faults import Fault


def fly(controller: str, task: Task, *, robot: RobotParameters, plant: RobotParameters,
        conditions: str = 'nominal', seed: int = 0,
        options: Mapping[str, ControllerOptions] = MappingProxyType({}),
        bag: Path | None = None, compression: str = 'none', meta: dict | None = None,
        faults: Sequence[Fault] = (), progress=lambda part: None) -> FlightLog:
    """
    Fly one task with one controller; :func:`run_evaluate` describes the arguments.

    Returns:
        the flight, also after a crash (``meta['crashed']``).

    Raises:
        ParameterError: a pose of the task is beyond the controller's reach.

    """
    # With a lost actuator the pilot lands the robot, whatever the active controller is.
    entries = map(registry.find, dict.fromkeys(
        [controller, registry.pilot()] if faults else [controller]))
    aboard = {entry.name: entry.make(robot, options.get(entry.reference, ControllerOptions()))
              for entry in entries}
    name, flying = next(iter(aboard.items()))
    if task.kind == 'poses':
        check_steps(task.poses, reach_of(flying), lambda k: f"task '{task.name}': pose {k + 1}")
    meta = dict(meta or {}, controller=name, guidance=guidance_of(flying))
    memory = LogRecorder(meta)
    with ExitStack() as stack:
        recorder = memory
        if bag is not None:
            writer = stack.enter_context(BagWriter(
                bag, meta=meta, topics=tuple(topics_with([name])), compression=compression,
                description=description(), epoch=int(time())))
            recorder = Tee(memory, writer)
        loop = FlightLoop.shipped(robot, plant, aboard, recorder, conditions=conditions,
                                  seed=seed, faults=faults)
        simulator, stayed = loop.simulator, loop.fly(task, progress)
        recorder.write_meta({'crashed': not stayed, 'ended': loop.ending,
                             'controller_error': loop.controller_error,
                             'broken': simulator.truth.broken})
        if simulator.truth.impact is not None:
            recorder.write_meta({'impact': asdict(simulator.truth.impact)})
    return memory.log()


def run_evaluate(*, controllers: list[str], task: str | Task, conditions: str = 'nominal',
                 robot: Path | None = None, plant: Path | None = None, seed: int = 0,
                 bag: Path | None = None, json_path: Path | None = None,
                 compression: str = 'none',
                 options: Mapping[str, ControllerOptions] = MappingProxyType({}),
                 faults: Path | None = None, console: Console | None = None) -> dict:
    """
    Fly a task with each controller and report.

    Args:
        controllers: names or references to classes, see :func:`control.registry.find`.
        task: task, or its name or pose file.
        conditions: 'nominal' or 'published'.
        robot: robot file of estimator and controllers; default the shipped one.
        plant: robot file of the simulated plant; default ``robot``.
        seed: seed of the task's poses and of the simulation.
        bag: folder of a bag; with several controllers it contains one bag for each.
        compression: compression of the bags, 'none' or 'zstd'.
        json_path: file for the results.
        options: controller -> files in place of its own.
        faults: file of faults with times since the task's start and durations.
        console: console for the output.

    Returns:
        the results as in INTERFACES: ``meta`` and a key for each controller.

    Raises:
        ParameterError, BagError: unusable input, one line.

    """
    console = console or table.Terminal()
    nominal = RobotParameters.load(robot)
    true = RobotParameters.load(plant) if plant else nominal
    entries = registry.find_all(controllers)
    options = {registry.find(name).reference: given for name, given in options.items()}
    reaches = [_reach(entry, nominal, options.get(entry.reference, ControllerOptions()))
               for entry in entries]
    flown = task if isinstance(task, Task) else make_task(task, seed, min(reaches))
    task = flown.name
    injected = load_faults(faults) if faults else []
    meta = {'task': task, 'conditions': conditions, 'seed': seed,
            'robot': str(robot) if robot else 'params/robot.yaml',
            'plant': str(plant) if plant else None, 'version': __version__,
            **_optional_meta(entries, options, injected)}
    results: dict = {'meta': meta}
    columns = (TextColumn('{task.description}'), BarColumn(),
               TextColumn('{task.percentage:>3.0f} %'), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bars:
        for entry in entries:
            name = entry.name
            bar = bars.add_task(f'{name}: {task}, {conditions}', total=1.0)
            folder = bag / name if bag and len(controllers) > 1 else bag
            begin = monotonic()
            log = fly(entry.reference, flown, robot=nominal, plant=true, conditions=conditions,
                      seed=seed, options=options, bag=folder, compression=compression,
                      meta=meta, faults=injected,
                      progress=lambda part, bar=bar: bars.update(bar, completed=part))
            results[name] = metrics_of_runs.metrics(log, flown)
            if not console.is_terminal:     # which shows no progress bar
                console.print(f'{name}: {task} flown in {monotonic() - begin:.0f} s',
                              highlight=False)
            for text in (log.meta['ended'] and f'the flight ended early, {log.meta["ended"]}',
                         log.meta['controller_error']):
                if text:
                    console.print(f'{name}: {text}', style='yellow', markup=False,
                                  highlight=False)
    table.print_results(results, console)
    write_json(json_path, results)
    return results


def _optional_meta(entries, options, faults):
    """Facts that only some runs have: policy file, controllers of others, injected faults."""
    meta: dict = {}
    for given in options.values():
        if given.policy:
            meta['policy'] = str(given.policy)
    if others := {entry.name: entry.spec for entry in entries if entry.spec}:
        meta['controllers'] = others
    if faults:
        meta['faults'] = [str(fault) for fault in faults]
    return meta


def _reach(entry, robot, options):
    """Reach of a controller [m]; builds controllers that may be unusable, before any flight."""
    if entry.policy_file or entry.spec:
        return reach_of(entry.make(robot, options))
    return entry.reach(robot, options)
