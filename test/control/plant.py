"""A small rigid-body plant with rotor lag, servo lag and command delay, for closed-loop tests."""

from collections import deque

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator

STEP = 0.001
DELAY = 0.010


class Plant:
    """Semi-implicit Euler at 1 kHz; the actuators see a command DELAY after it is given."""

    def __init__(self, robot, position, quaternion, tilt, mass_scale=1.0, torque_body=0.0):
        self.robot, self.allocator = robot, Allocator(robot)
        self.position = np.array(position, dtype=float)
        self.velocity = np.zeros(3)
        self.quaternion = np.array(quaternion, dtype=float)
        self.rate = np.zeros(3)
        self.tilt, self.tilt_rate = np.array(tilt, dtype=float), np.zeros(4)
        self.thrust = np.zeros(4)
        self.mass, self.torque = robot.mass * mass_scale, torque_body
        self.time, self.queue, self.executed = 0.0, deque(), None

    def state(self, in_force):
        """The state of a perfect estimator."""
        return State(self.time, self.position.copy(), self.velocity.copy(),
                     self.quaternion.copy(), self.rate.copy(), self.tilt.copy(),
                     self.tilt_rate.copy(), self.time, in_force)

    def advance(self, command, duration):
        """Apply a command, then integrate for ``duration``."""
        self.queue.append((self.time + DELAY, command))
        for _ in range(round(duration / STEP)):
            while self.queue and self.queue[0][0] <= self.time + 1e-9:
                self.executed = self.queue.popleft()[1]
            self._step()

    def _step(self):
        robot, joints = self.robot, self.robot.joints
        if self.executed is not None:
            self.thrust += STEP / robot.rotors.time_constant * (self.executed.thrust - self.thrust)
            torque = joints.kp * (self.executed.tilt - self.tilt) - joints.kd * self.tilt_rate
            self.tilt_rate = np.clip(self.tilt_rate + STEP * torque / joints.inertia,
                                     -joints.velocity_limit, joints.velocity_limit)
            self.tilt = self.tilt + STEP * self.tilt_rate
        force, torque = self.allocator.wrench(self.tilt, self.thrust)
        acceleration = rotations.matrix(self.quaternion) @ force / self.mass
        acceleration[2] -= robot.gravity
        momentum = robot.inertia * self.rate
        self.rate = self.rate + STEP / robot.inertia * (
            torque + self.torque - np.cross(self.rate, momentum))
        self.velocity = self.velocity + STEP * acceleration
        self.position = self.position + STEP * self.velocity
        self.quaternion = rotations.normalized(rotations.multiply(
            self.quaternion, rotations.exp(STEP * self.rate)))
        self.time += STEP


def fly(plant, controller, target, duration, in_force=None):
    """Close the loop; return (position error, attitude error, command) of each step."""
    log = []
    for _ in range(round(duration / controller.period)):
        in_force = controller.step(plant.state(in_force), target)
        plant.advance(in_force, controller.period)
        reference = target.at(plant.time)
        log.append((float(np.linalg.norm(reference.position - plant.position)),
                    rotations.geodesic_angle(reference.quaternion, plant.quaternion), in_force))
    return log
