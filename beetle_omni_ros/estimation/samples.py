"""Output of the estimator, and the order of its error states."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from beetle_omni_ros.robot import rotations

# The 15 error states: position and velocity of base_link in world, attitude as rotation vector
# in base_link (R_true = R exp(theta)), accelerometer and gyroscope bias.
POSITION = slice(0, 3)
VELOCITY = slice(3, 6)
ATTITUDE = slice(6, 9)
ACCELEROMETER_BIAS = slice(9, 12)
GYROSCOPE_BIAS = slice(12, 15)
ERROR_STATES = 15


@dataclass(frozen=True)
class Estimate:
    """
    State of base_link at the newest IMU sample.

    Attributes:
        stamp: time of that sample [s].
        position: (3,) in world [m].
        velocity: (3,) in world [m/s].
        quaternion: (4,) body to world (x, y, z, w), unit.
        angular_velocity: (3,) in base_link, bias removed [rad/s].
        accelerometer_bias: (3,) in base_link axes [m/s^2].
        gyroscope_bias: (3,) in base_link axes [rad/s].
        covariance: (15, 15) of the error, in the order of this module's slices; computed on first
            access.

    """

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray
    accelerometer_bias: np.ndarray
    gyroscope_bias: np.ndarray
    compute_covariance: Callable[[], np.ndarray] = field(repr=False)

    @cached_property
    def covariance(self) -> np.ndarray:
        """See the class."""
        return self.compute_covariance()


def pose_covariance(estimate: Estimate) -> np.ndarray:
    """
    Covariance (6, 6) of position [m] and rotation about world axes [rad].

    The filter's rotation error is about body axes, that of nav_msgs/Odometry about world axes.
    """
    jacobian = np.zeros((6, ERROR_STATES))
    jacobian[:3, POSITION] = np.eye(3)
    jacobian[3:, ATTITUDE] = rotations.matrix(estimate.quaternion)
    return jacobian @ estimate.covariance @ jacobian.T


def twist_covariance(estimate: Estimate, gyroscope_noise: float) -> np.ndarray:
    """
    Covariance (6, 6) of linear [m/s] and angular [rad/s] velocity in base_link.

    Args:
        estimate: output of the filter.
        gyroscope_noise: standard deviation of one angular-rate sample, each axis [rad/s].

    """
    to_body = rotations.matrix(estimate.quaternion).T
    jacobian = np.zeros((6, ERROR_STATES))
    jacobian[:3, VELOCITY] = to_body
    jacobian[:3, ATTITUDE] = rotations.skew(to_body @ estimate.velocity)
    jacobian[3:, GYROSCOPE_BIAS] = -np.eye(3)
    covariance = jacobian @ estimate.covariance @ jacobian.T
    covariance[3:, 3:] += gyroscope_noise ** 2 * np.eye(3)
    return covariance
