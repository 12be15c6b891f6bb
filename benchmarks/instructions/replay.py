"""
Steps of both controllers from a recorded flight, with marks for the counting plugin.

    python benchmarks/instructions/replay.py record FILE [--poses N]   # here
    python benchmarks/instructions/replay.py replay FILE               # under qemu
"""

from __future__ import annotations

import argparse
import os
import pickle

from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.robot.parameters import RobotParameters

MARK = 0x6d000000
NMPC, POLICY, INFERENCE = 2, 4, 6       # marks at the begin; one more at the end


class Kept:
    """A controller that records its inputs."""

    def __init__(self, controller, inputs):
        self.controller, self.name, self.period = controller, controller.name, controller.period
        self._inputs = inputs

    def reset(self):
        """Pass on."""
        self.controller.reset()

    def step(self, state, target):
        """Record the inputs and step."""
        self._inputs.append((state, target))
        return self.controller.step(state, target)

    def diagnostics(self):
        """Pass on."""
        return self.controller.diagnostics()


def record(poses: int) -> list:
    """Record the inputs of a flight to random poses."""
    from beetle_omni_ros.control.hover import HoverController
    from beetle_omni_ros.estimation.ekf import ErrorStateEkf
    from beetle_omni_ros.estimation.parameters import EkfParameters
    from beetle_omni_ros.evaluation.loop import FlightLoop
    from beetle_omni_ros.runs.recorder import LogRecorder
    from beetle_omni_ros.runs.tasks import make_task
    from beetle_omni_ros.safety.parameters import SupervisorParameters
    from beetle_omni_ros.safety.supervisor import Supervisor
    from beetle_omni_ros.sim.simulator import Simulator
    robot, estimator, inputs = RobotParameters.load(), EkfParameters.load(), []
    supervisor = Supervisor(SupervisorParameters.load(), robot, HoverController(robot), ('nmpc',))
    FlightLoop(Simulator(robot, seed=0), ErrorStateEkf(estimator, robot.gravity),
               {'nmpc': Kept(NmpcController(robot), inputs)}, supervisor, LogRecorder(),
               estimator.imu.gyroscope_noise).fly(make_task(f'random{poses}', 0))
    return inputs


def mark(number: int) -> None:
    """Mark for the plugin: close a descriptor that does not exist."""
    try:
        os.close(MARK + number)
    except OSError:
        pass


class MarkedPolicy(PolicyController):
    """A policy with marks around its inference."""

    def infer(self, state, reference):
        """Infer, with marks."""
        mark(INFERENCE)
        result = super().infer(state, reference)
        mark(INFERENCE + 1)
        return result


def replay(inputs: list) -> None:
    """Step both controllers with the same inputs."""
    robot = RobotParameters.load()
    for controller, number in ((NmpcController(robot), NMPC),
                               (MarkedPolicy(robot, PolicyParameters.load()), POLICY)):
        controller.reset()
        for state, target in inputs:
            mark(number)
            controller.step(state, target)
            mark(number + 1)
        print(controller.name, controller.diagnostics().get('solver', ''), flush=True)


def main():
    """Record or replay."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('what', choices=['record', 'replay'])
    parser.add_argument('file')
    parser.add_argument('--poses', type=int, default=2)
    parser.add_argument('--steps', type=int, help='to replay; default: all')
    given = parser.parse_args()
    if given.what == 'record':
        with open(given.file, 'wb') as file:
            pickle.dump(record(given.poses), file)
    else:
        with open(given.file, 'rb') as file:
            replay(pickle.load(file)[:given.steps])


if __name__ == '__main__':
    main()
