"""Whether this computer can fly a graph in real time, measured before its start."""

from contextlib import suppress
import os
from pathlib import Path
from statistics import median
import time

from beetle_omni_ros.bags.log import Recorder
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.flight.component import made
from beetle_omni_ros.flight.loop import collector_off, FlightLoop
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.ros.graph import CONTROLLER, NODES, Parameters
from beetle_omni_ros.ros.runner import REAL_TIME_PRIORITY

# Time of the graph's process, in times of the loop: messages and callbacks in Python. Measured
# by benchmarks/graph.py, see docs/results/ros_graph.md.
GRAPH = 4.0
MOST = 0.95         # of a core that the graph's process may need
CORES = 2           # one for the graph, one for bridges, operator, viewer and browser
WINDOW, WINDOWS = 0.25, 7   # [s] of simulated time; the median of the windows counts


def too_slow(nodes: Parameters, robot: Path | None) -> tuple[float, str]:
    """
    Return the share of a core that a graph in real time needs, and why it is too much, or ''.

    The controllers, the estimator, the supervisor and the simulator of ``nodes`` fly in the loop
    for a moment, with the priority of the graph. A ParameterError reports an unusable controller.
    """
    share = GRAPH * _time_of_loop(_loop(nodes, RobotParameters.load(robot)))
    cores = len(os.sched_getaffinity(0))
    if cores < CORES:
        return share, f'real time needs {CORES} cores, this computer has {cores}'
    if share > MOST:
        return share, ('this computer is too slow for real time: the flight needs '
                       f'{100 * share:.0f} % of a core, expected at most {100 * MOST:.0f} %')
    return share, ''


def _loop(nodes, robot):
    """The nodes' flight in one process."""
    aboard, components = {}, []
    for name, values in nodes.items():
        if 'component' in values:
            components.append(values['component'])
        elif NODES.get(name, CONTROLLER) == CONTROLLER:
            entry = registry.find(values.get('controller') or name.removesuffix('_node'))
            aboard[entry.name] = entry.make(robot, ControllerOptions(
                parameters=values.get(f'{entry.name}_file'), policy=values.get('policy')))
    return FlightLoop(robot, robot, aboard, Recorder(), others=made(components, robot))


def _time_of_loop(loop):
    """Time of a simulated second in flight, at real-time priority if the system permits it."""
    times, before = [], (os.sched_getscheduler(0), os.sched_getparam(0))
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(REAL_TIME_PRIORITY))
    try:
        with collector_off():
            with suppress(RunError):    # the graph reports it
                loop.take_off()
            for _ in range(WINDOWS):
                begin = time.perf_counter()
                loop.run(WINDOW)
                times.append(time.perf_counter() - begin)
    finally:
        os.sched_setscheduler(0, *before)
    return median(times) / WINDOW
