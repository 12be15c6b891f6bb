"""
Low targets are turned to above them.

A large turn may cost lift: joints that have half a turn to go leave a robot half a second without,
and one turn of some hundred sinks by half a metre. Over a low target that is the floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, kw_only=True)
class TurningParameters:
    """Where a robot turns that has far to turn."""

    height: float = parameter(1.0, doc='of a target at least, in world, ...', unit='m', low=-1000,
                              high=1000)
    angle: float = parameter(1.0, doc='... while the attitude is farther off', unit='rad',
                             low=0.1, high=4)


def raised(state: State, target: PoseTarget, parameters: TurningParameters) -> PoseTarget:
    """
    Give the target, or one above it.

    Args:
        state: of the robot; one that is not finite sees the target.
        target: a pose.
        parameters: how high and for how long.

    """
    if target.position[2] >= parameters.height or not rotations.geodesic_angle(
            state.quaternion, target.quaternion) > parameters.angle:
        return target
    position = target.position.copy()
    position[2] = parameters.height
    return replace(target, position=position)
