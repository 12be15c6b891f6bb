"""
The error-state model: what filterpy's Kalman filter is fed with at each step.

filterpy keeps the error state and does its covariance and gain algebra; around it stands
only what is particular to a rigid body: propagation and residual on SO(3), and the
injection of the estimated error into the state.
"""

from filterpy.kalman import KalmanFilter
import numpy as np
from scipy.stats import chi2

from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.propagation import identity, Node, propagate, transition
from beetle_omni_ros.estimation.samples import (
    ACCELEROMETER_BIAS, ATTITUDE, ERROR_STATES, GYROSCOPE_BIAS, POSITION, VELOCITY)
from beetle_omni_ros.robot import rotations

MEASURED = 6  # position in world, rotation vector in base_link


class ErrorStateModel:
    """Prediction and correction of one node; holds constants and buffers, no state."""

    def __init__(self, parameters: EkfParameters, gravity: float):
        """
        Prepare the constant matrices.

        Args:
            parameters: noise and extrinsics.
            gravity: magnitude, along world -z [m/s^2].

        """
        imu, mocap = parameters.imu, parameters.mocap
        self.gravity = gravity
        self.parameters = parameters
        self.filter = KalmanFilter(dim_x=ERROR_STATES, dim_z=MEASURED)
        self._no_error = np.zeros(ERROR_STATES)
        self._transition = identity()
        self._process = _process_noise(parameters)
        self._period = 1 / imu.rate

        # the marker body, as seen from the navigated point (the IMU), in base_link axes
        self._lever = mocap.position - imu.position
        self._has_lever = bool(np.any(self._lever))
        self._marker_to_base = rotations.conjugate(rotations.exp(mocap.rotation))
        self.filter.H[0:3, POSITION] = np.eye(3)
        self.filter.H[3:6, ATTITUDE] = np.eye(3)
        self.filter.R = np.diag([mocap.position_noise ** 2] * 3 + [mocap.orientation_noise ** 2] * 3)
        self.gate = float(chi2.ppf(mocap.gate_probability, MEASURED))

    def start(self, stamp, force, rate, position, quaternion, biases: Node | None) -> Node:
        """
        Make the first node from one pose, at unknown velocity.

        Args:
            stamp: capture time of the pose [s].
            force: (3,) specific force then, base_link axes [m/s^2].
            rate: (3,) angular rate then, base_link axes [rad/s].
            position: (3,) of the marker body in world [m].
            quaternion: (4,) marker body to world, unit.
            biases: a node whose biases and their covariance are kept, or None.

        """
        first = self.parameters.initial
        attitude = rotations.normalized(rotations.multiply(quaternion, self._marker_to_base))
        rotation = rotations.matrix(attitude)
        arm = rotation @ rotations.skew(self._lever)
        noise = self.filter.R
        covariance = np.zeros((ERROR_STATES, ERROR_STATES))
        covariance[POSITION, POSITION] = noise[:3, :3] + arm @ noise[3:, 3:] @ arm.T
        covariance[POSITION, ATTITUDE] = arm @ noise[3:, 3:]
        covariance[ATTITUDE, POSITION] = covariance[POSITION, ATTITUDE].T
        covariance[ATTITUDE, ATTITUDE] = noise[3:, 3:]
        covariance[VELOCITY, VELOCITY] = first.velocity_std ** 2 * np.eye(3)
        if biases is None:
            accelerometer_bias, gyroscope_bias = np.zeros(3), np.zeros(3)
            covariance[9:, 9:] = np.diag([first.accelerometer_bias_std ** 2] * 3
                                         + [first.gyroscope_bias_std ** 2] * 3)
        else:
            accelerometer_bias, gyroscope_bias = biases.accelerometer_bias, biases.gyroscope_bias
            covariance[9:, 9:] = biases.covariance[9:, 9:]
        return Node(stamp, force, rate, position - rotation @ self._lever, np.zeros(3), attitude,
                    rotation, accelerometer_bias, gyroscope_bias, covariance)

    def forget(self, node: Node, stamp: float, force: np.ndarray, rate: np.ndarray) -> Node:
        """Move a state across an unknown lapse of time: only the biases are still worth much."""
        limits = self.parameters
        covariance = node.covariance.copy()
        covariance[0:9, :] = covariance[:, 0:9] = 0.0
        covariance[POSITION, POSITION] = limits.mocap.position_limit ** 2 * np.eye(3)
        covariance[VELOCITY, VELOCITY] = limits.initial.velocity_std ** 2 * np.eye(3)
        covariance[ATTITUDE, ATTITUDE] = np.pi ** 2 * np.eye(3)
        return Node(stamp, force, rate, node.position, np.zeros(3), node.quaternion, node.rotation,
                    node.accelerometer_bias, node.gyroscope_bias, covariance)

    def predict(self, node: Node, stamp: float, force: np.ndarray, rate: np.ndarray) -> Node:
        """Carry ``node`` and its covariance to the next IMU reading."""
        after = propagate(node, stamp, force, rate, self.gravity)
        dt = stamp - node.stamp
        # What happened during missing samples is interpolated: its error grows with each.
        missing = max(1.0, dt / self._period)
        kalman = self.filter
        kalman.x = self._no_error
        kalman.P = node.covariance
        kalman.predict(F=transition(node, after, self._transition),
                       Q=self._process * (dt * missing ** 3))
        after.covariance = kalman.P
        return after

    def correct(self, prior: Node, position: np.ndarray, quaternion: np.ndarray) -> Node | None:
        """
        Update a node with the pose that was captured then.

        Args:
            prior: the predicted node.
            position: (3,) of the marker body in world [m].
            quaternion: (4,) marker body to world, unit, either sign.

        Returns:
            The corrected node, or None when the pose fails the chi-square gate.

        """
        kalman = self.filter
        residual = np.empty(MEASURED)
        residual[:3] = position - prior.position
        residual[3:] = rotations.log(rotations.multiply(
            rotations.conjugate(prior.quaternion),
            rotations.multiply(quaternion, self._marker_to_base)))
        if self._has_lever:
            residual[:3] -= prior.rotation @ self._lever
            kalman.H[0:3, ATTITUDE] = -prior.rotation @ rotations.skew(self._lever)
        kalman.x = self._no_error
        kalman.P = prior.covariance
        kalman.update(residual, H=kalman.H)
        # The innovation is filterpy's y with inverse covariance SI; not <= also catches NaN.
        if not float(kalman.y @ kalman.SI @ kalman.y) <= self.gate:
            return None
        return _inject(prior, kalman.x, kalman.P)


def _inject(prior: Node, error: np.ndarray, covariance: np.ndarray) -> Node:
    """Move the estimated error into the state; the error that remains has mean zero."""
    turn = error[ATTITUDE]
    quaternion = rotations.normalized(
        rotations.multiply(prior.quaternion, rotations.exp(turn.tolist())))
    # The remaining attitude error counts from the corrected attitude: right Jacobian, first order.
    shift = -0.5 * rotations.skew(turn.tolist())
    covariance[ATTITUDE, :] += shift @ covariance[ATTITUDE, :]
    covariance[:, ATTITUDE] += covariance[:, ATTITUDE] @ shift.T
    return Node(prior.stamp, prior.force, prior.rate,
                prior.position + error[POSITION], prior.velocity + error[VELOCITY],
                quaternion, rotations.matrix(quaternion),
                prior.accelerometer_bias + error[ACCELEROMETER_BIAS],
                prior.gyroscope_bias + error[GYROSCOPE_BIAS],
                0.5 * (covariance + covariance.T))


def _process_noise(parameters: EkfParameters) -> np.ndarray:
    """Spectral density (15, 15) of the process noise, per second."""
    imu = parameters.imu
    density = np.zeros(ERROR_STATES)
    density[VELOCITY] = imu.accelerometer_noise ** 2 / imu.rate
    density[ATTITUDE] = imu.gyroscope_noise ** 2 / imu.rate
    density[ACCELEROMETER_BIAS] = imu.accelerometer_bias_walk ** 2
    density[GYROSCOPE_BIAS] = imu.gyroscope_bias_walk ** 2
    return np.diag(density)
