"""
Fly a controller of your own: a PD law on the pose, and the package's allocation.

    python examples/own_controller.py [TASK]
    beetle_omni evaluate --controllers examples/own_controller.py:PoseController,nmpc
    beetle_omni fly --controller examples/own_controller.py:PoseController --bag my_flight
"""

import sys

import numpy as np

import beetle_omni_ros
from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import Allocator


class PoseController:
    """Springs and dampers on position and attitude; no integral, no model of the actuators."""

    period = 0.01                                   # [s] between two steps
    KP, KD = 6.0, 4.0                               # position [1/s^2], [1/s]
    KP_TURN, KD_TURN = 25.0, 9.0                    # attitude
    FARTHEST = 0.6                                  # [m], [rad] limit of the errors

    def __init__(self, robot):
        self.robot, self.allocator = robot, Allocator(robot)

    def reset(self):
        """Do nothing, for there is no state."""

    def step(self, state, target):
        """Command: tilts (4,) [rad] and thrusts (4,) [N], stamped with the state it answers."""
        wanted = target.at(state.stamp)
        way = self.shortened(wanted.position - state.position)
        turn = self.shortened(rotations.log(rotations.multiply(
            rotations.conjugate(state.quaternion), wanted.quaternion)))
        acceleration = self.KP * way + self.KD * (wanted.velocity - state.velocity)
        turning = self.KP_TURN * turn - self.KD_TURN * state.angular_velocity
        allocation = self.allocator.hover(
            state.quaternion, state.tilt, self.robot.mass * acceleration,
            self.robot.inertia * turning)
        return Command(state.stamp, allocation.tilt, allocation.thrust)

    def shortened(self, error):
        """Limit the length of an error and keep its direction."""
        return error * min(1.0, self.FARTHEST / max(np.linalg.norm(error), 1e-9))


if __name__ == '__main__':
    task = sys.argv[1] if len(sys.argv) > 1 else 'waypoints'
    beetle_omni_ros.evaluate([PoseController, 'nmpc'], task)
