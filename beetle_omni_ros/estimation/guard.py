"""Checks of the filter's inputs: finite, plausible, new and in time."""

from collections import Counter
from math import inf, isfinite, sqrt

import numpy as np

from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.robot.readings import SpikeFilter

Checked = tuple[float, np.ndarray, np.ndarray]   # stamp and two vectors of a sample


class InputGuard:
    """
    Checks of every sample before it changes the state.

    Attributes:
        rejected: reason -> count.
        clock_jumped: whether the reading just accepted starts a new time line.
        after_impact: whether readings just before it were beyond the sensor's range.

    """

    def __init__(self, parameters: EkfParameters):
        self._imu, self._mocap = parameters.imu, parameters.mocap
        self.rejected: Counter = Counter()
        self.clock_jumped = False
        self.after_impact = False
        self._out_of_range = False
        self._last_reading: float | None = None
        self._last_pose = -inf
        self._pose_values: tuple[float, ...] | None = None
        self._reading_values: tuple[float, ...] | None = None
        self._same_pose = self._same_reading = 0
        self._pose_moved = self._moved = False
        self._spikes = SpikeFilter(self._imu.impact_change, self._imu.spike_change)
        self._refused: list[float] = []  # consecutive refused stamps at regular distances

    def reading(self, sample) -> Checked | None:
        """
        Check an IMU sample.

        Returns:
            (stamp, specific force, angular rate) in copies, or None if it is refused.

        """
        stamp = float(sample.stamp)
        force = np.array(sample.specific_force, dtype=float)
        rate = np.array(sample.angular_velocity, dtype=float)
        values = (*force.tolist(), *rate.tolist())
        if not all(map(isfinite, (stamp, *values))):
            return self._refuse('not_finite')
        if (_squared_norm(*values[:3]) > self._imu.specific_force_limit ** 2
                or _squared_norm(*values[3:]) > self._imu.angular_velocity_limit ** 2):
            self._out_of_range = True
            return self._refuse('out_of_range')
        self.clock_jumped = False
        if self._last_reading is not None:
            step = stamp - self._last_reading
            if not 0 < step <= self._imu.gap_limit:
                if not self._starts_time_line(stamp):
                    return self._refuse('duplicate' if step == 0 else
                                        'backwards' if step < 0 else 'forward_gap')
                self.clock_jumped = True
                self._last_pose = -inf
                self._spikes.reset()
        if self._reading_frozen(values):
            return self._refuse('frozen')
        if not self._spikes.passes(force, rate):
            return self._refuse('spike')
        self._last_reading = stamp
        self._refused.clear()
        self.after_impact, self._out_of_range = self._out_of_range or self._spikes.lasted, False
        return stamp, force, rate

    def _reading_frozen(self, values) -> bool:
        """Whether readings have long been equal to the last digit while the MoCap moved."""
        same = values == self._reading_values
        self._moved |= self._reading_values is not None and not same
        self._reading_values = values
        self._same_reading = self._same_reading + 1 if same else 0
        self._pose_moved &= same
        return self._same_reading >= self._imu.frozen_samples and self._pose_moved

    def _starts_time_line(self, stamp) -> bool:
        """Whether enough consecutive refused stamps are consistent, after a jump of the clock."""
        refused = self._refused
        if refused and not 0 < stamp - refused[-1] <= self._imu.gap_limit:
            refused.clear()
        refused.append(stamp)
        return len(refused) >= self._imu.resync_samples

    def pose(self, sample, oldest: float) -> Checked | None:
        """
        Check a MoCap pose.

        Args:
            sample: stamp, position and quaternion.
            oldest: stamp of the oldest stored IMU reading [s].

        Returns:
            (stamp on the IMU's clock, position, unit quaternion), or None if it is refused.

        """
        stamp = float(sample.stamp) + self._mocap.time_offset
        position = np.array(sample.position, dtype=float)
        quaternion = np.array(sample.quaternion, dtype=float)
        values = (*position.tolist(), *quaternion.tolist())
        if not all(map(isfinite, (stamp, *values))):
            return self._refuse('not_finite')
        if max(map(abs, values[:3])) > self._mocap.position_limit:
            return self._refuse('out_of_range')
        norm = sqrt(_squared_norm(*values[3:]))
        if not abs(norm - 1) <= self._mocap.quaternion_tolerance:
            return self._refuse('quaternion_norm')
        if self._last_reading is None:
            return self._refuse('no_imu')
        if stamp <= self._last_pose:
            return self._refuse('duplicate' if stamp == self._last_pose else 'backwards')
        if stamp < oldest or stamp < self._last_reading - self._mocap.delay_limit:
            return self._refuse('too_old')
        if stamp > self._last_reading + self._imu.gap_limit:
            return self._refuse('future')
        self._last_pose = stamp
        if self._pose_frozen(values):
            return self._refuse('frozen')
        return stamp, position, quaternion / norm

    def _pose_frozen(self, values) -> bool:
        """Whether poses have long been equal to the last digit while the IMU moved."""
        same = values == self._pose_values
        self._pose_moved |= self._pose_values is not None and not same
        self._pose_values = values
        self._same_pose = self._same_pose + 1 if same and self._moved else 0
        self._moved = False
        return self._same_pose >= self._mocap.frozen_poses

    def _refuse(self, reason: str) -> Checked | None:
        """Count a refusal; return the result of the caller."""
        self.rejected[reason] += 1
        return None


def _squared_norm(x, y, z, w=0.0) -> float:
    """Sum of squares in plain floats, which become infinite without a warning."""
    return x * x + y * y + z * z + w * w
