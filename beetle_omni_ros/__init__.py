"""
Flight stack and controller comparison for an overactuated tiltable quadrotor.

The functions for notebooks. Imports are delayed until a function is called::

    import beetle_omni_ros as bo

    robot = bo.robot()                                    # parameters, from a file or shipped
    log = bo.simulate('nmpc', [[0, 0, 1, 90, 0, 0]])      # a flight as numpy arrays
    log.metrics(), log.plot(), log.to_pandas(), log.report('flight.html')
    loop = bo.simulation('nmpc')                          # a robot in the air, to be stepped
    table = bo.evaluate([MyController, 'rl'], 'waypoints')      # metrics, and a table in print
    log = bo.read_run('runs_out/flight')                  # a recorded bag as numpy arrays
    found = bo.find_gap(['flight1', 'flight2'])           # effects that the model lacks

The folder examples/ contains short examples and a notebook.
"""

from __future__ import annotations

TYPE_CHECKING = False       # typing and pathlib would delay the start of every program
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from typing import Any

    from beetle_omni_ros.flight.loop import FlightLoop
    from beetle_omni_ros.model.parameters import RobotParameters
    from beetle_omni_ros.show.report import NotebookLog

__version__ = '0.1.0'
__all__ = ['evaluate', 'find_gap', 'read_run', 'robot', 'simulate', 'simulation', 'trajectory']


def robot(file: str | Path | None = None) -> RobotParameters:
    """
    Read a robot file, by default the shipped params/robot.yaml.

    ``dataclasses.replace`` derives another robot from the result,
    :class:`~beetle_omni_ros.model.parameters.RobotParameters`.
    """
    from beetle_omni_ros.model.parameters import RobotParameters
    return RobotParameters.load(file)


def simulate(controller: str | Callable = 'nmpc', task: Any = 'waypoints', *,
             robot: RobotParameters | str | Path | None = None,
             plant: RobotParameters | str | Path | None = None, conditions: str = 'nominal',
             seed: int = 0, bag: str | Path | None = None) -> NotebookLog:
    """
    Fly a task in this process, as `beetle_omni evaluate` does.

    Args:
        controller: a registered name, 'package.module:Class', or a class
            (docs/how-to/own_controller.md).
        task: a name as on the command line, a pose file, poses (N, 6) of x, y, z [m], roll, pitch,
            yaw [deg], or a result of :func:`trajectory`.
        robot: model of estimator and controller: parameters or a file; None: the shipped file.
        plant: model of the simulated plant; None: as ``robot``.
        conditions: 'nominal' or 'published'.
        seed: of everything random.
        bag: new folder to record a bag in.

    Returns:
        The flight, with times from 0 and the methods ``metrics``, ``plot``, ``to_pandas`` and
        ``report``; ``log.meta['crashed']`` is true if the robot touched the ground.

    Raises:
        ParameterError, RunError: with a message of one line.

    """
    from beetle_omni_ros.flight.evaluate import fly
    from beetle_omni_ros.show.report import NotebookLog
    believed, flown = _robot(robot), _task(task, seed)
    given = robot is None or robot is believed
    log = fly(_reference(controller), flown, robot=believed,
              plant=believed if plant is None else _robot(plant), conditions=conditions,
              seed=seed, bag=_path(bag), meta={
                  'task': flown.name, 'conditions': conditions, 'seed': seed,
                  'robot': 'params/robot.yaml' if given else str(robot), 'version': __version__})
    log.source = str(bag or '')
    return NotebookLog.of(log, flown)


def simulation(controller: str | Callable = 'nmpc', *,
               robot: RobotParameters | str | Path | None = None,
               plant: RobotParameters | str | Path | None = None, conditions: str = 'nominal',
               seed: int = 0) -> FlightLoop:
    """
    Return a robot in the air with its flight stack, which the caller steps.

    ``aim(target)`` publishes a target, ``step()`` simulates 5 ms, ``request('land')`` asks the
    supervisor, ``add(component)`` connects another component. ``simulator.truth`` is the true
    state, ``recording()`` the flight so far. Arguments are those of :func:`simulate`.

    Raises:
        ParameterError, RunError: no take-off, with a message of one line.

    """
    from beetle_omni_ros.flight.evaluate import prepared
    from beetle_omni_ros.show.report import NotebookLog
    believed = _robot(robot)
    loop = prepared(_reference(controller), robot=believed, conditions=conditions, seed=seed,
                    plant=believed if plant is None else _robot(plant))
    recording = loop.recording
    loop.recording = lambda: NotebookLog.of(recording())
    loop.take_off()
    return loop


def evaluate(controllers: str | Callable | Sequence[str | Callable], task: Any = 'waypoints', *,
             robot: str | Path | None = None, plant: str | Path | None = None,
             conditions: str = 'nominal', seed: int = 0, bag: str | Path | None = None,
             quiet: bool = False) -> dict:
    """
    Fly a task with each controller and compute metrics, as `beetle_omni evaluate` does.

    Arguments are as in :func:`simulate`, but ``robot`` and ``plant`` are files. With several
    controllers ``bag`` contains one bag for each. ``quiet`` prints no table.

    Returns:
        The content of `evaluate --json`: ``meta``, and a key for each controller's name.

    """
    from rich.console import Console

    from beetle_omni_ros.flight.evaluate import run_evaluate
    several = [controllers] if isinstance(controllers, str) or callable(controllers) \
        else controllers
    return run_evaluate(
        controllers=[_reference(one) for one in several], task=_task(task, seed),
        conditions=conditions, seed=seed, bag=_path(bag), robot=_path(robot), plant=_path(plant),
        console=Console(quiet=quiet))


def read_run(path: str | Path) -> NotebookLog:
    """
    Read a recorded bag, a rosbag2 folder or one of its files, into numpy arrays.

    The flight is as that of :func:`simulate`; its ``warnings`` list missing topics and damage. A
    ParameterError of one line refuses a file that is no bag, and lists the runs in a folder.
    """
    from beetle_omni_ros.bags.bag import read_bag
    from beetle_omni_ros.show.report import NotebookLog
    return NotebookLog.of(read_bag(path))


def find_gap(runs: Sequence[str | Path], holdout: Sequence[str | Path] = (), *,
             robot: str | Path | None = None, apply: str | Path | None = None,
             report: str | Path | None = None, form: str | None = None,
             quiet: bool = False) -> dict:
    """
    Identify effects that the robot model lacks, as `beetle_omni gap` does.

    Args:
        runs: bags for the fit, or tables with ``form``.
        holdout: flights for validation; by default the last of three bags or more.
        robot: robot file with which the flights are compared.
        apply: robot file to write, with the named effects.
        report: HTML page to write.
        form: name or file of the format of tables.
        quiet: print nothing.

    Returns:
        The content of `gap --json`: ``verdict``, ``effects``, ``closure`` and further keys.

    """
    from rich.console import Console

    from beetle_omni_ros.identify.flights.command import gap_results
    return gap_results(list(map(_path, runs)), list(map(_path, holdout)), _path(robot),
                       _path(apply), None, _path(report), Console(quiet=quiet), form=form)


def trajectory(times, positions, quaternions, name: str = 'own trajectory'):
    """
    Make a task from a trajectory: 8 s at its first pose, then the complete trajectory.

    Args:
        times: (N,) increasing, from 0 [s].
        positions: (N, 3) in world [m].
        quaternions: (N, 4) body to world (x, y, z, w).
        name: in result tables.

    """
    from beetle_omni_ros.control.tasks import trajectory_task
    return trajectory_task(name, times, positions, quaternions)


def _path(given):
    from pathlib import Path
    return None if given is None else Path(given)


def _reference(controller):
    from beetle_omni_ros.control import registry
    return controller if isinstance(controller, str) else registry.add(controller).name


def _robot(given):
    from beetle_omni_ros.model.parameters import RobotParameters
    return given if isinstance(given, RobotParameters) else RobotParameters.load(given)


def _task(given, seed):
    from pathlib import Path

    from beetle_omni_ros.control.tasks import make_task, poses_task, Task
    if isinstance(given, Task):
        return given
    return make_task(given, seed) if isinstance(given, (str, Path)) else \
        poses_task('own poses', given)
