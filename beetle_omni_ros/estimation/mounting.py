"""
Conversion of the filter's state to the estimate of base_link.

The filter estimates the motion of the IMU at the IMU's stamps, the estimate that of base_link now.
"""

from collections.abc import Sequence

import numpy as np

from beetle_omni_ros.estimation.model import ErrorStateModel
from beetle_omni_ros.estimation.propagation import Node, STATES, TIME_OFFSET
from beetle_omni_ros.estimation.samples import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    ERROR_STATES,
    Estimate,
    GYROSCOPE_BIAS,
    POSITION,
    VELOCITY,
)
from beetle_omni_ros.robot import rotations

SIGNIFICANT = 4.0  # standard deviations of a significant time offset


class Mounting:
    """Rotation and lever arm of the IMU in base_link, and its known biases."""

    def __init__(self, model: ErrorStateModel):
        """Copy rotation, position and noise of the IMU from the parameters of ``model``."""
        imu = model.parameters.imu
        self._model = model
        self._trend_samples = model.parameters.time_offset.trend_samples
        self._gravity = model.gravity
        turned = np.any(imu.rotation)
        self._axes = rotations.matrix(rotations.exp(imu.rotation)) if turned else None
        self._arm = imu.position.copy() if np.any(imu.position) else None
        self._force_bias, self._rate_bias = imu.accelerometer_bias, imu.gyroscope_bias
        self._biased = bool(np.any(self._force_bias) or np.any(self._rate_bias))
        self._rate_noise = imu.gyroscope_noise ** 2

    def aligned(self, force: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Specific force and rate (3,) minus their known biases, in base_link axes."""
        if self._biased:
            force, rate = force - self._force_bias, rate - self._rate_bias
        return (force, rate) if self._axes is None else (self._axes @ force, self._axes @ rate)

    def estimate(self, node: Node, readings: Sequence = ()) -> Estimate:
        """
        Convert a node to the state of base_link at its stamp, with its covariance.

        Args:
            node: newest state of the filter.
            readings: IMU readings (stamp, specific force, rate, after impact) up to the node's.

        """
        age = node.time_offset
        late = age > SIGNIFICANT * self._model.time_deviation(node)
        position, velocity, quaternion, measured_rate = (
            self._extrapolated(node, age, self.trend(readings)) if late else
            (node.position, node.velocity, node.quaternion, node.rate))
        rate = measured_rate - node.gyroscope_bias
        if self._arm is not None:
            rotation = rotations.matrix(quaternion)
            position = position - rotation @ self._arm
            velocity = velocity - rotation @ rotations.cross(rate, self._arm)

        def covariance():
            found, rotation = self._model.covariance(node), rotations.matrix(quaternion)
            if late:
                # the mean rate, which includes half of the trend
                mean = 0.5 * (node.rate + measured_rate) - node.gyroscope_bias
                found = self._extrapolated_covariance(node, rotation, mean, age, found)
            found = found[:ERROR_STATES, :ERROR_STATES]
            return found if self._arm is None else \
                self._covariance_at_base(rotation, rate, found, self._arm)

        return Estimate(node.stamp, position, velocity, quaternion, rate,
                        node.accelerometer_bias, node.gyroscope_bias, covariance)

    def trend(self, readings) -> np.ndarray:
        """(3,) angular acceleration [rad/s^2], by least squares through the last readings."""
        count = self._trend_samples
        last = [readings[i] for i in range(max(0, len(readings) - count), len(readings))]
        if len(last) < max(count, 2):
            return np.zeros(3)
        stamps, _, rates, after_impact = zip(*last)
        if any(after_impact):
            return np.zeros(3)
        times = np.array(stamps)
        times -= np.add.reduce(times) / len(last)
        return times.dot(rates) / times.dot(times)

    def _extrapolated(self, node, age, trend) -> tuple[np.ndarray, ...]:
        """
        Extrapolate position, velocity, quaternion and rate over the latency in the IMU's stamps.

        A stamp on arrival can be late but not early. IMU stamps later than the MoCap's therefore
        mean a delayed reading. In the opposite case the MoCap's stamps are late and the reading is
        not delayed. The acceleration is constant over these few milliseconds, and the rate
        continues its trend. Without the trend, 25 ms are a phase lag of 18 deg at 2 Hz.
        """
        velocity0, rate0, slopes = node.velocity.tolist(), node.rate.tolist(), trend.tolist()
        turn = [age * (w - bias + 0.5 * age * slope)
                for w, bias, slope in zip(rate0, node.gyroscope_bias.tolist(), slopes)]
        quaternion = np.array(rotations.product(*node.quaternion.tolist(),
                                                *rotations.exp_parts(*turn)))
        acceleration = node.rotation.dot(node.force - node.accelerometer_bias).tolist()
        acceleration[2] -= self._gravity
        position = [p + age * v + 0.5 * age ** 2 * a
                    for p, v, a in zip(node.position.tolist(), velocity0, acceleration)]
        velocity = [v + age * a for v, a in zip(velocity0, acceleration)]
        rate = [w + age * slope for w, slope in zip(rate0, slopes)]
        return np.array(position), np.array(velocity), quaternion, np.array(rate)

    def _extrapolated_covariance(self, before, rotation, rate, age, covariance) -> np.ndarray:
        """(16, 16) covariance after an extrapolation to ``rotation`` with a mean rate."""
        acceleration = before.rotation @ (before.force - before.accelerometer_bias)
        acceleration[2] -= self._gravity
        jacobian = np.eye(STATES)
        jacobian[POSITION, VELOCITY] = age * np.eye(3)
        jacobian[POSITION, TIME_OFFSET] = before.velocity
        jacobian[VELOCITY, TIME_OFFSET] = acceleration
        jacobian[VELOCITY, ATTITUDE] = -age * rotations.skew(acceleration) @ before.rotation
        jacobian[VELOCITY, ACCELEROMETER_BIAS] = -age * before.rotation
        jacobian[ATTITUDE, ATTITUDE] = rotation.T @ before.rotation
        jacobian[ATTITUDE, GYROSCOPE_BIAS] = -age * np.eye(3)
        jacobian[ATTITUDE, TIME_OFFSET] = rate
        return jacobian @ covariance @ jacobian.T

    def _covariance_at_base(self, rotation, rate, covariance, lever: np.ndarray) -> np.ndarray:
        """
        Transform a state's covariance (15, 15) from the IMU to base_link's origin.

        With arm r and rate w, p = p_imu - R r and v = v_imu - R (w x r). The noise of the rate
        sample affects the velocity through the arm.
        """
        swing = rotations.cross(rate, lever)
        arm = rotation @ rotations.skew(lever)
        jacobian = np.eye(ERROR_STATES)
        jacobian[POSITION, ATTITUDE] = arm
        jacobian[VELOCITY, ATTITUDE] = rotation @ rotations.skew(swing)
        jacobian[VELOCITY, GYROSCOPE_BIAS] = -arm
        covariance = jacobian @ covariance @ jacobian.T
        covariance[VELOCITY, VELOCITY] += self._rate_noise * arm @ arm.T
        return covariance
