"""
Integral action around a policy: shifts the target against the steady error.

A policy is a function of the present state. Biased encoders, a shifted centre of mass or a payload
cause a steady error of some millimetres and degrees. The integral of this error is added to the
target. The integral is slow compared with the policy, bounded, and only active near the target.
"""

from dataclasses import dataclass
from math import hypot, inf, sqrt

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import parameter

LONGEST_STEP = 0.1      # [s] between two states; after a longer gap no update


@dataclass(frozen=True, kw_only=True)
class TrimmingParameters:
    """Rate of the integral, and the criteria of a steady error."""

    rate: float = parameter(1.0, doc='rate of the integral', unit='1/s', low=0, high=5)
    distance: float = parameter(0.06, doc='largest shift of the target', unit='m', low=0, high=1)
    angle: float = parameter(0.15, doc='the same, attitude', unit='rad', low=0, high=1)
    near_distance: float = parameter(
        0.12, doc='a smaller error may be a steady error', unit='m', low=0, high=10)
    near_angle: float = parameter(0.3, doc='the same, attitude', unit='rad', low=0, high=3)
    speed: float = parameter(
        0.15, doc='a faster robot is still on its way', unit='m/s', low=0, high=10)
    turn_rate: float = parameter(0.6, doc='the same, turning', unit='rad/s', low=0, high=10)


class Trimming:
    """
    Shifts pose targets against the steady error.

    Args:
        parameters: rate and limits.

    Attributes:
        position: (3,) shift of the target, in world [m].
        rotation: (3,) rotation of the target, rotation vector in the target's frame [rad].

    """

    def __init__(self, parameters: TrimmingParameters):
        self._p = parameters
        self.reset()

    def reset(self) -> None:
        """Reset the integral."""
        self.position, self.rotation = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self._given: PoseTarget | None = None
        self._seen = -inf

    def target(self, state: State, given: PoseTarget, learn: bool = True) -> PoseTarget:
        """
        The modified target for the policy.

        Args:
            state: of the robot; a state that is not finite does not change the integral.
            given: the target. If it is not near the last target, the integral is reset, because
                the steady error is different there.
            learn: whether this policy is active and flies towards the target.

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
        # NaN is not near
        return hypot(*way) <= self._p.near_distance and hypot(*turn) <= self._p.near_angle


# Plain floats, as in control/observation.py; turns are small, half an angle is its sine.


def _between(a, b):
    """Translation in world [m] and rotation vector [rad] from one pose to another."""
    x, y, z, w = a.quaternion.tolist()
    x, y, z, w = rotations.product(-x, -y, -z, w, *b.quaternion.tolist())
    sign = 2.0 if w >= 0 else -2.0
    return [to - at for at, to in zip(a.position.tolist(), b.position.tolist(), strict=True)], \
        [sign * x, sign * y, sign * z]


def _added(total, share, vector, limit):
    values = [t + share * v for t, v in zip(total, vector, strict=True)]
    length = hypot(*values)
    return [limit / length * v for v in values] if length > limit else values
