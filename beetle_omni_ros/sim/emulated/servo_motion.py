"""Motion of the servos for tests without a plant: J q'' = Kp (q* - q) - Kd q'."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.robot.parameters import JointParameters

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
        self.joints = joints
        self.position, self.velocity, self.effort = np.zeros((3, count))
        self._time = None

    def advance(self, now: float, goals: np.ndarray, powered: np.ndarray):
        """Move until ``now`` [s] towards ``goals`` [rad]; without power a servo stays put."""
        if self._time is None or now - self._time > 1.0:
            self._time = now
        joints = self.joints
        while self._time + STEP <= now:
            self._time += STEP
            effort = joints.kp * (goals - self.position) - joints.kd * self.velocity
            effort = np.clip(effort, -joints.effort_limit, joints.effort_limit)
            self.effort = np.where(powered, effort, 0.0)
            velocity = self.velocity + self.effort / joints.inertia * STEP
            limit = joints.velocity_limit
            self.velocity = np.where(powered, np.clip(velocity, -limit, limit), 0.0)
            self.position = self.position + self.velocity * STEP
