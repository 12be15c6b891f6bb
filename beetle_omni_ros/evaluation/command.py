"""`beetle_omni evaluate`: tasks flown in process, for one or several controllers."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from beetle_omni_ros import __version__
from beetle_omni_ros.control.base import Controller
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.control.reach import reach_of_name
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs import metrics as metrics_of_runs
from beetle_omni_ros.runs import table
from beetle_omni_ros.runs.bag import BagWriter
from beetle_omni_ros.runs.json_file import write_json
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.pose_file import check_steps
from beetle_omni_ros.runs.recorder import LogRecorder, Tee
from beetle_omni_ros.runs.target_checks import TargetChecks
from beetle_omni_ros.runs.tasks import make_task, Task
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import PILOT, Supervisor
from beetle_omni_ros.sim.faults import Fault
from beetle_omni_ros.sim.faults.listed import load_faults
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Simulator

CONTROLLERS = ('nmpc', 'rl', 'rl_memory', 'nmpc_published', 'hover')
POLICIES = {'rl': 'policies/rl.onnx', 'rl_memory': 'policies/rl_memory.onnx'}


@dataclass(frozen=True, kw_only=True)
class ControllerFiles:
    """
    Files in place of the shipped ones.

    Attributes:
        nmpc: parameters of 'nmpc'.
        policy: network of 'rl'.
        allow_other_robot: fly policies that were trained for other robot parameters.

    """

    nmpc: Path | None = None
    policy: Path | None = None
    allow_other_robot: bool = False


def make_controller(name: str, robot: RobotParameters,
                    files: ControllerFiles = ControllerFiles()) -> Controller:
    """
    Build a controller by name.

    Args:
        name: 'nmpc', 'nmpc_published' (the publication's settings), 'rl', 'rl_memory' (with
            the estimated disturbance) or 'hover'.
        robot: what it believes about the robot.
        files: in place of the shipped ones.

    Raises:
        ParameterError: unknown name, or an unusable file.

    """
    if name == 'nmpc':
        return NmpcController(robot, NmpcParameters.load(files.nmpc))
    if name == 'nmpc_published':
        return NmpcController(robot, NmpcParameters.load(share_path('params/nmpc_published.yaml')))
    if name in POLICIES:
        policy = files.policy if name == 'rl' and files.policy else POLICIES[name]
        parameters = PolicyParameters.load()
        return PolicyController(robot, replace(
            parameters, policy=str(policy),
            allow_other_robot=parameters.allow_other_robot or files.allow_other_robot))
    if name == 'hover':
        return HoverController(robot)
    raise ParameterError(f"controller '{name}': expected one of {', '.join(CONTROLLERS)}")


def fly(controller: str, task: Task, *, robot: RobotParameters, plant: RobotParameters,
        conditions: str = 'nominal', seed: int = 0, files: ControllerFiles = ControllerFiles(),
        bag: Path | None = None, meta: dict | None = None, faults: Sequence[Fault] = (),
        progress=lambda part: None) -> FlightLog:
    """
    Fly one task with one controller; see :func:`run_evaluate` for the arguments.

    Returns:
        the flight, also when the robot crashed (``meta['crashed']``).

    Raises:
        TaskError: a pose of the task is beyond the controller's reach.

    """
    if task.kind == 'poses':
        check_steps(task.poses, reach_of_name(controller, files.nmpc),
                    lambda k: f"task '{task.name}': pose {k + 1}")
    meta = dict(meta or {}, controller=controller)
    memory = LogRecorder(meta)
    with ExitStack() as stack:
        recorder = memory
        if bag is not None:
            writer = stack.enter_context(BagWriter(bag, meta=meta))
            recorder = Tee(memory, writer)
        estimator = EkfParameters.load()
        supervisor = Supervisor(SupervisorParameters.load(), robot, HoverController(robot),
                                CONTROLLERS)
        simulator = Simulator(plant, SimulatorParameters.load(), conditions=conditions, seed=seed)
        # With a lost actuator the NMPC lands the robot, whoever flew it.
        aboard = dict.fromkeys([controller, PILOT] if faults else [controller])
        loop = FlightLoop(
            simulator,
            ErrorStateEkf(estimator, robot.gravity),
            {name: make_controller(name, robot, files) for name in aboard}, supervisor, recorder,
            estimator.imu.gyroscope_noise, faults, TargetChecks(robot).why_not)
        supervisor.select(controller)
        stayed = loop.fly(task, progress)
        recorder.write_meta({'crashed': not stayed, 'ended': loop.ending,
                             'broken': simulator.broken})
        if simulator.truth.impact is not None:
            recorder.write_meta({'impact': asdict(simulator.truth.impact)})
    return memory.log()


def run_evaluate(*, controllers: list[str], task: str, conditions: str = 'nominal',
                 robot: Path | None = None, plant: Path | None = None, seed: int = 0,
                 bag: Path | None = None, json_path: Path | None = None,
                 files: ControllerFiles = ControllerFiles(), faults: Path | None = None,
                 console: Console | None = None) -> dict:
    """
    Fly a task with each controller and report.

    Args:
        controllers: names, see :func:`make_controller`.
        task: name or pose file.
        conditions: 'nominal' or 'published'.
        robot: file that estimator and controllers believe; default the shipped one.
        plant: file that is true in the simulation; default ``robot``.
        seed: of the task's poses and of everything random in the simulation.
        bag: folder for a bag; with several controllers, one bag for each inside it.
        json_path: file for the results.
        files: of controllers, in place of the shipped ones.
        faults: file of what fails, when since the task's start and how long; by default nothing.
        console: where to print.

    Returns:
        the results as in INTERFACES: ``meta`` and a key for each controller.

    Raises:
        ParameterError, TaskError, BagError: unusable input, in one line.

    """
    console = console or Console()
    believed = RobotParameters.load(robot)
    true = RobotParameters.load(plant) if plant else believed
    flown = make_task(task, seed, min(reach_of_name(name, files.nmpc) for name in controllers))
    for name in controllers:
        if name not in CONTROLLERS or name in POLICIES:     # refused before anything flies
            make_controller(name, believed, files)
    meta = {'task': task, 'conditions': conditions, 'seed': seed,
            'robot': str(robot) if robot else 'params/robot.yaml',
            'plant': str(plant) if plant else None, 'version': __version__}
    if files.policy:
        meta['policy'] = str(files.policy)
    struck = load_faults(faults) if faults else []
    if struck:
        meta['faults'] = [str(fault) for fault in struck]
    results: dict = {'meta': meta}
    columns = (TextColumn('{task.description}'), BarColumn(),
               TextColumn('{task.percentage:>3.0f} %'), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bars:
        for name in controllers:
            bar = bars.add_task(f'{name}: {task}, {conditions}', total=1.0)
            folder = bag / name if bag and len(controllers) > 1 else bag
            log = fly(name, flown, robot=believed, plant=true, conditions=conditions, seed=seed,
                      files=files, bag=folder, meta=meta, faults=struck,
                      progress=lambda part, bar=bar: bars.update(bar, completed=part))
            results[name] = metrics_of_runs.metrics(log, flown)
            if log.meta['ended']:
                console.print(f'{name}: the flight ended early, {log.meta["ended"]}',
                              style='yellow', highlight=False)
                results[name]['ended'] = log.meta['ended']
    table.print_results(results, console)
    if json_path:
        write_json(json_path, results)
    return results
