"""
Apparent gravity: a large external force as a part of gravity.

A constant force cannot be distinguished from gravity. A policy that does not observe the force
flies in a world that is turned until the sum of both points down. Its thrusts are scaled by this
sum over the weight.
"""

from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import Reference, State
from beetle_omni_ros.model import rotations

# Shares of the weight. Smaller forces are left to the policy, which is trained with them; larger
# ones are a part of gravity entirely.
LEAVE, TAKE = 0.17, 0.5
SWITCH = 0.1            # the sum points up if it does by this; a sum of twice this has a direction
LEAST_SCALE = 0.5       # of thrusts; with 0.25 a force of 40 N was lost
OVER = np.array([1.0, 0.0, 0.0, 0.0])       # half a turn about x


class ApparentGravity:
    """
    The world in which a policy without an estimate of the force flies.

    Args:
        weight: of the robot [N].

    Attributes:
        scale: of the thrusts.

    """

    def __init__(self, weight: float):
        self._weight = weight
        self.reset()

    def reset(self) -> None:
        """No force."""
        self.scale, self._over = 1.0, False
        self._turn: np.ndarray | None = None

    def update(self, force: np.ndarray) -> None:
        """Take the estimated external force (3,) in world [N]."""
        size = float(np.linalg.norm(force)) / self._weight
        if size <= LEAVE:
            self.reset()
            return
        share = min((size - LEAVE) / (TAKE - LEAVE), 1.0)
        need = np.array([0.0, 0.0, 1.0]) - share / self._weight * force     # thrust over weight
        length = float(np.linalg.norm(need))
        self.scale = min(max(length, LEAST_SCALE), 1.0)
        if abs(need[2]) > SWITCH:
            self._over = bool(need[2] < 0)
        if length > 2 * SWITCH:
            x, y, z = (need / length).tolist()
            # the shortest turn of the thrust to z, after half a turn if it points down
            turn = np.array([-y, -x, 0.0, 1 - z]) if self._over else np.array([y, -x, 0.0, 1 + z])
            turn /= np.linalg.norm(turn)
            self._turn = rotations.multiply(turn, OVER) if self._over else turn
        else:
            self._turn = OVER if self._over else None

    def seen(self, state: State, reference: Reference) -> tuple[State, Reference]:
        """State and reference in the turned world."""
        if self._turn is None:
            return state, reference
        turn, to_turned = self._turn, rotations.matrix(self._turn)
        return replace(state, position=to_turned @ state.position,
                       velocity=to_turned @ state.velocity,
                       quaternion=rotations.multiply(turn, state.quaternion)), Reference(
            to_turned @ reference.position, rotations.multiply(turn, reference.quaternion),
            to_turned @ reference.velocity, reference.angular_velocity)
