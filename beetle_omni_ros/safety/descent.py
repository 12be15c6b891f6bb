"""
The backup estimator, used when the EKF has failed.

It starts from the last valid estimate and is deliberately simpler than the EKF, so that both do
not fail for the same reason. It integrates gyroscope and accelerometer. MoCap poses correct
position, velocity and attitude with fixed gains; each pose is compared with the stored state at
its capture time. While the EKF works, the IMU biases are taken from it. Without MoCap, position
and velocity are dead reckoning, and the velocity slowly decays to the desired velocity, so that a
descent stays slow. Without IMU the rotor model is used between MoCap poses.
"""

from collections import deque
from dataclasses import replace
from math import isfinite, sqrt

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.safety.parameters import BackupParameters

KEPT_SAMPLES = 100     # IMU samples before the failure: 0.5 s at 200 Hz
KEPT_FIXES = 12        # MoCap poses from which the velocity is computed
FIXES_TIME = 0.1       # [s] older poses are not used for it
KEPT_BIASES, BIAS_EVERY = 4, 0.5    # [s] biases of up to 2 s ago, before an estimate went wrong
KEPT_POSES = 24        # stored states for late MoCap frames: 0.12 s at 200 Hz
LONGEST_STEP = 0.1     # [s] longest integrated gap in the samples
ABSURD = 1e4           # [m, m/s^2, rad/s] beyond any sensor of this robot
Timed = tuple[float, np.ndarray, np.ndarray]    # stamp [s] and two vectors
LARGEST_BIASES = (1.0, 0.2)   # [m/s^2], [rad/s] largest learnt biases of an IMU


class BackupEstimator:
    """
    Complementary filter on raw IMU and MoCap.

    Args:
        parameters: bandwidths.
        gravity: [m/s^2].

    Attributes:
        running: whether :meth:`start` was called.
        specific_force_up: latest specific force along world up [m/s^2], None without IMU.
        imu_alive: set by the caller; without it rates come from MoCap.

    """

    def __init__(self, parameters: BackupParameters, gravity: float):
        self._parameters = parameters
        self._gravity = np.array([0.0, 0.0, -gravity])
        self._samples: deque = deque(maxlen=KEPT_SAMPLES)
        self._accelerometer_bias, self._gyroscope_bias = np.zeros(3), np.zeros(3)
        self._learnt: State | None = None
        self._mocap_stamp = -np.inf
        self._poses: deque = deque(maxlen=KEPT_FIXES)
        self._biases: deque = deque(maxlen=KEPT_BIASES)     # (stamp, accelerometer, gyroscope)
        self.imu_alive = True
        self.stop()

    def stop(self) -> None:
        """Reset the state; samples and biases stay."""
        self.running = False
        self._past: deque = deque(maxlen=KEPT_POSES)
        self.specific_force_up: float | None = None

    @property
    def last_specific_force(self) -> np.ndarray | None:
        """(3,) of the latest sample, in base_link [m/s^2]."""
        return self._samples[-1][1] if self._samples else None

    def on_imu(self, stamp: float, specific_force: np.ndarray,
               angular_velocity: np.ndarray) -> bool:
        """Store one raw sample; False when it is not finite or not newer than the last."""
        sample = checked_sample(stamp, specific_force, angular_velocity)
        return sample is not None and self.add(sample)

    def add(self, sample: Timed) -> bool:
        """Store a sample of :func:`checked_sample`; False when it is not newer than the last."""
        if self._samples and sample[0] <= self._samples[-1][0]:
            return False
        self._samples.append(sample)
        if self.running:
            self._use(*sample)
        return True

    def on_mocap(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> bool:
        """Use one pose, captured at ``stamp``; False when it is not usable."""
        pose = self.checked_pose(stamp, position, quaternion)
        if pose is not None:
            self.use(pose)
        return pose is not None

    def checked_pose(self, stamp: float, position: np.ndarray,
                     quaternion: np.ndarray) -> Timed | None:
        """Stamp, position and unit quaternion of a valid pose newer than the last, else None."""
        place, attitude = _vector(position, 3), _vector(quaternion, 4)
        if place is None or attitude is None or not isfinite(stamp) \
                or stamp <= self._mocap_stamp or not abs(attitude.dot(attitude) - 1) <= 0.02:
            return None
        return stamp, place, rotations.normalized(attitude)

    def use(self, pose: Timed) -> None:
        """Use a pose of :meth:`checked_pose`."""
        dt = min(pose[0] - self._mocap_stamp, LONGEST_STEP)
        self._mocap_stamp = pose[0]
        if self.running and self._past:
            self._correct(*pose, dt)

    def remember(self, pose: Timed) -> None:
        """Store a pose of :meth:`checked_pose` for a start without an estimate."""
        if not self._poses or pose[0] > self._poses[-1][0]:
            self._poses.append(pose)

    def learn(self, state: State) -> None:
        """Update the biases from a valid estimate and the IMU sample of the same time."""
        before, self._learnt = self._learnt, state
        for sample in reversed(self._samples):
            if sample[0] <= state.stamp + 1e-6:
                break
        else:
            return
        if before is None:
            return
        dt = state.stamp - before.stamp
        if not 0 < dt <= LONGEST_STEP or state.stamp - sample[0] > LONGEST_STEP:
            return
        acceleration = (state.velocity - before.velocity) / dt
        expected = (acceleration - self._gravity).dot(rotations.matrix(state.quaternion))
        if not self._biases or state.stamp - self._biases[-1][0] > BIAS_EVERY:
            self._biases.append((state.stamp, self._accelerometer_bias, self._gyroscope_bias))
        gain = min(1.0, dt / self._parameters.bias_time)
        self._accelerometer_bias = _shortened(self._accelerometer_bias + gain * (
            sample[1] - expected - self._accelerometer_bias), LARGEST_BIASES[0])
        self._gyroscope_bias = _shortened(self._gyroscope_bias + gain * (
            sample[2] - state.angular_velocity - self._gyroscope_bias), LARGEST_BIASES[1])

    def start(self, state: State) -> None:
        """Continue from the last valid estimate, with the samples since then."""
        self.stop()
        self.running = True
        self._stamp = state.stamp
        self._position, self._velocity = state.position.copy(), state.velocity.copy()
        self._quaternion = rotations.normalized(state.quaternion)
        self._rate = state.angular_velocity.copy()
        self._remember()
        for stamp, force, rate in self._samples:
            if stamp > state.stamp:
                self._use(stamp, force, rate)

    @property
    def last_position(self) -> np.ndarray | None:
        """(3,) of the latest MoCap pose in world [m], None before the first."""
        return self._poses[-1][1] if self._poses else None

    @property
    def velocity_by_poses(self) -> np.ndarray | None:
        """(3,) in world from the poses of the last 0.1 s only [m/s], None if there are none."""
        if not self._poses:
            return None
        poses = [pose for pose in self._poses if pose[0] > self._poses[-1][0] - FIXES_TIME]
        if len(poses) < 2:
            return None
        return (poses[-1][1] - poses[0][1]) / (poses[-1][0] - poses[0][0])

    def start_from_poses(self, tilt_source: State) -> None:
        """
        Continue from MoCap and IMU only, if the estimate is wrong.

        Args:
            tilt_source: the last estimate, used if there are no poses.

        """
        velocity = self.velocity_by_poses
        if velocity is None:
            return self.start(tilt_source)
        stamp, position, quaternion = self._poses[-1]
        if self._biases:    # those learnt from the wrong estimate are wrong
            self._accelerometer_bias, self._gyroscope_bias = self._biases[0][1:]
        rate = self._samples[-1][2] - self._gyroscope_bias if self._samples else np.zeros(3)
        self.start(State(stamp, position, velocity, quaternion, rate, tilt_source.tilt,
                         tilt_source.tilt_velocity, tilt_source.tilt_stamp))

    def clock_went_back(self, by: float) -> None:
        """Shift all stamps after the clock was set back by ``by`` [s]."""
        self._samples = deque(((t - by, *rest) for t, *rest in self._samples),
                              maxlen=KEPT_SAMPLES)
        self._past = deque(((t - by, *rest) for t, *rest in self._past), maxlen=KEPT_POSES)
        self._mocap_stamp -= by
        self._poses.clear()
        self._biases.clear()
        self._learnt = None
        if self.running:
            self._stamp -= by

    def predict(self, now: float, desired_velocity: np.ndarray | None = None,
                motion: tuple[np.ndarray, np.ndarray] | None = None) -> None:
        """
        Advance to ``now`` without a sample.

        Args:
            now: [s].
            desired_velocity: (3,) desired velocity in world, given while MoCap is lost [m/s].
            motion: specific force (3,) [m/s^2] and angular acceleration (3,) [rad/s^2] in
                base_link by the model, used while the IMU is gone.

        """
        dt = now - self._stamp
        if desired_velocity is not None and dt > 0:
            self._velocity = self._velocity + min(1.0, dt / self._parameters.velocity_leak_time) \
                * (desired_velocity - self._velocity)
        if not self.imu_alive:
            self.specific_force_up = None
            if motion is None or dt <= 0:
                return self._advance(now, np.zeros(3))
            force, turning = motion
            self._rate = self._rate + min(dt, LONGEST_STEP) * turning
            self._advance(now, rotations.matrix(self._quaternion) @ force + self._gravity)

    def latest(self, other: State) -> State:
        """Another state with position, velocity, attitude and rates of the last prediction."""
        return replace(other, position=self._position, velocity=self._velocity,
                       quaternion=self._quaternion, angular_velocity=self._rate)

    def state(self, tilt: np.ndarray, tilt_velocity: np.ndarray, tilt_stamp: float,
              now: float) -> State:
        """The estimate at ``now``, extrapolated by at most the longest step."""
        dt = float(np.clip(now - self._stamp, 0.0, LONGEST_STEP))
        attitude = rotations.multiply(self._quaternion, rotations.exp(dt * self._rate))
        return State(now, self._position + dt * self._velocity, self._velocity.copy(),
                     rotations.normalized(attitude), self._rate.copy(), tilt, tilt_velocity,
                     tilt_stamp)

    def _use(self, stamp, force, rate):
        if stamp <= self._stamp:
            return
        self._rate = rate - self._gyroscope_bias
        in_world = rotations.matrix(self._quaternion).dot(force - self._accelerometer_bias)
        self.specific_force_up = float(in_world[2])
        self._advance(stamp, in_world + self._gravity)

    def _advance(self, stamp, acceleration):
        dt = min(stamp - self._stamp, LONGEST_STEP)
        if dt <= 0:
            return
        self._position = self._position + dt * self._velocity + 0.5 * dt * dt * acceleration
        self._velocity = self._velocity + dt * acceleration
        self._quaternion = rotations.normalized(rotations.multiply(
            self._quaternion, rotations.exp(dt * self._rate)))
        self._stamp = stamp
        self._remember()

    def _remember(self):
        self._past.append((self._stamp, self._position, self._quaternion))

    def _correct(self, stamp, position, quaternion, dt):
        p = self._parameters
        _, then, attitude = min(self._past, key=lambda entry: abs(entry[0] - stamp))
        error = _shortened(position - then, p.error_limit)
        turn = _shortened(rotations.log(rotations.multiply(
            rotations.conjugate(attitude), quaternion)), p.error_limit)
        # Critically damped observer: position gain 2 w, velocity gain w^2.
        w = p.position_bandwidth
        self._position = self._position + min(1.0, 2 * w * dt) * error
        self._velocity = self._velocity + w * w * dt * error
        if self.imu_alive:
            gain = p.attitude_bandwidth
        else:
            w = p.attitude_bandwidth_without_gyroscope
            gain = 2 * w
            self._rate = self._rate + w * w * dt * turn
        self._quaternion = rotations.normalized(rotations.multiply(
            self._quaternion, rotations.exp(min(1.0, gain * dt) * turn)))
        # The next late frame is compared with the corrected past.
        self._past = deque(((t, q + min(1.0, 2 * p.position_bandwidth * dt) * error,
                             rotations.multiply(a, rotations.exp(min(1.0, gain * dt) * turn)))
                            for t, q, a in self._past), maxlen=KEPT_POSES)


def checked_sample(stamp: float, specific_force: np.ndarray,
                   angular_velocity: np.ndarray) -> Timed | None:
    """Stamp and copies (3,), (3,) of an IMU sample; None when a number is not plausible."""
    force, rate = _vector(specific_force, 3), _vector(angular_velocity, 3)
    return None if force is None or rate is None or not isfinite(stamp) else (stamp, force, rate)


def _vector(value, size: int) -> np.ndarray | None:
    """Copy of ``value`` as finite floats (size,) within plausible limits, or None."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return None
    if array.shape != (size,):
        return None
    for number in array.tolist():
        if not -ABSURD < number < ABSURD:   # nan, too
            return None
    return array


def _shortened(vector, limit):
    length = sqrt(vector.dot(vector))
    return vector if length <= limit else vector * (limit / length)
