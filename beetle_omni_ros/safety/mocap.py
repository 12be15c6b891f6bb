"""Detection of contradictions between MoCap and estimate, and their cause."""

from math import sqrt

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.robot import rotations

AGE = 0.05              # [s] largest time between pose and estimate
LONGEST = 0.1           # [s] largest time between two poses for the detection of a jump
FASTEST = 6.0           # [m/s] largest speed of a robot in a hall
ATTITUDE = 0.35         # [rad] from the estimate, or jump against the gyroscope
DISTANCE = 0.3          # [m] the same; larger than the error of dead reckoning after 1 s
LASTING = 10            # poses, 0.1 s, of a contradiction
DISPLACED = 30          # poses after a jump; longer than a temporary confusion of markers
FROZEN = 5              # equal poses; noise of 1 mm never repeats exactly


class MocapWatch:
    """
    Detects impossible jumps, repeated values, and lasting contradictions.

    Attributes:
        good: whether the last pose may be used.
        frozen: whether equal poses repeat.
        jumped: whether the contradiction began with a jump of the attitude.
        contradicts: whether pose and estimate have contradicted each other for long enough.
        displaced: whether the position jumped and has contradicted the estimate for long enough.

    """

    def __init__(self):
        self.reset()

    def reset(self) -> None:
        """Reset the detector."""
        self._before: tuple[float, np.ndarray, np.ndarray] | None = None
        self._moved = self.good = self.frozen = False
        self._same = self._off = self._far = 0
        self.jumped = self.contradicts = self.displaced = False

    def on_pose(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                state: State | None) -> None:
        """
        Receive a pose.

        Args:
            stamp: of its capture [s].
            position: (3,) in world [m].
            quaternion: (4,) xyzw, unit.
            state: estimate of about that time, None: there is none.

        """
        before, self._before = self._before, (stamp, position, quaternion)
        turning = 0.0 if state is None else sqrt(state.angular_velocity.dot(
            state.angular_velocity))
        if before is not None:
            dt, moved = stamp - before[0], position - before[1]
            turn = rotations.geodesic_angle(before[2], quaternion)
            self._same = self._same + 1 if not moved.any() and np.array_equal(
                quaternion, before[2]) else 0
            if dt < LONGEST:
                self.jumped |= turn > ATTITUDE + turning * dt
                self._moved |= sqrt(moved.dot(moved)) > DISTANCE + FASTEST * dt
        self.frozen = self._same >= FROZEN
        off = far = False
        if state is not None:
            error = position - state.position
            speed = sqrt(state.velocity.dot(state.velocity))
            off = rotations.geodesic_angle(state.quaternion, quaternion) \
                > ATTITUDE + turning * AGE
            far = sqrt(error.dot(error)) > DISTANCE + speed * AGE
        self._moved &= far
        self.jumped &= off
        self._off = self._off + 1 if off or far else 0
        self._far = self._far + 1 if far and self._moved else 0
        self.displaced = self._far >= DISPLACED
        self.contradicts = self._off >= LASTING and not self._moved
        self.good = not off and not far and not self.frozen
