"""Target of a robot driven by hand, which moves to a goal at limited speed."""

from collections.abc import Callable

import numpy as np

from beetle_omni_ros.drive.parameters import DriveParameters
from beetle_omni_ros.robot import rotations

NEAR = 1e-9     # [m, rad] distance from the goal that counts as arrived


class Steering:
    """
    Moves a target to a goal within the limits.

    Args:
        parameters: limits of the motion.
        why_not: check of a pose, position (3,) [m] and quaternion (4,); returns '' or the reason
            why it must not be flown.
        position: (3,) initial target in world [m].
        quaternion: (4,) initial target, body to world, xyzw.

    Attributes:
        position, quaternion: present target.
        goal: position and quaternion of the goal.

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
        """Set the goal; return '', or the reason of a refusal, which leaves the goal as it is."""
        reason = self._why_not(position, quaternion)
        if not reason:
            self.goal = np.array(position, dtype=float), rotations.normalized(quaternion)
        return reason

    def shift(self, way: np.ndarray, turn: np.ndarray) -> str:
        """
        Shift the goal; returns as :meth:`go`.

        Args:
            way: (3,) shift in world [m].
            turn: (3,) rotation: roll and pitch about the body's axes, yaw about world's z [rad].

        """
        position, quaternion = self.goal
        tilted = rotations.multiply(quaternion, rotations.exp([turn[0], turn[1], 0.0]))
        return self.go(position + way, rotations.multiply(
            rotations.exp([0.0, 0.0, turn[2]]), tilted))

    def hold(self) -> None:
        """Set the goal to the present target."""
        self.goal = self.position, self.quaternion

    def update(self, seconds: float, robot: np.ndarray | None = None) -> str:
        """
        Move the target.

        Args:
            seconds: time since the last update [s].
            robot: (3,) position of the robot [m]; the target waits at a distance of ``leash``.

        Returns:
            '' or the reason why the next pose must not be flown; then the target stops.

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
