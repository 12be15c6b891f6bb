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
from beetle_omni_ros.control.base import Controller, guidance_of, reach_of
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.messages.topics import topics_with
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag_writer import BagWriter
from beetle_omni_ros.runs.files import write_json
from beetle_omni_ros.runs.log import FlightLog, LogRecorder, Recorder
from beetle_omni_ros.runs.metrics import metrics
from beetle_omni_ros.runs.targets import check_steps
from beetle_omni_ros.runs.tasks import make_task, Task
from beetle_omni_ros.sim.fault_lists import load_faults
from beetle_omni_ros.sim.faults import Fault


def fly(controller: str, task: Task, *, robot: RobotParameters, plant: RobotParameters,
        conditions: str = 'nominal', seed: int = 0,
        options: Mapping[str, ControllerOptions] = MappingProxyType({}),
        built: Controller | None = None, bag: Path | None = None,
        meta: dict | None = None, faults: Sequence[Fault] = (),
        progress=lambda part: None) -> FlightLog:
    """
    Fly one task with one controller; :func:`run_evaluate` describes the other arguments.

    ``controller`` is a name or a reference to a class, ``built`` the same if it was built before.

    Returns:
        the flight, also after a crash (``meta['crashed']``).

    Raises:
        ParameterError: a pose of the task is beyond the controller's reach.

    """
    entry = registry.find(controller)
    flying = built or entry.make(robot, options.get(entry.reference, ControllerOptions()))
    aboard = {entry.name: flying}
    if faults:  # with a lost actuator the pilot lands the robot, whatever controller is active
        pilot = registry.find(registry.pilot())
        aboard.setdefault(pilot.name, flying if pilot == entry else pilot.make(
            robot, options.get(pilot.reference, ControllerOptions())))
    if task.kind == 'poses':
        check_steps(task.poses, reach_of(flying), lambda k: f"task '{task.name}': pose {k + 1}")
    meta = dict(meta or {}, controller=entry.name, guidance=guidance_of(flying))
    memory = LogRecorder(meta)
    with ExitStack() as stack:
        recorder: Recorder = memory
        if bag is not None:
            recorder = Recorder(memory, stack.enter_context(BagWriter(
                bag, meta=meta, topics=tuple(topics_with([entry.name])), frames=True,
                epoch=int(time()))))
        loop = FlightLoop(robot, plant, aboard, recorder, conditions=conditions, seed=seed,
                          faults=faults)
        stayed, truth = loop.fly(task, progress), loop.simulator.truth
        recorder.write_meta({'crashed': not stayed, 'ended': loop.ending,
                             'controller_error': loop.controller_error,
                             'broken': truth.broken})
        if truth.impact is not None:
            recorder.write_meta({'impact': asdict(truth.impact)})
    return memory.log()


def run_evaluate(*, controllers: list[str], task: str | Task, conditions: str = 'nominal',
                 robot: Path | None = None, plant: Path | None = None, seed: int = 0,
                 bag: Path | None = None, json_path: Path | None = None,
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
        json_path: file for the results.
        options: controller -> files in place of its own.
        faults: file of faults with times since the task's start and durations.
        console: console for the output.

    Returns:
        the results as in INTERFACES: ``meta`` and a key for each controller.

    Raises:
        ParameterError: unusable input, one line.

    """
    console = console or table.Terminal()
    believed = RobotParameters.load(robot)
    true = RobotParameters.load(plant) if plant else believed
    options = {registry.find(name).reference: given for name, given in options.items()}
    built = {entry: entry.make(believed, options.get(entry.reference, ControllerOptions()))
             for entry in registry.find_all(controllers)}
    if not isinstance(task, Task):
        task = make_task(task, seed, min(map(reach_of, built.values())))
    injected = load_faults(faults) if faults else []
    meta = {'task': task.name, 'conditions': conditions, 'seed': seed,
            'robot': str(robot) if robot else 'params/robot.yaml',
            'plant': str(plant) if plant else None, 'version': __version__}
    for given in options.values():
        if given.policy:
            meta['policy'] = str(given.policy)
    if others := {entry.name: entry.spec for entry in built if entry.spec}:
        meta['controllers'] = others
    if injected:
        meta['faults'] = [str(fault) for fault in injected]
    results: dict = {'meta': meta}
    columns = (TextColumn('{task.description}'), BarColumn(),
               TextColumn('{task.percentage:>3.0f} %'), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bars:
        for entry, controller in built.items():
            name, begin = entry.name, monotonic()
            bar = bars.add_task(f'{name}: {task.name}, {conditions}', total=1.0)
            log = fly(entry.reference, task, robot=believed, plant=true, conditions=conditions,
                      seed=seed, options=options, built=controller,
                      bag=bag / name if bag and len(built) > 1 else bag, meta=meta,
                      faults=injected,
                      progress=lambda part, bar=bar: bars.update(bar, completed=part))
            results[name] = metrics(log, task)
            if not console.is_terminal:     # which shows no progress bar
                console.print(f'{name}: {task.name} flown in {monotonic() - begin:.0f} s',
                              highlight=False)
            for text in (log.meta['ended'] and f'the flight ended early, {log.meta["ended"]}',
                         log.meta['controller_error']):
                if text:
                    console.print(f'{name}: {text}', style='yellow', markup=False,
                                  highlight=False)
    table.print_results(results, console)
    write_json(json_path, results)
    return results
