"""
Cost of one NMPC cycle: CPU time, QP status, iterations; compiled and interpreted.

    python benchmarks/nmpc.py [--poses 100] [--seed 0] [--nmpc FILE]

Flies random poses in process (plant, sensors, estimator and supervisor included) and
prints the CPU time of everything the controller does for one command. Medians and
percentiles are of CPU time, because wall time on a shared computer includes other programs;
wall time is printed too.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.estimation.ekf import ErrorStateEkf
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import bind, load_yaml
from beetle_omni_ros.runs.recorder import LogRecorder
from beetle_omni_ros.runs.tasks import make_task
from beetle_omni_ros.safety.parameters import SupervisorParameters
from beetle_omni_ros.safety.supervisor import Supervisor
from beetle_omni_ros.sim.simulator import Simulator


class Watched:
    """A controller with wall time and iterations of its steps."""

    def __init__(self, controller):
        self.controller, self.name, self.period = controller, controller.name, controller.period
        self.cpu, self.wall, self.iterations = [], [], []

    def reset(self):
        """Pass on."""
        self.controller.reset()

    def step(self, state, target):
        """Step, timed."""
        cpu, wall = time.thread_time(), time.perf_counter()
        command = self.controller.step(state, target)
        self.cpu.append(time.thread_time() - cpu)
        self.wall.append(time.perf_counter() - wall)
        self.iterations.append(self.controller.diagnostics()['iterations'])
        return command

    def diagnostics(self):
        """Pass on."""
        return self.controller.diagnostics()


def measure(parameters: NmpcParameters, poses: int, seed: int) -> Watched:
    """Fly ``poses`` random poses and return the watched controller."""
    robot, estimator = RobotParameters.load(), EkfParameters.load()
    watched = Watched(NmpcController(robot, parameters))
    supervisor = Supervisor(SupervisorParameters.load(), robot, HoverController(robot), ('nmpc',))
    flight = FlightLoop(Simulator(robot, seed=seed), ErrorStateEkf(estimator, robot.gravity),
                        {'nmpc': watched}, supervisor, LogRecorder(),
                        estimator.imu.gyroscope_noise)
    flight.fly(make_task(f'random{poses}', seed))
    return watched


def row(name: str, watched: Watched) -> list[str]:
    """One line of the table."""
    cpu, wall = 1e3 * np.array(watched.cpu), 1e3 * np.array(watched.wall)
    counts = watched.diagnostics()
    solved = 100 * (1 - counts['unsolved'] / max(1, counts['steps']))
    return [name, str(len(cpu)), *(f'{value:.2f}' for value in (
        np.median(cpu), np.percentile(cpu, 99), cpu.max(), np.median(wall),
        np.percentile(wall, 99))), str(int((cpu > 1e3 * watched.period).sum())),
        f'{solved:.3f}', f'{np.mean(watched.iterations):.1f}']


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--poses', type=int, default=100)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--nmpc', type=Path, default=share_path('params/nmpc.yaml'))
    given = parser.parse_args()
    table = Table(title=f'NMPC, {given.poses} random poses, seed {given.seed}: ms for one cycle')
    for column in ('solver', 'cycles', 'CPU median', 'CPU p99', 'CPU max', 'wall median',
                   'wall p99', 'over 10 ms', 'solved %', 'iterations'):
        table.add_column(column, justify='right')
    content = load_yaml(given.nmpc)
    for name, compiled, poses in (('compiled', True, given.poses),
                                  ('interpreted', False, max(1, given.poses // 10))):
        content.setdefault('solver', {})['compile'] = compiled
        parameters = bind(NmpcParameters, content, str(given.nmpc))
        table.add_row(*row(name, measure(parameters, poses, given.seed)))
    Console(width=120).print(table)


if __name__ == '__main__':
    main()
