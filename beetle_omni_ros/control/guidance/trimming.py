"""
The steady error of a policy at rest, taken off by a target that is moved against it.

A policy acts on the present state alone: biased encoders, a shifted centre of mass or a payload
leave it some millimetres and degrees beside the target. As it flies to wherever the target is, the
integral of what is left, added to the target, ends that error: integral action around the policy,
as slow as the policy is quick, only near the target, and bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, inf, sqrt

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import parameter

LONGEST_STEP = 0.1      # [s] between two states; after longer the robot may be anywhere


@dataclass(frozen=True, kw_only=True)
class TrimmingParameters:
    """How fast a steady error is taken off, and when an error is one."""

    rate: float = parameter(1.0, doc='of the integral; 0: off', unit='1/s', low=0, high=5)
    distance: float = parameter(0.06, doc='by which the target may be moved', unit='m', low=0,
                                high=1)
    angle: float = parameter(0.15, doc='the same, attitude', unit='rad', low=0, high=1)
    near_distance: float = parameter(0.12, doc='an error below may be a steady one', unit='m',
                                     low=0, high=10)
    near_angle: float = parameter(0.3, doc='the same, attitude', unit='rad', low=0, high=3)
    speed: float = parameter(0.15, doc='a robot that moves faster is on its way', unit='m/s',
                             low=0, high=10)
    turn_rate: float = parameter(0.6, doc='the same, turning', unit='rad/s', low=0, high=10)


class Trimming:
    """
    Moves pose targets against the steady error.

    Args:
        parameters: how.

    Attributes:
        position: (3,) by which the target is moved, in world [m].
        rotation: (3,) by which it is turned, rotation vector in the target's frame [rad].

    """

    def __init__(self, parameters: TrimmingParameters):
        self._p = parameters
        self.reset()

    def reset(self) -> None:
        """Forget what was found."""
        self.position, self.rotation = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self._given: PoseTarget | None = None
        self._seen = -inf

    def target(self, state: State, given: PoseTarget, learn: bool = True) -> PoseTarget:
        """
        The target as the policy is to see it.

        Args:
            state: of the robot; one that is not finite teaches nothing.
            given: the target. One that is not near the last starts anew, for the steady error
                there is another one.
            learn: whether the robot is flying towards it by this policy.

        """
        if given is not self._given:
            if self._given is not None and not self._near(*_between(self._given, given)):
                self.reset()
            self._given = given
        elapsed, self._seen = state.stamp - self._seen, state.stamp
        if learn and 0.0 < elapsed <= LONGEST_STEP:
            self._add(elapsed, state, given)
        x, y, z = (0.5 * angle for angle in self.rotation)
        turned = rotations.multiply(given.quaternion,
                                    (x, y, z, sqrt(1.0 - (x * x + y * y + z * z))))
        return PoseTarget(given.position + self.position, turned, given.stamp)

    def _add(self, elapsed, state, given):
        p = self._p
        if hypot(*state.velocity.tolist()) <= p.speed \
                and hypot(*state.angular_velocity.tolist()) <= p.turn_rate:
            way, turn = _between(state, given)
            if self._near(way, turn):
                self.position = _added(self.position, p.rate * elapsed, way, p.distance)
                self.rotation = _added(self.rotation, p.rate * elapsed, turn, p.angle)

    def _near(self, way, turn):
        # what is no number is not near
        return hypot(*way) <= self._p.near_distance and hypot(*turn) <= self._p.near_angle


# Plain floats, as in control/observation.py; turns are small, half an angle is its sine.


def _between(a, b):
    """Way in world [m] and turn as rotation vector [rad] from one pose to another."""
    x, y, z, w = a.quaternion.tolist()
    x, y, z, w = rotations.product(-x, -y, -z, w, *b.quaternion.tolist())
    sign = 2.0 if w >= 0 else -2.0
    return [to - at for at, to in zip(a.position.tolist(), b.position.tolist(), strict=True)], \
        [sign * x, sign * y, sign * z]


def _added(total, share, vector, limit):
    values = [t + share * v for t, v in zip(total, vector, strict=True)]
    length = hypot(*values)
    return [limit / length * v for v in values] if length > limit else values
