"""
Cost of one step of the policy, side by side with the NMPC's, on one core.

    python benchmarks/policy.py [--poses 20] [--seed 0] [--policy FILE] [--json FILE]

The NMPC flies random poses in process, with the policy on standby. Both get the same states. The
rest of the flight (plant, sensors, estimator, supervisor) runs between two steps, so that caches
are as cold as on board. `step` is all work for one command. `inference` is the network's part of
it; the remainder is guidance, observation, limits and, with memory, the disturbance estimate.
Times are CPU times, because wall time on a shared computer includes other programs. They also grow
while other programs use shared caches. The last lines therefore state the share of poses within
the limits and the times of the fastest pose.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
import json
import os
from pathlib import Path
import sys
from time import thread_time

import numpy as np
from rich.console import Console
from rich.table import Table

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

TARGETS = {'median': 0.1, 'p99': 0.2}   # [ms] of inference


class TimedNetwork:
    """The network of a policy, with the CPU ``times`` [s] of its calls."""

    def __init__(self, network):
        self._network = network
        self.times: list[float] = []

    def __call__(self, observation):
        """Action of an observation."""
        began = thread_time()
        action = self._network(observation)
        self.times.append(thread_time() - began)
        return action


def compute_summary(times: Sequence[float], period: float) -> dict[str, float | int]:
    """Median, 99th percentile, maximum [ms], misses of ``period`` and number of ``times`` [s]."""
    used = 1e3 * np.array(times or [0.0])
    median, p99 = np.percentile(used, [50, 99]).tolist()
    return {'median': median, 'p99': p99, 'max': float(used.max()),
            'deadline_misses': int(np.sum(used > 1e3 * period)), 'count': len(times)}


def measure(parameters: PolicyParameters, poses: int, seed: int) -> tuple[dict, PolicyController]:
    """Fly; return the times of the steps by controller, and the policy."""
    robot, recorder = RobotParameters.load(), LogRecorder()
    policy = PolicyController(robot, parameters)
    policy.network = TimedNetwork(policy.network)
    flight = FlightLoop(robot, robot, {'nmpc': NmpcController(robot), 'rl': policy}, recorder,
                        seed=seed)
    flight.fly(make_task(f'random{poses}', seed))
    return recorder.log().compute, policy


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
        steps, policy = measure(parameters, given.poses, given.seed)
    except ParameterError as error:
        print(f'benchmarks/policy.py: error: {error}', file=sys.stderr)
        sys.exit(2)
    table = Table('', 'steps', 'median', 'p99', 'max', title=f'{policy.contract.name}, '
                  f'{policy.contract.observation_size} inputs, {parameters.policy}; '
                  f'{given.poses} random poses, seed {given.seed}: CPU [ms]')
    inference = compute_summary(policy.network.times, policy.period)
    results = {**{f'{name}: step': numbers for name, numbers in steps.items()},
               'rl: inference': inference}
    for name, numbers in results.items():
        table.add_row(name, f"{numbers['count']:.0f}", *(
            f'{numbers[key]:.3f}' for key in ('median', 'p99', 'max')))
    Console(width=120).print(table)
    poses = [compute_summary(list(part), policy.period)
             for part in np.array_split(policy.network.times, given.poses)]
    quietest = min(poses, key=lambda numbers: numbers['p99'])
    met = within(inference)
    print('target of inference: '
          + ', '.join(f'{key} {limit:g} ms' for key, limit in TARGETS.items())
          + (': met' if met else ': missed') + f' by all steps, met by those of '
          f'{sum(map(within, poses))} of {given.poses} poses; the quietest pose: '
          f'median {quietest["median"]:.3f}, p99 {quietest["p99"]:.3f} ms')
    if given.json:
        inference['poses'] = poses
        given.json.write_text(json.dumps(results, indent=1) + '\n')
    sys.exit(0 if met else 1)


if __name__ == '__main__':
    main()
