"""
The way up and down: turns to level that the joints can follow, and vertical speed.

In a slow turn each tilt is the angle of world's up about the rotor's arm. The tilts therefore
follow from the path of the up direction in the body frame. The joints have stops, and a joint near
half a turn can reach level only along paths on its own side. If an arm points upward, its thrust
cannot carry weight: there a joint that is wound in the wrong direction can turn over with little
loss. The planner compares paths of the up direction: the direct path, paths through the horizontal
plane of the body, and paths through upward arms. A joint may begin within the margin of its stop
if the path leads it away at once.

If both joints of a pair of opposite arms are wound in the same direction, one of them must turn
back by a full turn on every path, during which its thrust points in wrong directions.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from beetle_omni_ros.control.base import Reference, State
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import Allocator, nearest_turn, ROTORS

UP = np.array([0.0, 0.0, 1.0])
TURN = 2 * np.pi
STEP = 0.1              # [rad] between points of a path
VIA = 16                # tested points of the body's horizontal plane
JOINT_RATE = 5.0        # [rad/s] half of what the servos can
MARGIN = 0.1            # [rad] from the joints' stops, for the servos' sag and for control
TURNED_OVER = 1.0       # [rad] in one step: the thrust points in a wrong direction meanwhile
UNLOADED = 0.3          # [-] of its hover thrust is the loss if a rotor without load turns over,
                        # because its small thrust controls the attitude
HALTED = 1.0            # [rad/s] a slower turn ends by itself within 0.2 rad
COAST = 0.3             # [s] of the horizontal velocity, in which a fast robot brakes; without it
                        # braking costs a robot with a weak pack its height
MISSING_THRUST = 20.0   # [s] of one second without one hover thrust of lift, as time: turning a
                        # joint over under load costs more than any detour


def inclination(quaternion: np.ndarray) -> float:
    """Angle between the body's z axis and up [rad]."""
    return float(np.arccos(np.clip(rotations.matrix(quaternion)[2, 2], -1.0, 1.0)))


def halting(state: State, height: float) -> Reference | None:
    """
    Reference of a robot that turns fast, until the turn has ended, then None.

    The turn is braked and the height [m] held. An attitude to return to, or a horizontal velocity
    to brake, would need thrust directions that the joints reach too late.
    """
    rate = state.angular_velocity
    if rate.dot(rate) < HALTED**2:
        return None
    (x, y, z), (u, v, w) = state.position, state.velocity
    return Reference(np.array([x, y, max(z, height)]), state.quaternion,
                     np.array([u, v, max(w, 0.0)]), np.zeros(3))


def coasted(state: State) -> np.ndarray:
    """Position (3,) in world at which a robot in motion comes to rest [m]."""
    return state.position + COAST * np.array([*state.velocity[:2], 0.0])


class Way:
    """
    An attitude that turns along a path with piecewise constant rates.

    Args:
        times: (P,) increasing [s]; at rest at the start until the first.
        quaternions: (P, 4) base_link to world, xyzw.

    """

    def __init__(self, times: np.ndarray, quaternions: np.ndarray):
        self._times, self._quaternions = times, quaternions
        self._turns = [rotations.log(rotations.multiply(rotations.conjugate(a), b))
                       for a, b in zip(quaternions[:-1], quaternions[1:])]
        self.duration = float(times[-1])    # until rest [s]

    def at(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Attitude (4,) and body rate (3,) [rad/s], ``elapsed`` [s] after the start."""
        times = self._times
        if elapsed >= times[-1]:
            return self._quaternions[-1], np.zeros(3)
        if elapsed <= times[0]:
            return self._quaternions[0], np.zeros(3)
        k = int(np.searchsorted(times, elapsed, side='right')) - 1
        length = times[k + 1] - times[k]
        turn = rotations.exp((elapsed - times[k]) / length * self._turns[k])
        return rotations.multiply(self._quaternions[k], turn), self._turns[k] / length


class Ramp:
    """
    A target that climbs or sinks with a speed profile while its attitude turns.

    Args:
        stamp: when it starts [s].
        position: (3,) start in world [m].
        way: of the attitude.
        knots: times after the start [s] with vertical speeds [m/s], upwards positive; linear
            between them, and the last speed is kept.

    Attributes:
        duration: until the last knot and the end of the way [s].

    """

    def __init__(self, stamp: float, position: np.ndarray, way: Way,
                 knots: list[tuple[float, float]]):
        self.stamp, self.position, self.way = stamp, position, way
        self._times, self._speeds = np.array(knots).T
        self._rises = np.concatenate([[0.0], np.cumsum(
            0.5 * (self._speeds[1:] + self._speeds[:-1]) * np.diff(self._times))])
        self.duration = max(way.duration, float(self._times[-1]))

    def at(self, time: float) -> Reference:
        """The reference at ``time``."""
        elapsed = max(0.0, time - self.stamp)
        quaternion, rate = self.way.at(elapsed)
        speed = np.interp(elapsed, self._times, self._speeds)
        k = max(0, int(np.searchsorted(self._times, elapsed, side='right')) - 1)
        rise = self._rises[k] + 0.5 * (self._speeds[k] + speed) * (elapsed - self._times[k])
        return Reference(self.position + rise * UP, quaternion, speed * UP, rate)


def climb(height: float, speed: float, acceleration: float) -> list[tuple[float, float]]:
    """Knots of a climb by ``height`` [m] with at most ``speed`` [m/s], at rest at both ends."""
    speed = min(speed, sqrt(height * acceleration))
    rise, total = speed / acceleration, height / speed + speed / acceleration
    return [(0.0, 0.0), (rise, speed), (total - rise, speed), (total, 0.0)]


def plan(quaternion: np.ndarray, tilt: np.ndarray, allocator: Allocator, rate: float) -> Way:
    """Plan the turn to level that the joints, at ``tilt`` (4,) [rad], can follow best."""
    up = rotations.matrix(quaternion)[2]
    paths = [_path(corners) for corners in _corners(up, allocator.axes)]
    longest = max(map(len, paths))
    # One array: shorter paths stay level at their end.
    ups = np.array([np.concatenate([path, np.tile(UP, (longest - len(path), 1))])
                    for path in paths])
    waits, lost = _follow(tilt, ups, allocator)
    turns = np.arccos(np.clip((ups[:, 1:] * ups[:, :-1]).sum(axis=2), -1, 1))
    times = np.maximum(np.concatenate([np.zeros((len(ups), 1)), turns], axis=1) / rate, waits)
    k = int(np.argmin(times.sum(axis=1) + MISSING_THRUST * lost))
    path, attitudes = paths[k], [rotations.normalized(quaternion)]
    for a, b in zip(path[:-1], path[1:]):       # smallest turns from one up to the next
        axis = np.cross(b, a)
        sine = np.linalg.norm(axis)
        turn = axis / sine * np.arctan2(sine, a @ b) if sine > 1e-12 else np.zeros(3)
        attitudes.append(rotations.normalized(rotations.multiply(attitudes[-1],
                                                                 rotations.exp(turn))))
    return Way(np.cumsum(times[k, :len(path)]), np.array(attitudes))


def _corners(start, arms):
    """Corner points of the compared paths of the up direction."""
    heading = np.linspace(0, TURN, VIA, endpoint=False)
    ring = np.stack([np.cos(heading), np.sin(heading), np.zeros(VIA)], axis=1)
    ways = [(start, UP), *((start, via, UP) for via in (*ring, *arms)), *(
        (start, one, other, UP) for one in arms for other in arms if abs(one @ other) < 0.9)]
    return [way for way in ways if start @ way[1] > -1 + 1e-9]


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


def _follow(tilt, ups, allocator):
    """Times (N, P) [s] that the joints need for each step of N paths, and lift lost (N,) [s]."""
    # A joint uses the nearest angle within its stops, as in the allocation. Lost lift is the
    # thrust of a rotor times the time for which it points in a wrong direction, in hover thrusts.
    shape = ups.shape[:2] + (ROTORS,)
    angles, thrusts = (x.reshape(shape) for x in allocator.upright(ups.reshape(-1, 3)))
    limit, hover = allocator.tilt_limit - MARGIN, np.linalg.norm(allocator.weight) / ROTORS
    shares = np.maximum(thrusts / hover, UNLOADED)
    present, waits, lost = np.tile(tilt, (len(ups), 1)), np.zeros(shape[:2]), np.zeros(len(ups))
    for k in range(shape[1]):
        angle = angles[:, k]
        goal = nearest_turn(angle, present)
        if k:       # at the start a joint may be nearer to its stop, if the path leads away
            goal = np.where(np.abs(goal) > limit, angle, goal)
        moves = np.abs(goal - present)
        time = moves / JOINT_RATE
        waits[:, k] = time.max(axis=1)
        lost += (shares[:, k] * np.where(moves > TURNED_OVER, time, 0.0)).sum(axis=1)
        present = goal
    return waits, lost
