"""What a target becomes for a robot of which some actuators fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.robot.actuator_health import ActuatorHealth
from beetle_omni_ros.robot.holding import Holding
from beetle_omni_ros.robot.parameters import RobotParameters


def feasible_target(target: Target, health: ActuatorHealth, robot: RobotParameters,
                    holding: Holding | None = None) -> Target:
    """
    A target that can be held, as near as possible to the one asked for.

    A pose keeps its position and takes the nearest attitude with the margin for holding. A
    trajectory keeps positions and velocities; where one of its attitudes lacks the margin, it
    flies the whole way in the attitude nearest its first that has the margin for flying.

    Args:
        target: as asked for.
        health: what is left of the robot.
        robot: the robot.
        holding: its table, where it is kept.

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
