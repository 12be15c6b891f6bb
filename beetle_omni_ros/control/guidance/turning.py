"""
Large turns without a dive: modified target positions during a turn.

While joints turn over, thrust is missing and the robot sinks. It sinks most if it also accelerates
sideways while upside down. During a large turn, low targets are therefore raised. If the robot is
upside down, the distance to the target is limited. If the robot will sink below start and target,
the target is raised further until the prediction ends.
"""

from dataclasses import dataclass, replace
from math import dist, inf

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, kw_only=True)
class TurningParameters:
    """Modified target positions in large turns."""

    angle: float = parameter(
        1.0, doc='attitude error above which height and distance apply', unit='rad', low=0.1,
        high=4)
    height: float = parameter(
        1.0, doc='smallest height of the modified target, in world', unit='m', low=-1000,
        high=1000)
    distance: float = parameter(
        2.0, doc='largest distance of the modified target if the robot is upside down', unit='m',
        low=0.1, high=1000)
    settled: float = parameter(
        0.5, doc='attitude error above which depth, outlook and climb apply', unit='rad', low=0.1,
        high=4)
    depth: float = parameter(
        0.1, doc='predicted depth below start and target at which the target is raised', unit='m',
        low=0, high=1000)
    outlook: float = parameter(0.3, doc='time of this prediction', unit='s', low=0, high=5)
    climb: float = parameter(
        2.0, doc='height by which the target is raised; 0: never', unit='m', low=0, high=10)


class Turning:
    """
    Shifts pose targets during a large turn.

    Args:
        parameters: sizes of the shifts.

    """

    def __init__(self, parameters: TurningParameters):
        self._p = parameters
        self.reset()

    def reset(self) -> None:
        """Reset the start of the way to the target."""
        self._given: PoseTarget | None = None
        self._lowest = -inf

    def target(self, state: State, given: PoseTarget, aim: PoseTarget | None = None) -> PoseTarget:
        """
        The modified target: ``aim``, or its attitude at another position.

        Args:
            state: of the robot; if it is not finite, the result is ``aim``.
            given: the target.
            aim: the target after unwinding and routing; if it differs from ``given``, the turn is
                large.

        """
        z, p = float(state.position[2]), self._p
        if given is not self._given:
            if self._given is None or not given.same_pose(self._given):
                self._lowest = min(float(given.position[2]), z)
            self._given = given
        aim = given if aim is None else aim
        passing = aim is not given
        left = rotations.geodesic_angle(state.quaternion, given.quaternion)
        if not (passing or left > min(p.settled, p.angle)):
            return given
        place = aim.position.tolist()
        if passing or left > p.angle:
            place[2] = max(place[2], p.height)
            at = state.position.tolist()
            far = dist(place, at)
            if far > p.distance and _upside_down(state):
                place = [a + p.distance / far * (b - a) for a, b in zip(at, place)]
        if (passing or left > p.settled) \
                and z + p.outlook * float(state.velocity[2]) < self._lowest - p.depth and p.climb:
            place[2] = max(place[2], z) + p.climb
        return aim if place == aim.position.tolist() else replace(aim, position=np.array(place))


def _upside_down(state):
    """Whether the body's upper side looks down."""
    x, y = state.quaternion[:2].tolist()
    return x * x + y * y > 0.5
