"""Measurement of the MoCap's noise from its poses alone."""

from bisect import bisect_left, insort
from collections import deque

import numpy as np

from beetle_omni_ros.estimation.parameters import MocapParameters
from beetle_omni_ros.robot import rotations

POSES = 4        # a third difference needs four
GAIN = 20.0      # variance of the third difference of white noise: 1 + 9 + 9 + 1
MEDIAN = 2.366   # of the chi-square distribution with 3 degrees of freedom
WINDOW = 200     # differences in a median
MIN_COUNT = 20   # differences before the first result
SIGNIFICANT = 2.0    # excess of variance that is unlikely by chance
EVEN = 0.1       # largest relative difference of equal intervals


class RunningMedian:
    """Median of the last ``WINDOW`` values."""

    def __init__(self):
        self._recent: deque = deque()
        self._sorted: list[float] = []

    def add(self, value: float) -> None:
        """Add a value; remove the oldest if the window is full."""
        self._recent.append(value)
        insort(self._sorted, value)
        if len(self._recent) > WINDOW:
            del self._sorted[bisect_left(self._sorted, self._recent.popleft())]

    @property
    def value(self) -> float:
        """The median; 0 with fewer than ``MIN_COUNT`` values."""
        count = len(self._sorted)
        return self._sorted[count // 2] if count >= MIN_COUNT else 0.0


class NoiseMonitor:
    """
    Compares the noise of position and orientation with the parameters' values.

    The third difference of evenly spaced poses removes smooth motion and keeps noise. It needs no
    filter state. It is therefore available before the first fix and independent of the gate. Its
    median over a window is robust against jumps and outliers, even one wrong pose in ten.
    """

    def __init__(self, mocap: MocapParameters):
        self._nominal = [MEDIAN * GAIN * mocap.position_noise ** 2,
                         MEDIAN * GAIN * mocap.orientation_noise ** 2]
        self._limit = mocap.noise_scale_limit ** 2
        self._last: tuple | None = None
        self._moves: deque = deque(maxlen=POSES - 1)  # (translation, rotation vector, interval)
        self._medians = RunningMedian(), RunningMedian()

    @property
    def scale(self) -> tuple[float, ...]:
        """Factors >= 1 on the nominal variances of position and orientation."""
        ratios = [median.value / nominal
                  for median, nominal in zip(self._medians, self._nominal)]
        return tuple(min(ratio, self._limit) if ratio > SIGNIFICANT else 1.0 for ratio in ratios)

    def add(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Add one pose: stamp [s], (3,) [m], (4,) unit."""
        last, self._last = self._last, (stamp, position, quaternion)
        if last is None:
            return
        x, y, z, w = last[2].tolist()
        turn = rotations.log(rotations.product(-x, -y, -z, w, *quaternion.tolist()))
        self._moves.append((position - last[1], turn, stamp - last[0]))
        if len(self._moves) < POSES - 1:
            return
        moves, turns, intervals = zip(*self._moves)
        if max(intervals) - min(intervals) > EVEN * max(intervals):
            return
        for (first, second, third), median in zip((moves, turns), self._medians):
            excess = third - 2 * second + first
            median.add(float(excess.dot(excess)))
