"""
Cost of one step of the policy, side by side with the NMPC's, on one core.

    python benchmarks/policy.py [--poses 20] [--seed 0] [--policy FILE] [--json FILE]

The NMPC flies random poses in process, with the policy on standby. Both get the same states. The
rest of the flight (plant, sensors, estimator, supervisor) runs between two steps, so that caches
are as cold as on board. `step` is all work for one command. `inference` is its part with the
network: observation, network, limits and, with memory, the disturbance estimate. The remainder is
guidance, which selects the pose target of the policy. Times are CPU times, because wall time on a
shared computer includes other programs; wall time is printed too. CPU time also grows while other
programs use shared caches. The last lines therefore state the share of poses within the limits
and the times of the fastest pose.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import json
import os
from pathlib import Path
import sys
import time

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs.log import LogRecorder
from beetle_omni_ros.runs.tasks import make_task

TARGETS = {'median': 0.1, 'p99': 0.2}   # [ms] of inference with its observation


class Clock:
    """CPU and wall times of calls, by name."""

    def __init__(self):
        self.times: dict[str, list] = {}

    def call(self, name, function, *arguments):
        """Call ``function`` and record its duration."""
        cpu, wall = time.thread_time(), time.perf_counter()
        result = function(*arguments)
        self.times.setdefault(name, []).append(
            (time.thread_time() - cpu, time.perf_counter() - wall))
        return result


class Timed:
    """A controller whose steps are timed."""

    def __init__(self, controller, clock):
        self.controller, self.name, self.period = controller, controller.name, controller.period
        self._clock = clock

    def reset(self):
        """Pass on."""
        self.controller.reset()

    def step(self, state, target):
        """Pass on, timed."""
        return self._clock.call(f'{self.name}: step', self.controller.step, state, target)

    def diagnostics(self):
        """Pass on."""
        return self.controller.diagnostics()


class TimedPolicy(PolicyController):
    """A policy whose inference is timed within its step."""

    def __init__(self, robot, parameters, clock):
        self._clock = clock
        super().__init__(robot, parameters)

    def infer(self, state, reference):
        """Pass on, timed."""
        return self._clock.call(f'{self.name}: inference', super().infer, state, reference)


def measure(parameters: PolicyParameters, poses: int, seed: int) -> tuple[Clock, str]:
    """Fly; return the times and the policy's properties."""
    robot, clock = RobotParameters.load(), Clock()
    policy = TimedPolicy(robot, parameters, clock)
    flight = FlightLoop(robot, robot, {'nmpc': Timed(NmpcController(robot), clock),
                                       'rl': Timed(policy, clock)}, LogRecorder(), seed=seed)
    flight.fly(make_task(f'random{poses}', seed))
    return clock, f'{policy.contract.name}, ' \
                  f'{policy.contract.observation_size} inputs, {parameters.policy}'


def summary(times: list) -> dict[str, float]:
    """Milliseconds of one part."""
    cpu, wall = 1e3 * np.array(times).T
    return {'steps': len(cpu), 'median': float(np.median(cpu)),
            'p99': float(np.percentile(cpu, 99)), 'max': float(cpu.max()),
            'wall_median': float(np.median(wall)), 'wall_p99': float(np.percentile(wall, 99)),
            'cpu_percent': float(cpu.mean() / 10.0 * 100)}     # of one core, at 100 Hz


def within(numbers: dict[str, float]) -> bool:
    """Whether inference meets its target."""
    return all(numbers[key] <= limit for key, limit in TARGETS.items())


def main():
    """Measure and print; status 1 if inference is slower than its target."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--poses', type=int, default=20)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--policy', help='default: the one of params/rl.yaml')
    parser.add_argument('--json', type=Path, help='file for the numbers')
    given = parser.parse_args()
    if hasattr(os, 'sched_setaffinity'):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    parameters = PolicyParameters.load()
    if given.policy:
        parameters = replace(parameters, policy=str(Path(given.policy).absolute()))
    try:
        clock, what = measure(parameters, given.poses, given.seed)
    except ParameterError as error:
        print(f'benchmarks/policy.py: error: {error}', file=sys.stderr)
        sys.exit(2)
    table = Table(title=f'{what}; {given.poses} random poses, seed {given.seed}: CPU [ms]')
    for column in ('', 'steps', 'median', 'p99', 'max', 'wall median', 'wall p99',
                   '% of a core at 100 Hz'):
        table.add_column(column, justify='right' if column else 'left')
    results = {name: summary(times) for name, times in sorted(
        clock.times.items(), key=lambda item: (item[0].startswith('nmpc'), ))}
    for name, numbers in results.items():
        table.add_row(name, *(f'{value:.3f}' if key not in ('steps', 'cpu_percent')
                              else f'{value:.1f}'.removesuffix('.0')
                              for key, value in numbers.items()))
    Console(width=120).print(table)
    name = next(name for name in results if name.endswith('inference'))
    poses = [summary(part) for part in np.array_split(clock.times[name], given.poses)]
    quietest = min(poses, key=lambda numbers: numbers['p99'])
    met = within(results[name])
    print('target of inference: '
          + ', '.join(f'{key} {limit:g} ms' for key, limit in TARGETS.items())
          + (': met' if met else ': missed') + f' by all steps, met by those of '
          f'{sum(map(within, poses))} of {given.poses} poses; the quietest pose: '
          f'median {quietest["median"]:.3f}, p99 {quietest["p99"]:.3f} ms')
    if given.json:
        results[name]['poses'] = poses
        given.json.write_text(json.dumps(results, indent=1) + '\n')
    sys.exit(0 if met else 1)


if __name__ == '__main__':
    main()
