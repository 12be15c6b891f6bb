"""How noisy the MoCap really is, seen from its poses alone."""

from bisect import bisect_left, insort
from collections import deque

import numpy as np

from beetle_omni_ros.estimation.parameters import MocapParameters
from beetle_omni_ros.robot import rotations

POSES = 4        # a third difference needs four
GAIN = 20.0      # variance of the third difference of white noise: 1 + 9 + 9 + 1
MEDIAN = 2.366   # of the chi-square distribution with 3 degrees of freedom
WINDOW = 200     # differences of which the median is taken
ENOUGH = 20      # differences before it says anything
TRUSTED = 2.0    # excess of variance that chance hardly gives
EVEN = 0.1       # relative difference of intervals still taken as even


class RunningMedian:
    """Median of the last ``WINDOW`` values."""

    def __init__(self):
        self._recent: deque = deque()
        self._sorted: list[float] = []

    def add(self, value: float) -> None:
        """Take a value; forget the oldest when the window is full."""
        self._recent.append(value)
        insort(self._sorted, value)
        if len(self._recent) > WINDOW:
            del self._sorted[bisect_left(self._sorted, self._recent.popleft())]

    @property
    def value(self) -> float:
        """The median; 0 before there are enough values."""
        count = len(self._sorted)
        return self._sorted[count // 2] if count >= ENOUGH else 0.0


class NoiseMonitor:
    """
    Compares the noise of position and orientation with what the parameters claim.

    The third difference of evenly spaced poses removes smooth motion and keeps noise. It needs
    no filter state, so it works before the first fix and cannot argue with the gate; its median
    over a window does not care for jumps and outliers, even when one pose in ten is wrong.
    """

    def __init__(self, mocap: MocapParameters):
        self._claims = [MEDIAN * GAIN * mocap.position_noise ** 2,
                        MEDIAN * GAIN * mocap.orientation_noise ** 2]
        self._limit = mocap.noise_scale_limit ** 2
        self._last: tuple | None = None
        self._moves: deque = deque(maxlen=POSES - 1)  # (translation, rotation vector, interval)
        self._medians = RunningMedian(), RunningMedian()

    @property
    def scale(self) -> tuple[float, ...]:
        """Factors >= 1 on the claimed variances of position and orientation."""
        ratios = [median.value / claim for median, claim in zip(self._medians, self._claims)]
        return tuple(min(ratio, self._limit) if ratio > TRUSTED else 1.0 for ratio in ratios)

    def add(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Take one pose: stamp [s], (3,) [m], (4,) unit."""
        last, self._last = self._last, (stamp, position, quaternion)
        if last is None:
            return
        turn = rotations.log(rotations.multiply(
            rotations.conjugate(last[2]).tolist(), quaternion.tolist()))
        self._moves.append((position - last[1], turn, stamp - last[0]))
        if len(self._moves) < POSES - 1:
            return
        moves, turns, intervals = zip(*self._moves)
        if max(intervals) - min(intervals) > EVEN * max(intervals):
            return
        for (first, second, third), median in zip((moves, turns), self._medians):
            excess = third - 2 * second + first
            median.add(float(excess @ excess))
