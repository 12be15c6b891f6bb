"""Motion of the servos for tests without a plant."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.robot.parameters import JointParameters
from beetle_omni_ros.robot.servo import NUMPY, Servo, Step

STEP = 0.001  # [s] far below the period of the servo's 11 Hz


class SecondOrderMotion:
    """
    Free servos, without load.

    Attributes:
        position: (n,) [rad].
        velocity: (n,) [rad/s].
        effort: (n,) [N m].

    """

    def __init__(self, joints: JointParameters, count: int):
        self._servo = Servo.of(joints)
        self._step = Step(NUMPY, self._servo, STEP)
        self.position, self.velocity, self.effort = np.zeros((3, count))
        self._time = None

    def advance(self, now: float, goals: np.ndarray, powered: np.ndarray):
        """Move until ``now`` [s] towards ``goals`` [rad]; without power a servo stays put."""
        if self._time is None or now - self._time > 1.0:
            self._time = now
        while self._time + STEP <= now:
            self._time += STEP
            moved = self._step(goals, self.position, np.where(powered, self.velocity, 0.0))
            self.position, self.velocity = np.where(
                powered, moved, [self.position, np.zeros_like(self.velocity)])
            self.effort = np.where(powered, self._servo.motor(
                NUMPY, goals - self.position, self.velocity), 0.0)
