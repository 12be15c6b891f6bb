"""The target of a robot that is driven by hand: a goal, and the limited way to it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beetle_omni_ros.drive.parameters import DriveParameters
from beetle_omni_ros.robot import rotations

NEAR = 1e-9     # [m, rad] from the goal that is no way any more


class Steering:
    """
    Moves a target towards a goal, never faster than the limits.

    Args:
        parameters: limits.
        why_not: position (3,) [m] and quaternion (4,) -> '' where the pose may be flown, else why
            it may not.
        position: (3,) in world at which it begins [m].
        quaternion: (4,) body to world at which it begins.

    Attributes:
        position, quaternion: the target to fly now.
        goal: position and quaternion to which it goes.

    """

    def __init__(self, parameters: DriveParameters,
                 why_not: Callable[[np.ndarray, np.ndarray], str], position: np.ndarray,
                 quaternion: np.ndarray):
        self._p, self._why_not = parameters, why_not
        self.position, self.quaternion = np.array(position, dtype=float), np.array(quaternion)
        self.goal = self.position, self.quaternion

    @property
    def arrived(self) -> bool:
        """Whether the target is at its goal."""
        return float(np.linalg.norm(self.goal[0] - self.position)) < NEAR \
            and rotations.geodesic_angle(self.goal[1], self.quaternion) < 1e-6

    def go(self, position: np.ndarray, quaternion: np.ndarray) -> str:
        """Set the goal; '' or why it may not be flown, and the goal stays."""
        reason = self._why_not(position, quaternion)
        if not reason:
            self.goal = np.array(position, dtype=float), rotations.normalized(quaternion)
        return reason

    def shift(self, way: np.ndarray, turn: np.ndarray) -> str:
        """
        Shift the goal; as :meth:`go`.

        Args:
            way: (3,) along world's axes [m].
            turn: (3,) roll and pitch about the body's axes, yaw about world's z [rad].

        """
        position, quaternion = self.goal
        tilted = rotations.multiply(quaternion, rotations.exp([turn[0], turn[1], 0.0]))
        return self.go(position + way, rotations.multiply(
            rotations.exp([0.0, 0.0, turn[2]]), tilted))

    def hold(self) -> None:
        """Stay where the target is now."""
        self.goal = self.position, self.quaternion

    def update(self, seconds: float, robot: np.ndarray | None = None) -> str:
        """
        Move the target on.

        Args:
            seconds: since the last update.
            robot: (3,) where the robot is [m]; a target that is a leash ahead waits.

        Returns:
            '' or why the way may not be flown; then the target stays where it is.

        """
        if self.arrived:
            return ''
        way = self.goal[0] - self.position
        distance = float(np.linalg.norm(way))
        position = self.position + way * min(1.0, self._p.speed * seconds / max(distance, NEAR))
        turn = rotations.log(rotations.multiply(rotations.conjugate(self.quaternion),
                                                self.goal[1]))
        angle = float(np.linalg.norm(turn))
        quaternion = rotations.normalized(rotations.multiply(self.quaternion, rotations.exp(
            turn * min(1.0, self._p.rate * seconds / max(angle, NEAR)))))
        if robot is not None and np.linalg.norm(position - robot) > self._p.leash \
                and np.linalg.norm(position - robot) > np.linalg.norm(self.position - robot):
            position = self.position
        reason = self._why_not(position, quaternion)
        if reason:
            self.hold()
            return reason
        self.position, self.quaternion = position, quaternion
        return ''
