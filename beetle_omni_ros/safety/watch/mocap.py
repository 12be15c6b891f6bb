"""MoCap that contradicts the estimate, and which of the two is to blame."""

from __future__ import annotations

from math import sqrt

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.safety.watch.parameters import MocapLimits

AGE = 0.05              # [s] by which pose and estimate may be apart
LONGEST = 0.1           # [s] between two poses across which a jump is seen
FASTEST = 6.0           # [m/s] nothing that flies in the hall is faster


class MocapWatch:
    """
    Looks for jumps that no body makes, for repeated values, and for lasting contradiction.

    Args:
        limits: thresholds.

    Attributes:
        good: whether the last pose may be used.
        jumped: whether MoCap itself jumped, since when it contradicts the estimate.
        contradicts: whether pose and estimate have contradicted each other for long enough.
        displaced: whether the position jumped, and has long contradicted the estimate's.

    """

    def __init__(self, limits: MocapLimits):
        self._p = limits
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self._stamp = -np.inf
        self._quaternion: np.ndarray | None = None
        self._position: np.ndarray | None = None
        self._values: tuple[float, ...] | None = None
        self._moved = False
        self._same = self._off = self._far = 0
        self.good, self.jumped, self.contradicts, self.displaced = True, False, False, False

    @property
    def frozen(self) -> bool:
        """Whether the pose repeats itself."""
        return self._same >= self._p.frozen

    def on_pose(self, stamp: float, position: np.ndarray, quaternion: np.ndarray,
                attitude: np.ndarray | None, rate: np.ndarray | None,
                place: np.ndarray | None = None, velocity: np.ndarray | None = None) -> None:
        """
        Take a pose.

        Args:
            stamp: of its capture [s].
            position: (3,) in world [m].
            quaternion: (4,) xyzw.
            attitude: (4,) of the estimate of about that time, None: there is none.
            rate: (3,) measured body rate [rad/s], None: there is none.
            place: (3,) of the estimate of about that time [m], None: there is none.
            velocity: (3,) likewise [m/s].

        """
        values = (*np.asarray(position, dtype=float).tolist(),
                  *np.asarray(quaternion, dtype=float).tolist())
        self._same = self._same + 1 if values == self._values else 0
        self._values = values
        dt, before = stamp - self._stamp, self._quaternion
        now = rotations.normalized(quaternion)
        self._stamp, self._quaternion = stamp, now
        turning = 0.0 if rate is None else _length(rate)
        if before is not None and 0 < dt < LONGEST and rotations.geodesic_angle(
                before, now) > self._p.attitude + turning * dt:
            self.jumped = True
        off = attitude is not None and rotations.geodesic_angle(
            attitude, now) > self._p.attitude + turning * AGE
        far = self._is_far(dt, np.asarray(position, dtype=float), place, velocity)
        self._off = self._off + 1 if off or far else 0
        self._far = self._far + 1 if far and self._moved else 0
        self.jumped &= off
        self.displaced = self._far >= self._p.displaced
        self.contradicts = self._off >= self._p.lasting and not self._moved
        self.good = not off and not far and not self.frozen

    def _is_far(self, dt, position, place, velocity) -> bool:
        """Whether the position is not the estimate's, and whether it jumped there."""
        before, self._position = self._position, position
        if before is not None and 0 < dt < LONGEST \
                and _length(position - before) > self._p.distance + FASTEST * dt:
            self._moved = True
        far = place is not None \
            and _length(position - place) > self._p.distance + _length(velocity) * AGE
        self._moved &= far
        return far


def _length(vector):
    """As np.linalg.norm, for a fraction of its time."""
    return sqrt(float(vector @ vector))
