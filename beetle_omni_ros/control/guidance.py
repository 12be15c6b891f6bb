"""
Guidance: functions that modify the pose targets of a controller, one after the other.

A controller that is a function of the present state, like a policy, needs it for wound joints, for
dives in large turns and for steady errors. Guidance is optional: a controller may contain a
:class:`Guidance`.
"""

from collections import deque
from dataclasses import replace
from math import dist, hypot, inf, sqrt

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.unwinding import Routing, Unwinding
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import ParameterError, quoted

LAYERS = 'unwinding', 'routing', 'turning', 'trimming'
ALL = 'all'             # in place of the names of all layers
LATEST = 10             # steps within which a command is reported as the executed command
# Turning: the attitude error [rad] above which height and distance apply, the smallest height of
# the modified target in world [m], and its largest distance if the robot is upside down [m].
LARGE, TURN_HEIGHT, TURN_DISTANCE = 1.0, 1.0, 2.0
# The attitude error [rad] above which the depth applies: the depth below start and target [m],
# predicted within this time [s], at which the target is raised by CLIMB [m].
SETTLED, DEPTH, OUTLOOK, CLIMB = 0.5, 0.1, 0.3, 2.0
# Trimming: rate of the integral [1/s], and largest shift and turn of the target [m], [rad].
TRIM_RATE, TRIM_DISTANCE, TRIM_ANGLE = 1.0, 0.06, 0.15
# Smaller errors may be steady errors [m], [rad]; a faster robot is on its way [m/s], [rad/s].
NEAR_DISTANCE, NEAR_ANGLE, SLOW, SLOW_TURN = 0.12, 0.3, 0.15, 0.6
LONGEST_STEP = 0.1      # [s] between two states; after a longer gap no integral


class Guidance:
    """
    Unwinding if the joints are stuck, otherwise routing; then turning and trimming.

    Args:
        axes: (4, 3) unit tilt axes in base_link.
        without: layers that are off: names with commas, or 'all'.

    Attributes:
        text: lists the active layers.

    Raises:
        ParameterError: an unknown layer.

    """

    def __init__(self, axes: np.ndarray, without: str = ''):
        off = {name.strip() for name in without.split(',')} - {''}
        if unknown := off - {*LAYERS, ALL}:
            raise ParameterError(f"key 'without': expected {', '.join(LAYERS)} or {ALL}, found "
                                 f'{quoted(", ".join(sorted(unknown)))}')
        self._on = [name for name in LAYERS if not off & {name, ALL}]
        self.text = ', '.join(self._on) or 'none'
        self._unwinding, self._routing = Unwinding(axes), Routing(axes)
        self._turning, self._trimming = Turning(), Trimming()

    def reset(self) -> None:
        """Reset the memory of the target and of all parts."""
        for part in (self._unwinding, self._routing, self._turning, self._trimming):
            part.reset()

    def target(self, state: State, given: PoseTarget, in_charge: bool = True) -> PoseTarget:
        """
        The modified pose target for the controller.

        Args:
            state: of the robot.
            given: the target.
            in_charge: whether this controller is active.

        """
        aim = self._unwinding.target(state, given) if 'unwinding' in self._on else given
        if aim is given and 'routing' in self._on:
            aim = self._routing.target(state, given)
        shown = self._turning.target(state, given, aim) if 'turning' in self._on else aim
        if shown is given and 'trimming' in self._on:
            return self._trimming.target(state, given, in_charge)
        self._trimming.reset()      # the joints may be wound differently afterwards
        return shown

    def diagnostics(self) -> dict[str, int]:
        """Counts since the last reset."""
        return {'unwound': self._unwinding.attempts, 'routed': self._routing.routed}


class Charge:
    """Detects whether the executed commands are those of one controller."""

    def __init__(self):
        self.reset()

    def reset(self) -> None:
        """Remove all stored commands."""
        self._latest: deque[list[float]] = deque(maxlen=LATEST)

    def gave(self, values: list[float]) -> None:
        """Store a command: tilts [rad], then thrusts [N]."""
        self._latest.appendleft(values)

    def holds(self, state: State) -> bool:
        """Whether the executed command is one of the latest commands."""
        command = state.command
        return command is not None and command.tilt.tolist() + command.thrust.tolist() \
            in self._latest


class Turning:
    """
    Shifts pose targets during a large turn, to limit the dive.

    While joints turn over, thrust is missing and the robot sinks. It sinks most if it also
    accelerates sideways while upside down. During a large turn, low targets are therefore raised.
    If the robot is upside down, the distance to the target is limited. If the robot will sink
    below start and target, the target is raised further until the prediction ends.
    """

    def __init__(self):
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
        z = float(state.position[2])
        if given is not self._given:
            if self._given is None or not given.same_pose(self._given):
                self._lowest = min(float(given.position[2]), z)
            self._given = given
        aim = given if aim is None else aim
        passing = aim is not given
        left = rotations.geodesic_angle(state.quaternion, given.quaternion)
        if not (passing or left > SETTLED):
            return given
        place = aim.position.tolist()
        if passing or left > LARGE:
            place[2] = max(place[2], TURN_HEIGHT)
            at = state.position.tolist()
            far = dist(place, at)
            x, y = state.quaternion[:2].tolist()
            if far > TURN_DISTANCE and x * x + y * y > 0.5:     # upside down
                place = [a + TURN_DISTANCE / far * (b - a) for a, b in zip(at, place)]
        if z + OUTLOOK * float(state.velocity[2]) < self._lowest - DEPTH:
            place[2] = max(place[2], z) + CLIMB
        return aim if place == aim.position.tolist() else replace(aim, position=np.array(place))


class Trimming:
    """
    Integral action: shifts pose targets against the steady error.

    Biased encoders, a shifted centre of mass or a payload cause a steady error of some millimetres
    and degrees. The integral of this error is added to the target. It is slow compared with the
    policy, bounded, and only active near the target.

    Attributes:
        position: (3,) shift of the target, in world [m].
        rotation: (3,) rotation of the target, rotation vector in the target's frame [rad].

    """

    def __init__(self):
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
            if self._given is not None and not _near(*_between(self._given, given)):
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
        if hypot(*state.velocity.tolist()) <= SLOW \
                and hypot(*state.angular_velocity.tolist()) <= SLOW_TURN:
            way, turn = _between(state, given)
            if _near(way, turn):
                self.position = _added(self.position, TRIM_RATE * elapsed, way, TRIM_DISTANCE)
                self.rotation = _added(self.rotation, TRIM_RATE * elapsed, turn, TRIM_ANGLE)



# Plain floats, which are faster; turns are small, half an angle is its sine.


def _near(way, turn):
    """Whether an error may be a steady error; NaN is not."""
    return hypot(*way) <= NEAR_DISTANCE and hypot(*turn) <= NEAR_ANGLE


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
