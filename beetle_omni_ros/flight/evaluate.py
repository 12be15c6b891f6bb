"""`beetle_omni evaluate`: flies tasks in one process with one or several controllers."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, contextmanager, ExitStack
from pathlib import Path
import signal
import threading
from time import time
from types import MappingProxyType

from rich.console import Console
from rich.progress import Progress

from beetle_omni_ros import __version__
from beetle_omni_ros.bags.log import FlightLog, LogRecorder, Recorder
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.bags.topics import topics_with
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Controller, guidance_of, reach_of
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.control.targets import check_steps
from beetle_omni_ros.control.tasks import make_task, Task
from beetle_omni_ros.flight.component import made
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.show import table
from beetle_omni_ros.show.page import print_end
from beetle_omni_ros.sim.faults import Fault, load_faults


def prepared(controller: str, *, robot: RobotParameters, plant: RobotParameters,
             conditions: str = 'nominal', seed: int = 0,
             options: Mapping[str, ControllerOptions] = MappingProxyType({}),
             built: Controller | None = None, pilot: bool = False, bag: Path | None = None,
             meta: dict | None = None, faults: Sequence[Fault] = (), actuators: str = 'direct',
             components: Sequence[str] = ()) -> FlightLoop:
    """
    Return a robot on the ground with its flight stack; close it after the flight.

    ``controller`` is a name or a reference to a class, ``built`` that one. With ``pilot`` the
    controller is aboard that lands a robot with a lost actuator. The flight is recorded in memory
    with ``meta``, and in a new folder ``bag``. Other arguments are those of :func:`run_evaluate`.

    """
    entry = registry.find(controller)
    flying = built or entry.make(robot, options.get(entry.reference, ControllerOptions()))
    aboard = {entry.name: flying}
    if pilot:
        other = registry.find(registry.pilot())
        aboard.setdefault(other.name, flying if other == entry else other.make(
            robot, options.get(other.reference, ControllerOptions())))
    meta = {**(meta or {}), 'controller': entry.name, 'guidance': guidance_of(flying)}
    memory = LogRecorder(meta)
    kind: type[FlightLoop] = FlightLoop
    if actuators == 'emulated':
        from beetle_omni_ros.flight.bridges import EmulatedLoop  # has serial ports
        kind = EmulatedLoop
    with ExitStack() as stack:
        others = made(components, robot)    # before the bag, which a mistake would leave behind
        recorders: list[Recorder] = [memory]
        if bag is not None:
            from beetle_omni_ros.bags.bag_writer import BagWriter
            recorders.append(stack.enter_context(BagWriter(
                bag, meta=meta, topics=tuple(topics_with([entry.name])), frames=True)))
        loop = kind(robot, plant, aboard, Recorder(*recorders), conditions=conditions, seed=seed,
                    faults=faults, epoch=int(time()), others=others)
        loop.recording = memory.log
        stack.pop_all()     # the loop closes its recorder
    return loop


def fly(controller: str, task: Task, *, robot: RobotParameters,
        options: Mapping[str, ControllerOptions] = MappingProxyType({}),
        built: Controller | None = None, faults: Sequence[Fault] = (),
        progress: Callable[..., None] | None = None, **given) -> FlightLog:
    """
    Fly one task with one controller; arguments as of :func:`prepared`.

    The flight is returned after a crash, too (``meta['crashed']``), or an interruption by
    ``progress`` (``meta['interrupted']``).

    Raises:
        ParameterError: a pose of the task is beyond the controller's reach.

    """
    entry = registry.find(controller)
    built = built or entry.make(robot, options.get(entry.reference, ControllerOptions()))
    if task.kind == 'poses':
        check_steps(task.poses, reach_of(built), lambda k: f"task '{task.name}': pose {k + 1}")
    with interruptible() as interrupts, closing(prepared(
            controller, robot=robot, options=options, built=built, pilot=bool(faults),
            faults=faults, **given)) as loop:
        loop.fly(task, progress or (lambda completed: interrupts))
        if interrupts:
            raise KeyboardInterrupt
        return loop.recording()


@contextmanager
def interruptible():
    """Yield a list that Ctrl-C fills, so that no record is cut; the second one interrupts."""
    interrupts: list[int] = []

    def interrupt(number, _):
        if interrupts:
            raise KeyboardInterrupt
        interrupts.append(number)

    with ExitStack() as stack:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler \
                and threading.current_thread() is threading.main_thread():
            stack.callback(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, interrupt))
        yield interrupts


def run_evaluate(*, controllers: list[str], task: str | Task, conditions: str = 'nominal',
                 robot: Path | None = None, plant: Path | None = None, seed: int = 0,
                 bag: Path | None = None, json_path: Path | None = None,
                 options: Mapping[str, ControllerOptions] = MappingProxyType({}),
                 faults: Path | None = None, actuators: str = 'direct',
                 components: Sequence[str] = (), full: bool = False,
                 console: Console | None = None) -> dict:
    """
    Fly a task with each controller and report; arguments as of `beetle_omni evaluate`.

    ``options`` are files in place of a controller's own. With several controllers, ``bag``
    contains one bag for each. Returned are ``meta`` and a key for each controller, as
    `--json` writes them. A ParameterError reports unusable input. A KeyboardInterrupt comes after
    the results of what was flown.
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
            'plant': str(plant) if plant else None, 'version': __version__,
            **({'actuators': actuators} if actuators != 'direct' else {})}
    for given in options.values():
        if given.policy:
            meta['policy'] = str(given.policy)
    if others := {entry.name: entry.spec for entry in built if entry.spec}:
        meta['controllers'] = others
    if injected:
        meta['faults'] = [str(fault) for fault in injected]
    results: dict = {'meta': meta}
    with Progress(console=console, transient=True) as bars, interruptible() as interrupts:
        for entry, controller in built.items():
            name = entry.name
            bar = bars.add_task(f'{name}: {task.name}, {conditions}', total=1.0)
            log = fly(entry.reference, task, robot=believed, plant=true, conditions=conditions,
                      seed=seed, options=options, built=controller,
                      bag=bag / name if bag and len(built) > 1 else bag, meta=meta,
                      faults=injected, actuators=actuators, components=components,
                      progress=lambda completed, bar=bar: bars.update(
                          bar, completed=completed) or interrupts)
            results[name] = metrics(log, task)
            if error := log.meta['controller_error']:
                console.print(f'{name}: {error}', style='yellow', markup=False, highlight=False)
            if interrupts:
                meta['interrupted'] = True
                break
    table.print_results(results, console, full=full)
    write_json(json_path, results)
    if interrupts:
        console.print(f"interrupted; kept {'what was flown' if bag else 'the table above'}")
    bags = [bag / name if len(built) > 1 else bag for name in results if bag and name != 'meta']
    print_end(console, [*bags, json_path],
              *([('report', *bags), ('view', *bags)] if bags else ()))
    if interrupts:
        raise KeyboardInterrupt
    return results
