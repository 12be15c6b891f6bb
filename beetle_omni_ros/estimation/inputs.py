"""Checks of the filter's inputs (finite, plausible, new, in time), and the MoCap's noise."""

from bisect import bisect_left, insort
from collections import Counter, deque
from math import hypot, inf, isfinite, sqrt

import numpy as np

from beetle_omni_ros.estimation.parameters import EkfParameters, MocapParameters
from beetle_omni_ros.model import rotations

Checked = tuple[float, np.ndarray, np.ndarray]   # stamp and two vectors of a sample
GAP = 0.1           # [s] longest bridged time between two IMU samples
RESYNC = 20         # refused consistent stamps in a row after which the clock itself has jumped
FROZEN_READINGS = 10    # equal to the last digit, of a frozen driver; noise never repeats
FORCE_LIMIT, RATE_LIMIT = 160.0, 40.0   # [m/s^2], [rad/s] larger readings are refused
PLACES = 100.0      # [m] largest coordinate of a pose
DELAY_LIMIT = 0.2   # [s] largest age of a pose against the newest IMU sample
UNIT = 0.01         # largest deviation of a quaternion's norm from 1
# Changes of specific force [m/s^2] and rate [rad/s] between two readings that are jumps; full
# thrust and torque cause 1.4 and 0.5.
FORCE_JUMP, RATE_JUMP = 30.0, 3.0
AGREE = 0.5         # squared cosine: two independent errors agree with a probability of 5 %
LONGEST_HELD = 5    # readings

POSES = 4           # a third difference needs four
GAIN = 20.0         # variance of the third difference of white noise: 1 + 9 + 9 + 1
MEDIAN = 2.366      # of the chi-square distribution with 3 degrees of freedom
WINDOW = 200        # differences in a median
MIN_COUNT = 20      # differences before the first result
SIGNIFICANT = 2.0   # excess of variance that is unlikely by chance
EVEN = 0.1          # largest relative difference of equal intervals
LARGEST_SCALE = 20.0    # of the measured noise to that of the parameters


class SpikeFilter:
    """
    Rejects outliers of the IMU: a jump is used only if the next reading confirms it.

    An impact pushes again in about the same direction, and the rate that it causes remains. Two
    independent errors in a row rarely agree in all six axes.
    """

    def __init__(self):
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._held, self._count = np.zeros(6), 0

    def passes(self, force: np.ndarray, rate: np.ndarray) -> bool:
        """Whether a reading (3,) [m/s^2], (3,) [rad/s] is used; False holds it back."""
        if self._last is not None:
            push, turn = force - self._last[0], rate - self._last[1]
            if push.dot(push) > FORCE_JUMP**2 or turn.dot(turn) > RATE_JUMP**2:
                held, self._count = self._held, self._count + 1
                self._held = jump = np.concatenate([push / FORCE_JUMP, turn / RATE_JUMP])
                dot = held.dot(jump)
                agree = dot > 0 and dot**2 >= AGREE * held.dot(held) * jump.dot(jump)
                if not agree and self._count <= LONGEST_HELD:
                    return False
        self._held, self._count, self._last = np.zeros(6), 0, (force, rate)
        return True


class InputGuard:
    """
    Checks of every sample before it changes the state.

    Attributes:
        rejected: reason -> count.
        clock_jumped: whether enough refused stamps of the IMU continue each other.

    """

    def __init__(self, parameters: EkfParameters):
        self._offset = parameters.mocap.time_offset
        self.rejected: Counter = Counter()
        self._last_reading: float | None = None
        self._last_pose = -inf
        self._pose_values: tuple[float, ...] | None = None
        self._reading_values: tuple[float, ...] | None = None
        self._same_reading = 0
        self._spikes = SpikeFilter()
        self._refused: list[float] = []  # consecutive refused stamps at regular distances

    def reading(self, sample) -> Checked | None:
        """Copies of stamp, specific force and rate of an IMU sample, None if it is refused."""
        stamp = float(sample.stamp)
        force = np.array(sample.specific_force, dtype=float)
        rate = np.array(sample.angular_velocity, dtype=float)
        values = (*force.tolist(), *rate.tolist())
        if not all(map(isfinite, (stamp, *values))):
            return self._refuse('not_finite')
        if hypot(*values[:3]) > FORCE_LIMIT or hypot(*values[3:]) > RATE_LIMIT:
            return self._refuse('out_of_range')
        if self._last_reading is not None:
            step = stamp - self._last_reading
            if not 0 < step <= GAP:
                if self._refused and not 0 < stamp - self._refused[-1] <= GAP:
                    self._refused.clear()
                self._refused.append(stamp)
                return self._refuse('duplicate' if step == 0 else
                                    'backwards' if step < 0 else 'forward_gap')
        self._same_reading = self._same_reading + 1 if values == self._reading_values else 0
        self._reading_values = values
        if self._same_reading >= FROZEN_READINGS:
            return self._refuse('frozen')
        if not self._spikes.passes(force, rate):
            return self._refuse('spike')
        self._last_reading = stamp
        self._refused.clear()
        return stamp, force, rate

    @property
    def clock_jumped(self) -> bool:
        """See the class."""
        return len(self._refused) >= RESYNC

    def pose(self, sample, oldest: float) -> Checked | None:
        """
        Stamp on the IMU's clock, position and unit quaternion of a pose, None if it is refused.

        ``oldest`` is the stamp of the oldest stored IMU reading [s].
        """
        stamp = float(sample.stamp) + self._offset
        position = np.array(sample.position, dtype=float)
        quaternion = np.array(sample.quaternion, dtype=float)
        values = (*position.tolist(), *quaternion.tolist())
        if not all(map(isfinite, (stamp, *values))):
            return self._refuse('not_finite')
        if max(map(abs, values[:3])) > PLACES:
            return self._refuse('out_of_range')
        x, y, z, w = values[3:]
        norm = sqrt(x * x + y * y + z * z + w * w)
        if not abs(norm - 1) <= UNIT:
            return self._refuse('quaternion_norm')
        if self._last_reading is None:
            return self._refuse('no_imu')
        if stamp <= self._last_pose:
            return self._refuse('duplicate' if stamp == self._last_pose else 'backwards')
        if stamp < oldest:
            return self._refuse('too_old')
        if stamp > self._last_reading + GAP:
            return self._refuse('future')
        self._last_pose = stamp
        if values == self._pose_values:     # a measured pose never repeats to the last digit
            return self._refuse('frozen')
        self._pose_values = values
        return stamp, position, quaternion / norm

    def _refuse(self, reason: str) -> Checked | None:
        """Count a refusal; return the result of the caller."""
        self.rejected[reason] += 1
        return None


class NoiseMonitor:
    """
    Compares the noise of position and orientation with the parameters' values.

    The third difference of evenly spaced poses removes smooth motion and keeps noise. It needs no
    filter state. It is therefore available before the first fix and independent of the gate. Its
    median over a window is robust against jumps and outliers, even one wrong pose in ten.

    Attributes:
        covariance: (6, 6) of a pose, at least that of the parameters.

    """

    def __init__(self, mocap: MocapParameters):
        self._nominal = self._variances = [mocap.position_noise ** 2,
                                           mocap.orientation_noise ** 2]
        self.covariance = np.diag(np.repeat(self._nominal, 3))
        self._last: Checked | None = None
        self._moves: deque = deque(maxlen=POSES - 1)  # (translation, rotation vector, interval)
        # of position and orientation, in the order of time and of size
        self._excess: list[tuple[deque, list[float]]] = [(deque(), []), (deque(), [])]

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
        for (first, second, third), (window, ordered) in zip((moves, turns), self._excess):
            excess = third - 2 * second + first
            if len(window) == WINDOW:
                del ordered[bisect_left(ordered, window.popleft())]
            window.append(float(excess.dot(excess)))
            insort(ordered, window[-1])
        if len(window) >= MIN_COUNT:
            ratios = [ordered[len(ordered) // 2] / (MEDIAN * GAIN * nominal)
                      for (_, ordered), nominal in zip(self._excess, self._nominal)]
            variances = [
                nominal * min(ratio, LARGEST_SCALE ** 2) if ratio > SIGNIFICANT else nominal
                for ratio, nominal in zip(ratios, self._nominal)]
            if variances != self._variances:
                self._variances, self.covariance = variances, np.diag(np.repeat(variances, 3))
