"""
Unwinding: from a joint's stop through a level attitude back to the target.

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
from dataclasses import dataclass, replace
from math import dist, inf
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.guidance.turns import STRAIGHT_UP, tilts_at_end, turning_cost
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import parameter

ARRIVED = 0.35    # [rad] distance from level at which the robot turns back
UNWOUND = 1.0     # [rad] largest tilt at which it turns back; otherwise the joints are wound again
LONG_TURN = 2.0   # [rad] a longer turn from level to the target has a target half way ...
HALF_WAY = 0.6    # [rad] ... until this distance from it
STEP = 1.5        # in limits: an error decrease of this, or of half the error, is progress
HEADINGS = 24     # number of compared level attitudes


@dataclass(frozen=True, kw_only=True)
class UnwindingParameters:
    """Criteria of a pose that is not reached because the joints are wound."""

    attempts: int = parameter(2, doc='attempts for one target; 0: never', low=0, high=100)
    tilt: float = parameter(
        2.4, doc='a joint beyond this tilt is wound', unit='rad', low=0.5, high=10)
    angle: float = parameter(
        0.14, doc='attitude error above which the target is missed', unit='rad', low=0.01, high=3)
    distance: float = parameter(0.08, doc='the same, position', unit='m', low=0.005, high=10)
    progress: float = parameter(
        0.8, doc='an error below this share of the smallest error so far is progress', low=0,
        high=1)
    patience: float = parameter(
        0.8, doc='time with missed target without progress, minus the time within the limits',
        unit='s', low=0.05, high=100)
    height: float = parameter(
        1.2, doc='smallest height of the level attitude, in world', unit='m', low=-1000, high=1000)
    duration: float = parameter(
        1.5, doc='longest time to the level attitude, and to half of a long turn back', unit='s',
        low=0.1, high=100)


class _Stop(NamedTuple):
    """An intermediate target, and angle and tilt at which it is reached [rad]."""

    target: PoseTarget
    angle: float
    tilt: float


class Unwinding:
    """
    Replaces a pose target by a level attitude while the robot unwinds.

    Args:
        parameters: criteria.
        axes: (4, 3) unit tilt axes in base_link.

    Attributes:
        attempts: since the last reset.

    """

    def __init__(self, parameters: UnwindingParameters, axes: np.ndarray):
        self._p = parameters
        self._axes = np.asarray(axes, dtype=float)
        self.reset()

    def reset(self) -> None:
        """Reset target and attempts."""
        self.attempts = 0
        self._given: PoseTarget | None = None
        self._start()

    def _start(self):
        """Begin with a new target."""
        self._left = self._p.attempts
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
            self._until = state.stamp + self._p.duration
            self._failed.append(state.tilt.copy())
            self._way = self._through(state, given)
            return self._way[0].target
        return given

    def _stuck(self, state, given):
        """Whether joints are wound, and the error has not decreased for a long time."""
        p = self._p
        if not max(map(abs, state.tilt.tolist())) >= p.tilt:    # mostly; the rest costs more
            self._watch(state.stamp)
            return False
        error = max(rotations.geodesic_angle(state.quaternion, given.quaternion) / p.angle,
                    dist(given.position.tolist(), state.position.tolist()) / p.distance)
        elapsed, self._seen = state.stamp - self._seen, state.stamp
        if error > max(1.0, self._progress()):
            self._missed += elapsed
        elif error > 1.0:
            self._least, self._missed = error, 0.0
        else:       # the error may oscillate about its limit: the longer side decides
            self._missed = max(0.0, self._missed - elapsed)
        return self._missed >= p.patience

    def _progress(self):
        """Error below which there is progress."""
        if self._least == inf:
            return inf
        return self._least - max((1 - self._p.progress) * self._least,
                                 min(STEP, 0.5 * self._least))

    def _through(self, state, given):
        position = given.position.copy()
        position[2] = max(position[2], self._p.height)
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
            self._until = state.stamp + self._p.duration
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
    tilts = tilts_at_end(levels, goal, axes)
    failures = np.zeros(HEADINGS)
    for wound in failed:
        failures += np.all(np.abs(tilts - wound) < np.pi, axis=1)
    best = np.lexsort((cost, failures))[0]      # by failures, then by cost
    return levels[int(best)].as_quat()
