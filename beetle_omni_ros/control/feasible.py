"""Replacement of targets for a robot with failed actuators."""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.robot.actuator_health import ActuatorHealth
from beetle_omni_ros.robot.holding import Holding
from beetle_omni_ros.robot.parameters import RobotParameters


def feasible_target(target: Target, health: ActuatorHealth, robot: RobotParameters,
                    holding: Holding | None = None) -> Target:
    """
    A target that can be held, as near as possible to the requested target.

    A pose keeps its position and gets the nearest attitude with the margin for holding. A
    trajectory keeps positions and velocities. If one of its attitudes lacks the margin, its
    attitude becomes constant: the attitude with the margin for flying that is nearest to the
    first.

    Args:
        target: the requested target.
        health: of the actuators.
        robot: the robot.
        holding: its table of margins, if already computed.

    """
    if health.healthy:
        return target
    holding = holding or Holding(robot, health)
    margin = holding.parameters.holding_margin
    if isinstance(target, PoseTarget):
        return replace(target, quaternion=holding.nearest(target.quaternion, margin))
    if min(map(holding.margin, target.quaternions)) >= margin:
        return target
    attitude = holding.nearest(target.quaternions[0], holding.parameters.flying_margin)
    return replace(target, quaternions=np.tile(attitude, (len(target.times), 1)),
                   angular_velocities=np.zeros_like(target.angular_velocities))
