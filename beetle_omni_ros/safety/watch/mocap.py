"""Detection of contradictions between MoCap and estimate, and their cause."""

from math import sqrt

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.safety.watch.parameters import MocapLimits

AGE = 0.05              # [s] largest time between pose and estimate
LONGEST = 0.1           # [s] largest time between two poses for the detection of a jump
FASTEST = 6.0           # [m/s] largest speed of a robot in a hall


class MocapWatch:
    """
    Detects impossible jumps, repeated values, and lasting contradictions.

    Args:
        limits: thresholds.

    Attributes:
        good: whether the last pose may be used.
        jumped: whether the contradiction began with a jump of MoCap.
        contradicts: whether pose and estimate have contradicted each other for long enough.
        displaced: whether the position jumped and has contradicted the estimate for long enough.

    """

    def __init__(self, limits: MocapLimits):
        self._p = limits
        self.reset()

    def reset(self) -> None:
        """Reset the detector."""
        self._stamp = -np.inf
        self._quaternion: list[float] | None = None
        self._position: np.ndarray | None = None
        self._values: list[float] | None = None
        self._moved = False
        self._same = self._off = self._far = 0
        self.good, self.jumped, self.contradicts, self.displaced = True, False, False, False

    @property
    def frozen(self) -> bool:
        """Whether equal poses repeat."""
        return self._same >= self._p.frozen

    def on_pose(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                attitude: np.ndarray | None, rate: np.ndarray | None,
                place: np.ndarray | None = None, velocity: np.ndarray | None = None) -> None:
        """
        Receive a pose.

        Args:
            stamp: of its capture [s].
            position: (3,) in world [m].
            quaternion: (4,) xyzw, unit.
            attitude: (4,) of the estimate of about that time, None: there is none.
            rate: (3,) measured body rate [rad/s], None: there is none.
            place: (3,) of the estimate of about that time [m], None: there is none.
            velocity: (3,) likewise [m/s].

        """
        values = position.tolist() + quaternion.tolist()
        self._same = self._same + 1 if values == self._values else 0
        self._values = values
        dt, before = stamp - self._stamp, self._quaternion
        now = quaternion.tolist()
        self._stamp, self._quaternion = stamp, now
        turning = 0.0 if rate is None else _length(rate)
        if before is not None and 0 < dt < LONGEST and rotations.geodesic_angle(
                before, now) > self._p.attitude + turning * dt:
            self.jumped = True
        off = attitude is not None and rotations.geodesic_angle(
            attitude, now) > self._p.attitude + turning * AGE
        far = self._is_far(dt, position, place, velocity)
        self._off = self._off + 1 if off or far else 0
        self._far = self._far + 1 if far and self._moved else 0
        self.jumped &= off
        self.displaced = self._far >= self._p.displaced
        self.contradicts = self._off >= self._p.lasting and not self._moved
        self.good = not off and not far and not self.frozen

    def _is_far(self, dt, position, place, velocity) -> bool:
        """Whether the position contradicts the estimate, and whether it jumped."""
        before, self._position = self._position, position
        if before is not None and 0 < dt < LONGEST \
                and _length(position - before) > self._p.distance + FASTEST * dt:
            self._moved = True
        far = place is not None \
            and _length(position - place) > self._p.distance + _length(velocity) * AGE
        self._moved &= far
        return far


def _length(vector):
    """Norm, faster than np.linalg.norm."""
    return sqrt(vector.dot(vector))
