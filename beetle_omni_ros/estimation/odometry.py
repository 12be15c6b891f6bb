"""
The covariances of nav_msgs/Odometry from the filter's.

ROS wants a pose's rotation error about the fixed (world) axes and a twist in the child frame
(base_link); the filter has a rotation error about body axes and the velocity in world.
"""

import numpy as np

from beetle_omni_ros.estimation.samples import (
    ATTITUDE,
    ERROR_STATES,
    Estimate,
    GYROSCOPE_BIAS,
    POSITION,
    VELOCITY,
)
from beetle_omni_ros.robot import rotations


def pose_covariance(estimate: Estimate) -> np.ndarray:
    """Covariance (6, 6) of position [m] and rotation about world axes [rad]."""
    jacobian = np.zeros((6, ERROR_STATES))
    jacobian[:3, POSITION] = np.eye(3)
    jacobian[3:, ATTITUDE] = rotations.matrix(estimate.quaternion)
    return jacobian @ estimate.covariance @ jacobian.T


def twist_covariance(estimate: Estimate, gyroscope_noise: float) -> np.ndarray:
    """
    Covariance (6, 6) of linear [m/s] and angular [rad/s] velocity in base_link.

    Args:
        estimate: of the filter.
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
