"""
Turns back to level that the joints can follow.

In a slow turn each tilt is the angle of world's up about the rotor's arm. The tilts therefore
follow from the path of the up direction in the body frame. The joints have stops, and a joint near
half a turn can reach level only along paths on its own side. If an arm points upward, its thrust
cannot carry weight: there a joint that is wound in the wrong direction can turn over with little
loss. The planner compares paths of the up direction: the direct path, paths through the horizontal
plane of the body, and paths through upward arms. A joint may begin within the margin of its stop
if the path leads it away at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator, nearest_turn, ROTORS
from beetle_omni_ros.robot.schema import parameter

UP = np.array([0.0, 0.0, 1.0])
STEP = 0.1              # [rad] between points of a path
VIA = 16                # tested points of the body's horizontal plane
TURNED_OVER = 1.0       # [rad] in one step: the thrust points in a wrong direction meanwhile
UNLOADED = 0.3          # [-] of its hover thrust is the loss if a rotor without load turns over,
                        # because its small thrust controls the attitude


@dataclass(frozen=True, kw_only=True)
class LevellingParameters:
    """Rates of levelling."""

    rate: float = parameter(0.8, doc='angular rate of the body', unit='rad/s', low=0.05, high=5)
    joint_rate: float = parameter(
        5.0, doc='joint rate for which turns of the body are planned', unit='rad/s', low=0.5,
        high=50)
    margin: float = parameter(
        0.1, doc='smallest distance of the tilts from their stops', unit='rad', low=0, high=1)
    missing_thrust: float = parameter(
        20.0, doc='cost of one second without one hover thrust of lift, as time', unit='s', low=0,
        high=1000)


class Way:
    """
    An attitude that turns along a path with piecewise constant rates.

    Args:
        times: (P,) increasing [s]; at rest at the start until the first.
        quaternions: (P, 4) base_link to world, xyzw.
        lost: lift lost by joints that turn over, in hover thrusts of one rotor times [s].

    """

    def __init__(self, times: np.ndarray, quaternions: np.ndarray, lost: float = 0.0):
        self._times, self._quaternions, self.lost = times, quaternions, lost
        self._turns = [rotations.log(rotations.multiply(rotations.conjugate(a), b))
                       for a, b in zip(quaternions[:-1], quaternions[1:])]

    @classmethod
    def straight(cls, start: np.ndarray, goal: np.ndarray, rate: float) -> Way:
        """The shortest turn between two attitudes (4,) at ``rate`` [rad/s]."""
        angle = rotations.geodesic_angle(goal, start)
        if angle < 1e-9:
            return cls(np.zeros(1), np.array([goal]))
        return cls(np.array([0.0, angle / rate]), np.array([start, goal]))

    def ended(self) -> Way:
        """The end of the way, held."""
        return Way(np.zeros(1), self._quaternions[-1:])

    @property
    def duration(self) -> float:
        """Duration until rest [s]."""
        return float(self._times[-1])

    @property
    def goal(self) -> np.ndarray:
        """(4,) attitude at the end."""
        return self._quaternions[-1]

    def at(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Attitude (4,) and body rate (3,) [rad/s], ``elapsed`` [s] after the start."""
        times = self._times
        if elapsed >= times[-1]:
            return self._quaternions[-1], np.zeros(3)
        if elapsed <= times[0]:
            return self._quaternions[0], np.zeros(3)
        k = int(np.searchsorted(times, elapsed, side='right')) - 1
        length = times[k + 1] - times[k]
        part = (elapsed - times[k]) / length
        return rotations.multiply(self._quaternions[k], rotations.exp(part * self._turns[k])), \
            self._turns[k] / length


def plan(quaternion: np.ndarray, tilt: np.ndarray, allocator: Allocator,
         p: LevellingParameters) -> Way:
    """
    Plan the turn to level that the joints can follow best.

    Args:
        quaternion: (4,) present attitude, base_link to world, xyzw.
        tilt: (4,) present tilt angles [rad].
        allocator: of the robot.
        p: rates.

    Returns:
        the way, from the present attitude to a level one.

    """
    paths, times, lost, best = _compare(quaternion, tilt[None], allocator, p)
    k = int(best[0])
    return _way(quaternion, paths[k], times[0, k, :len(paths[k])], float(lost[0, k]))


def lost_lift(quaternion: np.ndarray, tilts: np.ndarray, allocator: Allocator,
              p: LevellingParameters) -> np.ndarray:
    """Lost lift (W,) of the planned way, see :class:`Way`, for each of the tilts (W, 4) [rad]."""
    _, _, lost, best = _compare(quaternion, tilts, allocator, p)
    return lost[np.arange(len(best)), best]


def _compare(quaternion, tilts, allocator, p):
    """Paths of the up direction, their times (W, N, P), lost lift (W, N), and the best (W,)."""
    paths = [_path(corners) for corners in _corners(rotations.up(quaternion), allocator)]
    longest = max(map(len, paths))
    # One array: shorter paths stay level at their end.
    up = np.array([np.concatenate([path, np.tile(UP, (longest - len(path), 1))])
                   for path in paths])
    waits, lost = _follow(tilts, up, allocator, p)
    times = np.maximum(_angles_between(up) / p.rate, waits)
    return paths, times, lost, np.argmin(times.sum(axis=2) + p.missing_thrust * lost, axis=1)


def _corners(start, allocator):
    """Corner points of the compared paths of the up direction."""
    heading = np.linspace(0, 2 * np.pi, VIA, endpoint=False)
    ring = np.stack([np.cos(heading), np.sin(heading), np.zeros(VIA)], axis=1)
    arms = allocator.axes
    ways: list[tuple[np.ndarray, ...]] = [] if start[2] < -1 + 1e-9 else [(start, UP)]
    ways += [(start, side, UP) for side in ring if start @ side > -1 + 1e-9]
    ways += [(start, arm, UP) for arm in arms if start @ arm > -1 + 1e-9]
    return ways + [(start, one, other, UP) for one in arms for other in arms
                   if abs(one @ other) < 0.9 and start @ one > -1 + 1e-9]


def _path(corners):
    """Points (P, 3) along great circles between corners."""
    points = [corners[0][None]]
    for a, b in zip(corners[:-1], corners[1:]):
        angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
        parts = np.linspace(0, 1, max(1, int(np.ceil(angle / STEP))) + 1)[1:, None]
        if angle > 1e-6:
            points.append((np.sin((1 - parts) * angle) * a + np.sin(parts * angle) * b)
                          / np.sin(angle))
    return np.concatenate(points)


def _angles_between(up):
    """Angles (N, P) from the point before [rad], the first 0."""
    cosine = np.clip((up[:, 1:] * up[:, :-1]).sum(axis=2), -1, 1)
    return np.concatenate([np.zeros((len(up), 1)), np.arccos(cosine)], axis=1)


def _follow(tilts, up, allocator, p):
    """
    Times (W, N, P) [s] that the joints need for each step of N paths, and lift lost (W, N) [s].

    A joint uses the nearest angle within its stops, as in the allocation. Lost lift is the thrust
    of a rotor times the time for which it points in a wrong direction, in hover thrusts.
    """
    shape = up.shape[:2] + (ROTORS,)
    angles, thrusts = (x.reshape(shape) for x in allocator.upright(up.reshape(-1, 3)))
    limit, hover = allocator.tilt_limit - p.margin, np.linalg.norm(allocator.weight) / ROTORS
    shares = np.maximum(thrusts / hover, UNLOADED)
    present = np.tile(np.asarray(tilts, dtype=float)[:, None], (1, len(up), 1))
    waits, lost = np.zeros((len(tilts), *shape[:2])), np.zeros((len(tilts), len(up)))
    for k in range(shape[1]):
        angle = angles[:, k]
        goal = nearest_turn(angle, present)
        if k:       # at the start a joint may be nearer to its stop, if the path leads away
            goal = np.where(np.abs(goal) > limit, angle, goal)
        moves = np.abs(goal - present)
        time = moves / p.joint_rate
        waits[..., k] = time.max(axis=2)
        lost += (shares[:, k] * np.where(moves > TURNED_OVER, time, 0.0)).sum(axis=2)
        present = goal
    return waits, lost


def _way(quaternion, path, times, lost):
    """Attitudes along a path: smallest turns from one up direction to the next."""
    attitudes = [rotations.normalized(quaternion)]
    for a, b in zip(path[:-1], path[1:]):
        axis = np.cross(b, a)
        sine = np.linalg.norm(axis)
        turn = axis / sine * np.arctan2(sine, a @ b) if sine > 1e-12 else np.zeros(3)
        attitudes.append(rotations.normalized(rotations.multiply(attitudes[-1],
                                                                 rotations.exp(turn))))
    return Way(np.cumsum(times), np.array(attitudes), lost)
