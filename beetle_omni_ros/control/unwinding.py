"""
Free joints: unwinding from a joint's stop through a level attitude back to the target.

Most thrust directions correspond to two joint angles, a full turn apart. Beyond half a turn the
better angle may be a full turn back, and on the way there the thrust points in wrong directions. A
policy, a function of the present state, does not turn back: two opposite joints stay near half a
turn or at their stops, with an attitude error of 10 to 90 degrees.

In level hover each tilt is zero, and no other angle within the travel gives the same thrust. A
level target at the target position therefore unwinds all joints. From there the target is reached
as after a take-off.

The heading of the level attitude determines both turns. In a turn about an arm, the two arms
across point upward half way. Their thrust cannot carry weight there, and their joints must turn
over by half a turn in an arbitrary direction. In a turn about an axis between two arms all four
joints turn continuously. The selected heading therefore keeps the arms away from upright in both
turns. The heading also determines the joint angles at the target: a heading that leads to the same
angles as at the missed target is used only if there is no other. If the turn back is long, the
attitude half way is the first target, because a policy may choose either direction for nearly half
a turn, and the wrong one winds the joints differently.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import dist, inf, isfinite, sqrt
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.robot import rotations

ATTEMPTS = 2            # to unwind, for one target
WOUND = 2.4             # [rad] a joint beyond is wound; hover with a force or payload needs less
# A larger error misses the target [rad], [m]; below this share of the smallest so far, it falls.
MISSED_ANGLE, MISSED_DISTANCE, PROGRESS = 0.14, 0.08, 0.8
PATIENCE = 0.8          # [s] with missed target without progress, minus the time within the limits
HEIGHT = 1.2            # [m] smallest height of the level attitude: the robot may dive
DURATION = 1.5          # [s] longest time to an intermediate attitude
ARRIVED = 0.35          # [rad] distance from level at which the robot turns back
UNWOUND = 1.0           # [rad] largest tilt at which it turns back, not to wind the joints again
LONG_TURN = 2.0         # [rad] a longer turn from level to the target has a target half way ...
HALF_WAY = 0.6          # [rad] ... until this distance from it
STEP = 1.5              # in limits: an error decrease of this, or of half the error, is progress
HEADINGS = 24           # number of compared level attitudes

# Routing: largest tilt along the shortest turn, above which another way is searched, and its
# largest tilt, if possible; the distance at which the intermediate attitude is reached [rad].
ROUTED, AIM, NEAR = 3.4, 3.2, 0.8
ATTITUDES = 150         # compared intermediate attitudes; 50 and 400 give similar flights
EXCESS = 5.0            # cost of joint angles relative to the length of the turn [rad/rad]
SHORTER = 0.2           # [rad] by which an intermediate attitude must be better
ANOTHER = 0.3           # [rad] change of the target that starts a new search

STRAIGHT_UP = np.array([0.0, 0.0, 1.0])
POINTS = 16             # of a turn at which the arms are evaluated
LEAST_USE = 0.2         # smallest used share of an arm's thrust that can carry weight


class _Stop(NamedTuple):
    """An intermediate target, and angle and tilt at which it is reached [rad]."""

    target: PoseTarget
    angle: float
    tilt: float


class Unwinding:
    """
    Replaces a pose target by a level attitude while the robot unwinds.

    Args:
        axes: (4, 3) unit tilt axes in base_link.

    Attributes:
        attempts: since the last reset.

    """

    def __init__(self, axes: np.ndarray):
        self._axes = axes
        self.reset()

    def reset(self) -> None:
        """Reset target and attempts."""
        self.attempts = 0
        self._given: PoseTarget | None = None
        self._start()

    def _start(self):
        """Begin with a new target."""
        self._left = ATTEMPTS
        self._failed: list[np.ndarray] = []
        self._way: list[_Stop] = []
        self._until = 0.0
        self._watch(-np.inf)

    def _watch(self, now):
        """Wait for progress from now on."""
        self._least, self._missed, self._seen = np.inf, 0.0, now

    def target(self, state: State, given: PoseTarget) -> PoseTarget:
        """
        The modified target: ``given``, or a level attitude at its position.

        Args:
            state: finite.
            given: the target.

        """
        if given is not self._given:
            if self._given is None or not given.same_pose(self._given):
                self._start()
            self._given = given
        if self._way:
            self._go_on(state)
            return self._way[0].target if self._way else given
        if self._left and self._stuck(state, given):
            self._left -= 1
            self.attempts += 1
            self._until = state.stamp + DURATION
            self._failed.append(state.tilt.copy())
            self._way = self._through(state, given)
            return self._way[0].target
        return given

    def _stuck(self, state, given):
        """Whether joints are wound, and the error has not decreased for a long time."""
        if not max(map(abs, state.tilt.tolist())) >= WOUND:    # mostly; the rest costs more
            self._watch(state.stamp)
            return False
        error = max(rotations.geodesic_angle(state.quaternion, given.quaternion) / MISSED_ANGLE,
                    dist(given.position.tolist(), state.position.tolist()) / MISSED_DISTANCE)
        elapsed, self._seen = state.stamp - self._seen, state.stamp
        if error > max(1.0, self._progress()):
            self._missed += elapsed
        elif error > 1.0:
            self._least, self._missed = error, 0.0
        else:       # the error may oscillate about its limit: the longer side decides
            self._missed = max(0.0, self._missed - elapsed)
        return self._missed >= PATIENCE

    def _progress(self):
        """Error below which there is progress."""
        if self._least == inf:
            return inf
        return self._least - max((1 - PROGRESS) * self._least,
                                 min(STEP, 0.5 * self._least))

    def _through(self, state, given):
        position = given.position.copy()
        position[2] = max(position[2], HEIGHT)
        level = level_between(state.quaternion, given.quaternion, self._axes, self._failed)
        way = [_Stop(replace(given, position=position, quaternion=level), ARRIVED, UNWOUND)]
        turn = rotations.log(rotations.multiply(rotations.conjugate(level), given.quaternion))
        if np.linalg.norm(turn) > LONG_TURN:
            half = rotations.multiply(level, rotations.exp(0.5 * turn))
            way.append(_Stop(replace(given, position=position, quaternion=half), HALF_WAY, inf))
        return way

    def _go_on(self, state):
        """Remove a reached intermediate target, or all of them after the time limit."""
        stop = self._way[0]
        if state.stamp >= self._until:
            self._way = []
        elif rotations.geodesic_angle(state.quaternion, stop.target.quaternion) < stop.angle \
                and np.abs(state.tilt).max() < stop.tilt:
            self._way = self._way[1:]
            self._until = state.stamp + DURATION
        if not self._way:
            self._watch(state.stamp)


def levelled(quaternion: np.ndarray) -> np.ndarray:
    """(4,) the level attitude nearest to ``quaternion``, both xyzw."""
    up = rotations.matrix(quaternion).T @ STRAIGHT_UP      # world's z in the body
    axis = np.cross(up, STRAIGHT_UP)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:     # level already, or upside down: about the own x axis
        turn = np.array([1.0, 0.0, 0.0]) * (0.0 if up[2] > 0 else np.pi)
    else:
        turn = axis / sine * np.arctan2(sine, up[2])
    return rotations.normalized(rotations.multiply(
        quaternion, rotations.conjugate(rotations.exp(turn))))


def level_between(start: np.ndarray, end: np.ndarray, axes: np.ndarray,
                  failed: Sequence[np.ndarray] = ()) -> np.ndarray:
    """
    Choose the best level attitude between two attitudes.

    Args:
        start: (4,) attitude, xyzw.
        end: (4,) the same.
        axes: (4, 3) unit tilt axes in base_link.
        failed: (4,) tilts [rad] with which the end was not held; headings that lead to other tilts
            are preferred.

    Returns:
        (4,) the level attitude, xyzw, of the least :func:`turning_cost` there and on.

    """
    begin, goal = Rotation.from_quat(start), Rotation.from_quat(end)
    heading = np.linspace(0.0, 2 * np.pi, HEADINGS, endpoint=False)
    levels = Rotation.from_rotvec(heading[:, None] * STRAIGHT_UP) \
        * Rotation.from_quat(levelled(start))
    cost = turning_cost(begin, levels, axes) + turning_cost(levels, goal, axes)
    tilts = tilts_along(turned(levels, goal)[1], axes)[:, -1]
    failures = np.zeros(HEADINGS)
    for wound in failed:
        failures += np.all(np.abs(tilts - wound) < np.pi, axis=1)
    best = np.lexsort((cost, failures))[0]      # by failures, then by cost
    return levels[int(best)].as_quat()


class Routing:
    """
    Replaces a pose target by an intermediate attitude if this is the better way.

    In a turn of the body the joints must turn in the body frame so that the thrusts stay upward.
    If the shortest turn needs more than the travel of a joint, a policy begins this turn
    nevertheless. It loses the thrust of two rotors half way, dives, and arrives with joints at
    their stops or not at all. By way of an intermediate attitude the joints end at other angles.
    Such an attitude is searched for each new target.

    Args:
        axes: (4, 3) unit tilt axes in base_link.

    Attributes:
        routed: ways round since the last reset.

    """

    def __init__(self, axes: np.ndarray):
        self._axes = axes
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
                or rotations.geodesic_angle(state.quaternion, self._between) < NEAR:
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
            self._until = state.stamp + DURATION

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
        if direct[0] <= ROUTED:
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
        return EXCESS * np.maximum(0.0, wound - AIM)


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


# Joint angles along turns. In a slow turn every thrust points upward as far as its arm permits.
# The tilts therefore follow from the path of world's z in the body frame, except for full turns,
# whose number follows from the initial tilts.


def turning_cost(start: Rotation, end: Rotation, axes: np.ndarray) -> np.ndarray:
    """
    Angle of the shortest turn between two attitudes, weighted by arms near upright [rad].

    The thrust of a rotor is across its arm, so sqrt(1 - (arm . up)^2) of it can hold weight; the
    angle is weighted with the inverse square of that for the worst arm.

    Args:
        start: one attitude or n of them.
        end: the same.
        axes: (4, 3) unit tilt axes in base_link.

    Returns:
        (n,) costs.

    """
    angle, up = turned(start, end)
    upright = np.max((up @ axes.T) ** 2, axis=-1)
    return angle * np.mean(1 / np.maximum(1 - upright, LEAST_USE ** 2), axis=1)


def tilts_along(up: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """
    Tilts (n, P, 4) [rad] that keep all thrusts upward, those at the beginning within +-pi.

    Args:
        up: (n, P, 3) world's z in the body at points of n ways.
        axes: (4, 3) unit tilt axes in base_link.

    """
    across = np.cross(axes, STRAIGHT_UP)        # direction of a thrust at a tilt of pi / 2
    return np.unwrap(np.arctan2(up @ across.T, up[..., 2:]), axis=1)


def turned(start: Rotation, end: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """
    Follow the shortest turns between attitudes.

    Args:
        start: one attitude or n of them.
        end: the same.

    Returns:
        (n,) their angles [rad], and (n, POINTS, 3) world's z in the turning body.

    """
    turn = np.atleast_2d((start.inv() * end).as_rotvec())
    angle = np.linalg.norm(turn, axis=1)
    axis = (turn / np.maximum(angle, 1e-9)[:, None])[:, None]               # (n, 1, 3)
    up = np.atleast_2d(start.inv().apply(STRAIGHT_UP))[:, None]
    part = (angle[:, None] * np.linspace(0.0, 1.0, POINTS))[..., None]      # (n, POINTS, 1)
    along = (axis * up).sum(-1, keepdims=True)
    return angle, up * np.cos(part) - np.cross(axis, up) * np.sin(part) \
        + axis * along * (1 - np.cos(part))
