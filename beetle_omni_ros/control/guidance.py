"""
Guidance: functions that modify the pose targets of a controller without prediction or memory.

Unwinding leads from a joint's stop through a level attitude back to the target, routing through an
intermediate attitude if the shortest turn needs more than the travel of a joint. Easing brings far
targets nearer at first, trimming is an integral of steady errors: docs/explanation/policy.md.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import dist, hypot, inf, sqrt

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.schema import ParameterError, quoted

# The last one is :mod:`.gravity`.
LAYERS = 'unwinding', 'routing', 'easing', 'trimming', 'gravity'
# Unwinding
ATTEMPTS = 2            # to unwind, for one target
WOUND = 2.4             # [rad] a joint beyond is wound; hover with a force or payload needs less
MISSED_ANGLE, MISSED_DISTANCE = 0.14, 0.08      # [rad], [m]: a larger error misses the target
PATIENCE = 0.8          # [s] with missed target without progress, minus the time within the limits
HEIGHT = 1.2            # [m] smallest height of the level attitude: the robot may dive
ARRIVED = 0.35          # [rad] distance from level at which the robot turns back
UNWOUND = 1.0           # [rad] largest tilt at which it turns back, not to wind the joints again
LONG_TURN = 2.0         # [rad] a longer turn from level to the target has a target half way ...
HALF_WAY = 0.6          # [rad] ... until this distance from it
STEP = 1.5              # in limits: an error decrease of this, or of half the error, is progress
# Routing
NEAR = 0.8              # [rad] distance at which the intermediate attitude is reached
ANOTHER = 0.3           # [rad] change of the target that starts a new search
DURATION = 1.5          # [s] longest time to an intermediate attitude, of both
# Easing: largest horizontal distance at the begin of a move [m], and its rate [m/s]
FIRST_DISTANCE, FARTHER = 1.5, 5.0
BEGIN, RAISE = 2.0, 0.5     # [s] of a move in which a target is higher for a dive, [m] how much
# A dive ends so far below start and target [m] with this deceleration [m/s^2].
DIVE, BRAKE = 0.04, 3.0
# Trimming: rate of the integral [1/s], and largest shift and turn of the target [m], [rad].
TRIM_RATE, TRIM_DISTANCE, TRIM_ANGLE = 1.0, 0.06, 0.15
# Smaller errors may be steady errors [m], [rad]; a faster robot is on its way [m/s], [rad/s].
NEAR_DISTANCE, NEAR_ANGLE, SLOW, SLOW_TURN = 0.12, 0.3, 0.15, 0.6
LONGEST_STEP = 0.1      # [s] between two states; after a longer gap no integral


class Guidance:
    """
    Intermediate attitudes of unwinding and routing, otherwise trimming; far targets are eased.

    Args:
        axes: (4, 3) unit tilt axes in base_link.
        without: layers that are off: names with commas, or 'all'.

    Attributes:
        layers: names of the others; ``text`` lists them.

    """

    def __init__(self, axes: np.ndarray, without: str = ''):
        off = {name.strip() for name in without.split(',')} - {''}
        if off - {*LAYERS, 'all'}:
            raise ParameterError(f"key 'without': expected {', '.join(LAYERS)} or all, found "
                                 + quoted(without))
        self.layers = [name for name in LAYERS if not off & {name, 'all'}]
        self.text = ', '.join(self.layers) or 'none'
        self._axes = axes
        self.reset()

    def reset(self) -> None:
        """Reset the memory of the target and of all parts."""
        self._trimming = Trimming()
        self._unwound = self._routed = 0        # counts
        self._given: PoseTarget | None = None
        self._looked: np.ndarray | None = None  # attitude of the target of the last search
        # Attitudes on the way: smallest height, distance and tilt at which each is reached.
        self._way: list[tuple[np.ndarray, float, float, float]] = []
        self._until = self._begun = self._floor = 0.0
        self._failed: list[np.ndarray] = []     # tilts at the begin of each unwinding
        self._watch(-inf)

    def _watch(self, now):
        """Wait for progress from now on."""
        self._least, self._missed, self._seen = inf, 0.0, now

    def target(self, state: State, given: PoseTarget, in_charge: bool = True) -> PoseTarget:
        """The modified pose target; ``in_charge``: whether this controller is active."""
        if given is not self._given:
            self._take(state, given)
        if self._way:
            self._go_on(state)
        elif 'unwinding' in self.layers and len(self._failed) < ATTEMPTS \
                and self._stuck(state, given):
            self._unwound += 1
            self._until = state.stamp + DURATION
            self._failed.append(state.tilt.copy())
            self._way = self._through_level(state, given)
        if self._way:
            self._trimming = Trimming()     # the joints may be wound differently afterwards
            attitude, height, _, _ = self._way[0]
            x, y, z = given.position
            given = replace(given, position=np.array([x, y, max(z, height)]), quaternion=attitude)
        elif 'trimming' in self.layers:
            given = self._trimming.target(state, given, in_charge)
        return self._eased(state, given) if 'easing' in self.layers else given

    def _eased(self, state, shown):
        """The target, nearer at the begin of a move, and higher while the robot dives."""
        since, speed = max(0.0, state.stamp - self._begun), state.velocity.tolist()[2]
        (a, b, c), (x, y, z) = state.position.tolist(), shown.position.tolist()
        limit = FIRST_DISTANCE + FARTHER * since
        share = limit / max(limit, hypot(x - a, y - b))
        dives = speed < 0 and since < BEGIN and c - speed ** 2 / (2 * BRAKE) < self._floor - DIVE
        return shown if share == 1.0 and not dives else replace(shown, position=np.array(
            [a + share * (x - a), b + share * (y - b), z + RAISE * dives]))

    def diagnostics(self) -> dict[str, int]:
        """Counts since the last reset."""
        return {'unwound': self._unwound, 'routed': self._routed}

    def _take(self, state, given):
        """Begin with another target; search a route if its attitude differs from the last."""
        if self._given is None or not given.same_pose(self._given):
            self._failed, self._begun = [], state.stamp
            self._floor = min(state.position[2], given.position[2])
            self._watch(-inf)
        self._given = given
        if self._looked is None \
                or rotations.geodesic_angle(given.quaternion, self._looked) >= ANOTHER:
            self._looked, self._way = given.quaternion, []
            between = route(state.quaternion, given.quaternion, state.tilt, self._axes) \
                if 'routing' in self.layers else None
            if between is not None:
                self._routed += 1
                self._way, self._until = [(between, -inf, NEAR, inf)], state.stamp + DURATION

    def _go_on(self, state):
        """Remove a reached intermediate attitude, or all of them after the time limit."""
        attitude, _, angle, tilt = self._way[0]
        if state.stamp >= self._until:
            self._way = []
        elif rotations.geodesic_angle(state.quaternion, attitude) < angle \
                and np.abs(state.tilt).max() < tilt:
            self._way, self._until = self._way[1:], state.stamp + DURATION
        if not self._way:
            self._watch(state.stamp)

    def _stuck(self, state, given):
        """Whether joints are wound, and the error has not decreased for a long time."""
        if not max(map(abs, state.tilt.tolist())) >= WOUND:    # mostly; the rest costs more
            self._watch(state.stamp)
            return False
        error = max(rotations.geodesic_angle(state.quaternion, given.quaternion) / MISSED_ANGLE,
                    dist(given.position.tolist(), state.position.tolist()) / MISSED_DISTANCE)
        elapsed, self._seen = state.stamp - self._seen, state.stamp
        if error > max(1.0, self._least - min(STEP, 0.5 * self._least)):
            self._missed += elapsed
        elif error > 1.0:
            self._least, self._missed = error, 0.0
        else:       # the error may oscillate about its limit: the longer side decides
            self._missed = max(0.0, self._missed - elapsed)
        return self._missed >= PATIENCE

    def _through_level(self, state, given):
        """The way from a joint's stop to the target."""
        level = level_between(state.quaternion, given.quaternion, self._axes, self._failed)
        way = [(level, HEIGHT, ARRIVED, UNWOUND)]
        turn = rotations.log(rotations.multiply(rotations.conjugate(level), given.quaternion))
        half = rotations.multiply(level, rotations.exp(0.5 * turn))
        return [*way, (half, HEIGHT, HALF_WAY, inf)] if np.linalg.norm(turn) > LONG_TURN else way


class Trimming:
    """
    Integral of the steady error, which is added to the target.

    Biased encoders, a shifted centre of mass or a payload cause some millimetres and degrees.

    Attributes:
        position: (3,) shift of the target, in world [m].
        rotation: (3,) rotation of the target, rotation vector in the target's frame [rad].

    """

    def __init__(self):
        self.position, self.rotation = [0.0] * 3, [0.0] * 3
        self._given: PoseTarget | None = None
        self._modified: PoseTarget | None = None    # None after a change
        self._seen = -inf

    def target(self, state: State, given: PoseTarget, learn: bool = True) -> PoseTarget:
        """
        The modified target; ``learn``: whether this controller is active and flies towards it.

        A target that is not near the last one resets the integral: another steady error is there.
        """
        if given is not self._given:
            if self._given is not None and not _near(*_between(self._given, given)):
                self.position, self.rotation, self._seen = [0.0] * 3, [0.0] * 3, -inf
            self._given, self._modified = given, None
        elapsed, self._seen = state.stamp - self._seen, state.stamp
        if learn and 0.0 < elapsed <= LONGEST_STEP and hypot(*state.velocity.tolist()) <= SLOW \
                and hypot(*state.angular_velocity.tolist()) <= SLOW_TURN:
            way, turn = _between(state, given)
            if _near(way, turn):
                self.position = _added(self.position, TRIM_RATE * elapsed, way, TRIM_DISTANCE)
                self.rotation = _added(self.rotation, TRIM_RATE * elapsed, turn, TRIM_ANGLE)
                self._modified = None
        if self._modified is None:
            x, y, z = (0.5 * angle for angle in self.rotation)
            a, b, c, d = given.quaternion.tolist()
            turned = rotations.product(a, b, c, d, x, y, z, sqrt(1.0 - (x * x + y * y + z * z)))
            self._modified = PoseTarget(given.position + self.position, np.array(turned),
                                        given.stamp)
        return self._modified


# Plain floats, which are faster; turns are small, half an angle is its sine.


def _near(way, turn):
    """Whether an error may be a steady error."""
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


# Turns between attitudes -------------------------------------------------------------------------

HEADINGS = 24           # number of compared level attitudes
# Routing: largest tilt along the shortest turn, above which another way is searched, and its
# largest tilt, if possible [rad].
ROUTED, AIM = 3.4, 3.2
SPREAD = Rotation.create_group('I')    # compared intermediate attitudes, 60 evenly spread
EXCESS = 5.0            # cost of joint angles relative to the length of the turn [rad/rad]
SHORTER = 0.2           # [rad] by which an intermediate attitude must be better
STRAIGHT_UP = np.array([0.0, 0.0, 1.0])
POINTS = 16             # of a turn at which the arms are evaluated
LEAST_USE = 0.2         # smallest used share of an arm's thrust that can carry weight


def level_between(start: np.ndarray, end: np.ndarray, axes: np.ndarray,
                  failed: Sequence[np.ndarray] = ()) -> np.ndarray:
    """
    Level attitude (4,) between two attitudes (4,) of the least :func:`turning_cost`.

    ``axes`` (4, 3) are the unit tilt axes in base_link. Headings that lead to other tilts than the
    ``failed`` ones (4,) [rad], with which the end was not held, are preferred.
    """
    begin, goal = Rotation.from_quat(start), Rotation.from_quat(end)
    heading = np.linspace(0.0, 2 * np.pi, HEADINGS, endpoint=False)
    levels = Rotation.from_rotvec(heading[:, None] * STRAIGHT_UP)
    cost = turning_cost(begin, levels, axes) + turning_cost(levels, goal, axes)
    tilts = tilts_along(turned(levels, goal)[1], axes)[:, -1]
    failures = sum((np.all(np.abs(tilts - wound) < np.pi, axis=1) for wound in failed),
                   np.zeros(HEADINGS))
    best = np.lexsort((cost, failures))[0]      # by failures, then by cost
    return levels[int(best)].as_quat()


def route(start: np.ndarray, end: np.ndarray, tilt: np.ndarray, axes: np.ndarray
          ) -> np.ndarray | None:
    """
    Intermediate attitude (4,) between two attitudes (4,) with which the joints are wound less.

    ``tilt`` (4,) [rad] are the tilts at the start, ``axes`` (4, 3) the unit tilt axes in
    base_link. None if the shortest turn is as good.
    """
    begin, goal = Rotation.from_quat(start), Rotation.from_quat(end)
    angle, up = turned(begin, goal)
    direct = _wound(up, tilt, axes)
    if direct[0] <= ROUTED:
        return None
    rotation = (begin.inv() * goal).as_rotvec()
    other_side = Rotation.from_rotvec(rotation * (0.5 - np.pi / max(angle[0], 1e-9)))
    middle = begin * Rotation.concatenate([SPREAD, other_side])
    there, up_there = turned(begin, middle)
    on, up_on = turned(middle, goal)
    wound = _wound(np.concatenate([up_there, up_on[:, 1:]], axis=1), tilt, axes)
    cost = there + on + EXCESS * np.maximum(0.0, wound - AIM)
    best = int(np.argmin(cost))
    if cost[best] > angle[0] + EXCESS * np.maximum(0.0, direct[0] - AIM) - SHORTER:
        return None
    return middle[best].as_quat()


def _wound(up, tilt, axes):
    """(n,) largest tilt along n turns that begin with ``tilt``."""
    along = tilts_along(up, axes)
    return np.abs(tilt + along - along[:, :1]).max(axis=(1, 2))


def turning_cost(start: Rotation, end: Rotation, axes: np.ndarray) -> np.ndarray:
    """
    Angles (n,) of the shortest turns between attitudes, weighted by arms near upright [rad].

    The thrust of a rotor is across its arm, so sqrt(1 - (arm . up)^2) of it can hold weight; the
    angle is weighted with the inverse square of that for the worst arm.
    """
    angle, up = turned(start, end)
    upright = np.max((up @ axes.T) ** 2, axis=-1)
    return angle * np.mean(1 / np.maximum(1 - upright, LEAST_USE ** 2), axis=1)


def tilts_along(up: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """
    Tilts (n, P, 4) [rad] that keep all thrusts upward, those at the beginning within +-pi.

    ``up`` (n, P, 3) is world's z in the body at points of n ways.
    """
    across = np.cross(axes, STRAIGHT_UP)        # direction of a thrust at a tilt of pi / 2
    return np.unwrap(np.arctan2(up @ across.T, up[..., 2:]), axis=1)


def turned(start: Rotation, end: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Angles (n,) [rad] of the shortest turns, and world's z (n, POINTS, 3) in the body."""
    turn = np.atleast_2d((start.inv() * end).as_rotvec())
    angle = np.linalg.norm(turn, axis=1)
    axis = (turn / np.maximum(angle, 1e-9)[:, None])[:, None]               # (n, 1, 3)
    up = np.atleast_2d(start.inv().apply(STRAIGHT_UP))[:, None]
    part = (angle[:, None] * np.linspace(0.0, 1.0, POINTS))[..., None]      # (n, POINTS, 1)
    along = (axis * up).sum(-1, keepdims=True)
    return angle, up * np.cos(part) - np.cross(axis, up) * np.sin(part) \
        + axis * along * (1 - np.cos(part))
