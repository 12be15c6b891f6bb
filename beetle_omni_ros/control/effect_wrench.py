"""What a robot file's effects add to the wrench that the allocation reckons with."""

from __future__ import annotations

import casadi as ca
import numpy as np

from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters


class EffectWrench:
    """
    Model less allocation, at the nodes of a reference.

    Without it, tilts and thrusts of the reference would not hold its pose in the model, and the
    plan would settle between the two.

    Args:
        robot: with the effects.
        allocator: of the same robot.
        nodes: N + 1.

    Attributes:
        needed: whether the robot file has an effect that the allocation lacks.

    """

    def __init__(self, robot: RobotParameters, allocator: Allocator, nodes: int):
        """Build the function; nothing is compiled."""
        self.needed = any(CATALOGUE[name].apply is not None and not CATALOGUE[name].allocated
                          for name in robot.effects)
        if not self.needed:
            return
        pose, tilt, thrust = ca.SX.sym('pose', 13), ca.SX.sym('tilt', 4), ca.SX.sym('thrust', 4)
        velocity, quaternion, rate = pose[3:6], pose[6:10], pose[10:13]
        acceleration, angular = model.rigid_body(robot, velocity, quaternion, rate, tilt, thrust,
                                                 position=pose[0:3])
        components = ca.vertcat(*[part for i in range(4) for part in (
            thrust[i] * ca.cos(tilt[i]), thrust[i] * ca.sin(tilt[i]))])
        wrench = ca.DM(allocator.matrix) @ components
        inertia = ca.DM(robot.inertia)
        force = allocator.mass * acceleration + ca.DM(allocator.weight) \
            - model.rotation_matrix(quaternion) @ wrench[:3]
        torque = inertia * angular + ca.cross(rate, inertia * rate) - wrench[3:]
        self._function = ca.Function('effect_wrench', [pose, tilt, thrust],
                                     [force, torque]).map(nodes)

    def __call__(self, references: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Wrench at each node.

        Args:
            references: (N + 1, at least 21) position, velocity, quaternion, rates, tilts, thrusts.

        Returns:
            (N + 1, 3) force in world [N] and (N + 1, 3) torque in base_link [N m].

        """
        columns = references.T
        force, torque = self._function(columns[:13], columns[13:17], columns[17:21])
        return np.array(force).T, np.array(torque).T
