"""
Cost of one step of the policy, side by side with the NMPC's, on one core.

    python benchmarks/policy.py

The NMPC flies random poses in process, with the policy on standby. Both get the same states. The
rest of the flight (plant, sensors, estimator, supervisor) runs between two steps, so that caches
are as cold as on board. `step` is all work for one command. `inference` is the network's part of
it; the remainder is guidance, observation, limits and, with memory, the disturbance estimate.
Times are CPU times, because wall time on a shared computer includes other programs. They also grow
while other programs use shared caches.
"""

from collections.abc import Callable
import os
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

TARGETS = {'median': 0.1, 'p99': 0.2}   # [ms] of inference
POSES, SEED = 20, 0


def timed(network: Callable, times: list[float]) -> Callable:
    """A network that adds the CPU time of each call [s] to ``times``."""
    def act(observation):
        began = thread_time()
        action = network(observation)
        times.append(thread_time() - began)
        return action
    return act


def measure(policy: PolicyController, robot: RobotParameters) -> dict:
    """Fly; return the CPU times [ms] of the steps of each controller and of inference."""
    recorder, times = LogRecorder(), list[float]()
    policy.network = timed(policy.network, times)
    flight = FlightLoop(robot, robot, {'nmpc': NmpcController(robot), 'rl': policy}, recorder,
                        seed=SEED)
    flight.fly(make_task(f'random{POSES}', SEED))
    used = 1e3 * np.array(times)
    median, p99 = np.percentile(used, [50, 99])
    return {**{f'{name}: step': found for name, found in recorder.log().compute.items()},
            'rl: inference': {'count': len(used), 'median': median, 'p99': p99,
                              'max': used.max()}}


def main():
    """Measure and print; status 1 if inference is slower than its target."""
    if hasattr(os, 'sched_setaffinity'):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    robot, parameters = RobotParameters.load(), PolicyParameters.load()
    policy = PolicyController(robot, parameters)
    table = Table('', 'steps', 'median', 'p99', 'max', title=f'{policy.contract.name}, '
                  f'{policy.contract.observation_size} inputs, {parameters.policy}; '
                  f'{POSES} random poses, seed {SEED}: CPU [ms]')
    results = measure(policy, robot)
    for name, numbers in results.items():
        table.add_row(name, f"{numbers['count']:.0f}", *(
            f'{numbers[key]:.3f}' for key in ('median', 'p99', 'max')))
    Console(width=120).print(table)
    met = all(results['rl: inference'][key] <= limit for key, limit in TARGETS.items())
    print('target of inference: ' + ', '.join(f'{key} {limit:g} ms' for key, limit in
                                              TARGETS.items()) + (': met' if met else ': missed'))
    sys.exit(0 if met else 1)


if __name__ == '__main__':
    main()
