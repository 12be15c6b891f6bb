"""
Attitudes on the way between two others, by the joint angles along the turns.

In a slow turn every thrust points upward as far as its arm permits. The tilts therefore follow
from the path of world's z in the body frame, except for full turns, whose number follows from the
initial tilts.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

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
    failures = np.zeros(HEADINGS)
    for wound in failed:
        failures += np.all(np.abs(tilts - wound) < np.pi, axis=1)
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
