"""
One flight of a comparison, with its metrics and the samples for the figures.

This runs in a worker, perhaps on another computer, and prints or writes nothing.
"""

from pathlib import Path
import platform
import time
import warnings

import numpy as np

from beetle_omni_ros.comparison.fingerprint import code_fingerprint
from beetle_omni_ros.comparison.plan import Flight
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.evaluation.command import fly
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.runs.body import errors, motion
from beetle_omni_ros.runs.log import FlightLog
from beetle_omni_ros.runs.metrics import metrics
from beetle_omni_ros.runs.tasks import Task

TRACE_PERIOD = 0.02  # [s] between samples of a trace
LONG_TRACE_PERIOD = 0.05  # [s] between samples in a long task
LONG = 300.0  # [s] shortest duration of a long task
COMMAND_WINDOW = 2.0  # [s] of commands kept at the end of a flight


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
    every = LONG_TRACE_PERIOD if task.duration > LONG else TRACE_PERIOD
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
