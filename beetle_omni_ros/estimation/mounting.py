"""Between the IMU, where the filter navigates, and base_link, which everybody else means."""

import numpy as np

from beetle_omni_ros.estimation.parameters import ImuParameters
from beetle_omni_ros.estimation.propagation import Node
from beetle_omni_ros.estimation.samples import (
    ATTITUDE, ERROR_STATES, Estimate, GYROSCOPE_BIAS, POSITION, VELOCITY)
from beetle_omni_ros.robot import rotations


class Mounting:
    """The IMU's rotation and lever arm in base_link."""

    def __init__(self, imu: ImuParameters):
        """Take rotation, position and noise from the IMU's parameters."""
        self._axes = rotations.matrix(rotations.exp(imu.rotation)) if np.any(imu.rotation) else None
        self._arm = imu.position.copy() if np.any(imu.position) else None
        self._rate_noise = imu.gyroscope_noise ** 2

    def aligned(self, vector: np.ndarray) -> np.ndarray:
        """Express a vector (3,) of the IMU in base_link axes."""
        return vector if self._axes is None else self._axes @ vector

    def estimate(self, node: Node) -> Estimate:
        """
        Move a state from the IMU to base_link's origin, with its covariance.

        With arm r, rate w: p = p_imu - R r and v = v_imu - R (w x r). The noise of the rate
        sample itself enters the velocity through the arm.
        """
        rate = node.rate - node.gyroscope_bias
        position, velocity, covariance = node.position, node.velocity, node.covariance
        if self._arm is not None:
            swing = np.cross(rate, self._arm)
            position = position - node.rotation @ self._arm
            velocity = velocity - node.rotation @ swing
            arm = node.rotation @ rotations.skew(self._arm)
            jacobian = np.eye(ERROR_STATES)
            jacobian[POSITION, ATTITUDE] = arm
            jacobian[VELOCITY, ATTITUDE] = node.rotation @ rotations.skew(swing)
            jacobian[VELOCITY, GYROSCOPE_BIAS] = -arm
            covariance = jacobian @ covariance @ jacobian.T
            covariance[VELOCITY, VELOCITY] += self._rate_noise * arm @ arm.T
        return Estimate(node.stamp, position, velocity, node.quaternion, rate,
                        node.accelerometer_bias, node.gyroscope_bias, covariance)
