"""The CasADi model of a robot in closed loop; a command acts 10 ms after the state it answers."""

import numpy as np

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ALL_HEALTHY, Allocator
from beetle_omni_ros.model.native import buffered
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
PERIOD = 0.01


class Body:
    """
    A robot that hovers at first.

    Args:
        position: first position.
        attitude: first attitude.
        present: tilts near which those of the first hover are.
        robot: the true robot.
        disturbance: constant force in world, torque in base_link, offsets of the tilts.

    """

    def __init__(self, position=(0.0, 0.0, 1.0), attitude=LEVEL, present=np.zeros(4), robot=ROBOT,
                 disturbance=np.zeros(10)):
        self._advance = buffered(model.integrator(robot, 4))
        hover = Allocator(ROBOT).hover(attitude, present)
        self.x = np.concatenate([position, np.zeros(3), attitude, np.zeros(3), hover.tilt,
                                 np.zeros(4), hover.thrust])
        self.command = Command(-PERIOD, hover.tilt, hover.thrust)
        self.time, self.disturbance, self.broken = 0.0, disturbance, ALL_HEALTHY
        self.trace = []     # time, state (25,) and command after each period

    def state(self):
        """The state of a perfect estimator."""
        x = self.x
        return State(self.time, x[:3], x[3:6], x[6:10], x[10:13], x[13:17], x[17:21], self.time,
                     self.command)

    def advance(self, following):
        """Fly for a period, and put the next command in force."""
        acting = self.broken.possible(self.command.tilt, self.command.thrust)
        self.x = self._advance(self.x, np.concatenate(acting), self.disturbance, PERIOD)
        self.command, self.time = following, self.time + PERIOD
        self.trace.append((self.time, self.x, following))

    def fly(self, controller, target, seconds):
        """Close the loop."""
        for _ in range(round(seconds / PERIOD)):
            self.advance(controller.step(self.state(), target))
        return self

    def errors(self, target):
        """Errors of position [m] and attitude [rad] after each period, (n, 2)."""
        return np.array([(np.linalg.norm(x[:3] - target.at(time).position),
                          rotations.geodesic_angle(x[6:10], target.at(time).quaternion))
                         for time, x, _ in self.trace])
