"""
Intermediate attitudes for turns whose shortest way would drive joints into their stops.

In a turn of the body the joints must turn in the body frame so that the thrusts stay upward. If
the shortest turn needs more than the travel of a joint, a policy, which is a function of the
present state, begins this turn nevertheless. It loses the thrust of two rotors half way, dives,
and arrives with joints at their stops or not at all. By way of an intermediate attitude the joints
end at other angles. This module searches such an attitude for each new target, and uses it as the
first target.
"""

from dataclasses import dataclass, replace
from math import isfinite, sqrt

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.guidance.turns import tilts_along, turned
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import parameter

ATTITUDES = 150     # compared intermediate attitudes; 50 and 400 give similar flights
EXCESS = 5.0        # cost of joint angles relative to the length of the turn [rad/rad]
SHORTER = 0.2       # by which an intermediate attitude must be better than the shortest turn [rad]
ANOTHER = 0.3       # change of the target that starts a new search [rad]


@dataclass(frozen=True, kw_only=True)
class RoutingParameters:
    """When an intermediate attitude is used, and for how long."""

    tilt: float = parameter(
        3.4, doc='largest tilt along the shortest turn, above which an intermediate attitude is '
        'searched', unit='rad', low=0.5, high=100)
    aim: float = parameter(
        3.2, doc='largest tilt by way of the intermediate attitude, if possible', unit='rad',
        low=0.5, high=100)
    near: float = parameter(
        0.8, doc='distance at which the intermediate attitude is reached', unit='rad', low=0.05,
        high=3)
    duration: float = parameter(
        1.5, doc='longest time to the intermediate attitude', unit='s', low=0.1, high=100)


class Routing:
    """
    Replaces a pose target by an intermediate attitude if this is the better way.

    Args:
        parameters: when.
        axes: (4, 3) unit tilt axes in base_link.

    Attributes:
        routed: ways round since the last reset.

    """

    def __init__(self, parameters: RoutingParameters, axes: np.ndarray):
        self._p = parameters
        self._axes = np.asarray(axes, dtype=float)
        self._turns = Rotation.from_quat(spread_attitudes(ATTITUDES))
        self.reset()

    def reset(self) -> None:
        """Forget the target."""
        self.routed = 0
        self._given: PoseTarget | None = None
        self._looked: np.ndarray | None = None      # attitude of the target a way was looked for
        self._between: np.ndarray | None = None
        self._until = 0.0

    def target(self, state: State, given: PoseTarget) -> PoseTarget:
        """
        What to fly towards: ``given``, or its place in an attitude on the way.

        Args:
            state: of the robot; one that is not finite begins no way.
            given: the target. One that turns little from the last begins no new way.

        """
        if given is not self._given:
            self._given = given
            self._look(state, given)
        if self._between is None:
            return given
        if state.stamp >= self._until \
                or rotations.geodesic_angle(state.quaternion, self._between) < self._p.near:
            self._between = None
            return given
        return replace(given, quaternion=self._between)

    def _look(self, state, given):
        if not isfinite(sum(state.quaternion.tolist()) + sum(state.tilt.tolist())):
            self._given = None      # repeat with the next state
            return
        if self._looked is not None \
                and rotations.geodesic_angle(given.quaternion, self._looked) < ANOTHER:
            return
        self._looked = given.quaternion
        self._between = self.between(state.quaternion, given.quaternion, state.tilt)
        if self._between is not None:
            self.routed += 1
            self._until = state.stamp + self._p.duration

    def between(self, start: np.ndarray, end: np.ndarray, tilt: np.ndarray) -> np.ndarray | None:
        """
        Intermediate attitude with which the joints are wound less.

        Args:
            start: (4,) attitude, xyzw.
            end: (4,) the same.
            tilt: (4,) tilts at the start [rad].

        Returns:
            (4,) an attitude, xyzw, or None if the shortest turn is as good.

        """
        begin, goal = Rotation.from_quat(start), Rotation.from_quat(end)
        angle, up = turned(begin, goal)
        direct = self._wound(up, tilt)
        if direct[0] <= self._p.tilt:
            return None
        rotation = (begin.inv() * goal).as_rotvec()
        other_side = Rotation.from_rotvec(rotation * (0.5 - np.pi / max(angle[0], 1e-9)))
        middle = begin * Rotation.concatenate([self._turns, other_side])
        there, up_there = turned(begin, middle)
        on, up_on = turned(middle, goal)
        wound = self._wound(np.concatenate([up_there, up_on[:, 1:]], axis=1), tilt)
        cost = there + on + self._excess(wound)
        best = int(np.argmin(cost))
        if cost[best] > angle[0] + self._excess(direct)[0] - SHORTER:
            return None
        return middle[best].as_quat()

    def _wound(self, up, tilt):
        """(n,) largest tilt along n turns that begin with ``tilt``."""
        along = tilts_along(up, self._axes)
        return np.abs(tilt + along - along[:, :1]).max(axis=(1, 2))

    def _excess(self, wound):
        return EXCESS * np.maximum(0.0, wound - self._p.aim)


def spread_attitudes(count: int) -> np.ndarray:
    """
    (count, 4) unit quaternions xyzw, evenly spread.

    A spiral on the three-sphere after M. Alexa, Super-Fibonacci spirals: fast, low-discrepancy
    sampling of SO(3) (2022).
    """
    part = (np.arange(count) + 0.5) / count
    inner, outer = np.sqrt(part), np.sqrt(1 - part)
    alpha = 2 * np.pi * count * part / sqrt(2)
    beta = 2 * np.pi * count * part / 1.533751168755204288118041
    return np.column_stack([inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta),
                            outer * np.cos(beta)])
