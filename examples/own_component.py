r"""
A component of your own beside the flight: an observer of the external force.

    beetle_omni evaluate --controllers nmpc --task force --bag BAG \
        --component examples/own_component.py:WrenchObserver
    beetle_omni fly --task force --component examples/own_component.py:WrenchObserver

It runs in the loop and as a node of the graph without a change. It compares the measured specific
force with that of the commanded thrusts, and publishes the difference on 'observer/force'.
"""

import numpy as np

from beetle_omni_ros.bags.messages import Wrench
from beetle_omni_ros.bags.topics import register, topic_like
from beetle_omni_ros.flight.component import Component
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import Allocator

register(topic_like('disturbance', 'observer/force', 'external force in world, estimated'))
SMOOTHING = 0.2     # [s] time constant


class WrenchObserver(Component):
    """Publishes the external force on the robot, from IMU and commands."""

    def __init__(self, robot):
        super().__init__('wrench_observer_node')
        self._allocator, self._mass = Allocator(robot), robot.mass
        self._command = self._odom = None
        self._force, self._stamp = np.zeros(3), None
        self.writes('observer/force')
        self.reads('command', self._on_command, expected=False)
        self.reads('odom', self._on_odom, max_age=0.1)
        self.reads('imu/data_raw', self._on_imu, max_age=0.1)
        self.report('force', lambda: (0, 'N in world', dict(zip('xyz', self._force.tolist()))))

    def _on_command(self, command):
        self._command = command

    def _on_odom(self, odom):
        self._odom = odom

    def _on_imu(self, sample):
        if self._command is None or self._odom is None:
            return
        pushed, _ = self._allocator.wrench(self._command.tilt, self._command.thrust)
        measured = self._mass * sample.specific_force
        now = rotations.matrix(self._odom.quaternion) @ (measured - pushed)
        before, self._stamp = self._stamp or sample.stamp, sample.stamp
        self._force += min(1.0, (sample.stamp - before) / SMOOTHING) * (now - self._force)
        self.send('observer/force', Wrench(sample.stamp, self._force.copy(), np.zeros(3)))
