"""
The backup estimator, used when the EKF has failed.

It starts from the last valid estimate and is deliberately simpler than the EKF, so that both do
not fail for the same reason. It integrates gyroscope and accelerometer. MoCap poses correct
position, velocity and attitude with fixed gains; each pose is compared with the state
extrapolated back to its capture time. Without MoCap, position and velocity are dead reckoning.
Without IMU the rotor model is used between MoCap poses.
"""

from collections import deque
from dataclasses import replace

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.rotations import shortened

KEPT_POSES = 12         # MoCap poses from which the velocity is computed
POSES_TIME = 0.1        # [s] older poses are not used for it
LONGEST_STEP = 0.1      # [s] longest integrated gap in the samples
POSITION_BANDWIDTH = 8.0    # [rad/s] MoCap of 1 mm and 100 Hz leaves 2 cm/s of velocity noise
ATTITUDE_BANDWIDTH = 5.0    # [rad/s]
WITHOUT_GYROSCOPE = 12.0    # [rad/s] bandwidth of attitude and rate without IMU
LARGEST_ERROR = 0.2     # [m or rad] larger MoCap corrections are limited to this


class BackupEstimator:
    """
    Complementary filter on raw IMU and MoCap.

    Attributes:
        imu_alive: set by the caller; without it rates come from MoCap.
        sample: latest IMU sample: stamp [s], specific force (3,), rate (3,) in base_link, or None.
        poses: latest MoCap poses: stamp [s], position (3,), quaternion (4,).

    """

    def __init__(self, gravity: float):
        self._gravity = np.array([0.0, 0.0, -gravity])
        self._stamp, self._position, self._velocity = -np.inf, np.zeros(3), np.zeros(3)
        self._quaternion, self._rate = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
        self.imu_alive = True
        self.poses: deque = deque(maxlen=KEPT_POSES)
        self.running = False    # whether it is used; set to False by the caller
        self.forget()

    def forget(self, by: float = 0.0) -> None:
        """Accept new stamps after the clock was set back by ``by`` [s]."""
        self.sample: tuple[float, np.ndarray, np.ndarray] | None = None
        self.poses.clear()
        self._used_at = -np.inf
        if self.running:
            self._stamp -= by

    def add(self, stamp: float, specific_force: np.ndarray, rate: np.ndarray) -> bool:
        """Store one raw sample; False when it is not newer than the last."""
        if self.sample is not None and not stamp > self.sample[0]:
            return False
        self.sample = stamp, specific_force, rate
        if self.running and stamp > self._stamp:
            self._rate = rate
            self._advance(stamp, specific_force)
        return True

    def correct(self, stamp: float, position: np.ndarray, quaternion: np.ndarray) -> None:
        """Use one pose, captured at ``stamp``."""
        dt, self._used_at = min(stamp - self._used_at, LONGEST_STEP), stamp
        if not self.running:
            return
        late = min(max(0.0, self._stamp - stamp), LONGEST_STEP)
        error = shortened(position - self._position + late * self._velocity, LARGEST_ERROR)
        then = rotations.multiply(self._quaternion, rotations.exp(-late * self._rate))
        turn = shortened(rotations.log(rotations.multiply(
            rotations.conjugate(then), quaternion)), LARGEST_ERROR)
        # Critically damped observer: position gain 2 w, velocity gain w^2.
        w = POSITION_BANDWIDTH
        self._position = self._position + min(1.0, 2 * w * dt) * error
        self._velocity = self._velocity + w * w * dt * error
        gain = ATTITUDE_BANDWIDTH
        if not self.imu_alive:
            gain = 2 * WITHOUT_GYROSCOPE
            self._rate = self._rate + WITHOUT_GYROSCOPE ** 2 * dt * turn
        self._quaternion = rotations.normalized(rotations.multiply(
            self._quaternion, rotations.exp(min(1.0, gain * dt) * turn)))

    def start(self, state: State) -> None:
        """Continue from the last valid estimate."""
        self.running, self._stamp, self._rate = True, state.stamp, state.angular_velocity
        self._position, self._velocity = state.position, state.velocity
        self._quaternion = rotations.normalized(state.quaternion)

    @property
    def velocity_by_poses(self) -> np.ndarray | None:
        """(3,) in world from the poses of the last 0.1 s only [m/s], None if there are none."""
        poses = [pose for pose in self.poses if pose[0] > self.poses[-1][0] - POSES_TIME]
        if len(poses) < 2:
            return None
        return (poses[-1][1] - poses[0][1]) / (poses[-1][0] - poses[0][0])

    def predict(self, now: float, force: np.ndarray, turning: np.ndarray) -> None:
        """Advance to ``now`` without IMU, by specific force (3,) and turning (3,) of the model."""
        dt = now - self._stamp
        if dt > 0:
            self._rate = self._rate + min(dt, LONGEST_STEP) * turning
            self._advance(now, force)

    def state(self, now: float, other: State) -> State:
        """The estimate at ``now``, extrapolated by at most the longest step; joints of another."""
        dt = min(max(0.0, now - self._stamp), LONGEST_STEP)
        attitude = rotations.multiply(self._quaternion, rotations.exp(dt * self._rate))
        return replace(other, stamp=now, position=self._position + dt * self._velocity,
                       velocity=self._velocity, quaternion=rotations.normalized(attitude),
                       angular_velocity=self._rate)

    def _advance(self, stamp, force):
        dt = min(stamp - self._stamp, LONGEST_STEP)
        acceleration = rotations.matrix(self._quaternion).dot(force) + self._gravity
        self._position = self._position + dt * self._velocity + 0.5 * dt * dt * acceleration
        self._velocity = self._velocity + dt * acceleration
        self._quaternion = rotations.normalized(rotations.multiply(
            self._quaternion, rotations.exp(dt * self._rate)))
        self._stamp = stamp
