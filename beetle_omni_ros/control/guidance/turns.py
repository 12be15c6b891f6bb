"""
Joint angles along turns of a robot with tilting rotors.

In a slow turn every thrust points upward as far as its arm permits. The tilts therefore follow
from the path of world's z in the body frame, except for full turns. The number of full turns
follows from the initial tilts.
"""

import numpy as np
from scipy.spatial.transform import Rotation

STRAIGHT_UP = np.array([0.0, 0.0, 1.0])
POINTS = 16       # of a turn at which the arms are evaluated
LEAST_USE = 0.2   # smallest used share of an arm's thrust that can carry weight


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


def tilts_at_end(start: Rotation, end: Rotation, axes: np.ndarray) -> np.ndarray:
    """
    Tilts (n, 4) [rad] after the shortest turns from level attitudes, all thrusts kept upward.

    Args:
        start: n level attitudes, with all tilts zero.
        end: one attitude or n of them.
        axes: (4, 3) unit tilt axes in base_link.

    """
    return tilts_along(turned(start, end)[1], axes)[:, -1]


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
