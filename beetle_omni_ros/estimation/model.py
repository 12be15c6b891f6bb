"""
The error-state model: a rigid body for filterpy, which computes covariance and gain.

The filter estimates the motion of the IMU at the IMU's stamps; the output is that of base_link.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from math import sqrt

from filterpy.kalman import KalmanFilter
import numpy as np
from scipy.special import gammaincinv

from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.state import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    ERROR_STATES,
    Estimate,
    GYROSCOPE_BIAS,
    Node,
    POSITION,
    STATES,
    TIME_OFFSET,
    transition,
    VELOCITY,
)
from beetle_omni_ros.model import rotations

MEASUREMENTS = 6  # position in world, rotation vector in base_link
GATE = 0.99999          # share of good poses that passes the chi-square gate
FIRST_SPEED = 5.0       # [m/s] standard deviation of the velocity before the second pose
ACCELEROMETER_BIAS_STD, GYROSCOPE_BIAS_STD = 0.2, 0.05  # [m/s^2], [rad/s] at the start
# For dead reckoning: standard deviations of the accelerometer's true bias [m/s^2] and of the
# markers' attitude error [rad], each axis.
TRUE_BIAS_STD, MARKER_STD = 0.03, 0.006
# The offset between the clocks: largest [s], random walk [s/sqrt(s)], and the speed [m/s] and rate
# [rad/s] below which it is not estimated, because both are then mostly noise.
LARGEST_OFFSET, OFFSET_WALK, LEAST_SPEED, LEAST_RATE = 0.05, 1e-5, 0.1, 0.2
SIGNIFICANT = 4.0       # standard deviations of a significant time offset
# Readings in the line that extrapolates a delayed body rate. With the IMU 25 ms late, a policy
# that oscillated at 4 Hz had errors of 1.6, 2.0, 2.3 and 6.2 deg with 2, 3, 4 and 8; without
# oscillation its commands changed least with 8.
TREND = 3
# Standard deviations that are added if the IMU contradicts poses: position [m], velocity [m/s],
# attitude [rad], accelerometer bias [m/s^2], gyroscope bias [rad/s] (a dead axis hides a turn).
DOUBT = 0.05, 0.5, 0.01, 1.0
DOUBT_RATE = 3.0


class ErrorStateModel:
    """
    Covariance and correction of one node; contains constants and buffers, no state.

    Attributes:
        marker_to_base: (4,) quaternion from base_link's axes to those of the marker body.

    """

    def __init__(self, parameters: EkfParameters, gravity: float):
        imu, mocap = parameters.imu, parameters.mocap
        self.gravity = gravity
        self.parameters = parameters
        self.filter = KalmanFilter(dim_x=STATES, dim_z=MEASUREMENTS)
        self._no_error = np.zeros(STATES)
        self._transition = np.eye(STATES)
        density = np.zeros(STATES)      # of the process noise, per second
        density[VELOCITY] = imu.accelerometer_noise ** 2 / imu.rate
        density[ATTITUDE] = imu.gyroscope_noise ** 2 / imu.rate
        density[ACCELEROMETER_BIAS] = imu.accelerometer_bias_walk ** 2
        density[GYROSCOPE_BIAS] = imu.gyroscope_bias_walk ** 2
        density[TIME_OFFSET] = OFFSET_WALK ** 2
        self._process = np.diag(density)
        self._period = 1 / imu.rate
        self._doubt = np.diag([*np.repeat(np.square(DOUBT), 3), *np.zeros(4)])

        self._beside = imu.position.any()       # whether the IMU is beside base_link
        # vector from the navigated point (the IMU) to the marker body, in base_link axes
        self._lever = mocap.position - imu.position
        self._turning = rotations.skew(self._lever)
        self.marker_to_base = rotations.conjugate(rotations.exp(mocap.rotation))
        self.filter.H[0:3, POSITION] = self.filter.H[3:6, ATTITUDE] = np.eye(3)
        # quantile of the chi-square distribution
        self.gate = float(2 * gammaincinv(MEASUREMENTS / 2, GATE))

    def start(self, stamp, force, rate, position, quaternion, biases: Node | None) -> Node:
        """
        Make the first node from one pose, at unknown velocity and with an exact time.

        Args:
            stamp: capture time of the pose [s].
            force: (3,) specific force at that time, base_link axes [m/s^2].
            rate: (3,) angular rate at that time, base_link axes [rad/s].
            position: (3,) of the marker body in world [m].
            quaternion: (4,) marker body to world, unit.
            biases: node whose biases and time offset are kept with their covariance, or None.

        """
        attitude = rotations.normalized(rotations.multiply(quaternion, self.marker_to_base))
        rotation = rotations.matrix(attitude)
        arm = rotation @ self._turning
        noise = self.filter.R
        covariance = np.zeros((STATES, STATES))
        covariance[POSITION, POSITION] = noise[:3, :3] + arm @ noise[3:, 3:] @ arm.T
        covariance[POSITION, ATTITUDE] = arm @ noise[3:, 3:]
        covariance[ATTITUDE, POSITION] = covariance[POSITION, ATTITUDE].T
        covariance[ATTITUDE, ATTITUDE] = noise[3:, 3:]
        covariance[VELOCITY, VELOCITY] = FIRST_SPEED ** 2 * np.eye(3)
        if biases is None:
            known = np.zeros(3), np.zeros(3), self.parameters.imu.delay
            covariance[9:, 9:] = np.diag([ACCELEROMETER_BIAS_STD ** 2] * 3
                                         + [GYROSCOPE_BIAS_STD ** 2] * 3 + [0.0])
        else:
            known = biases.accelerometer_bias, biases.gyroscope_bias, biases.time_offset
            covariance[9:15, 9:15] = self.covariance(biases)[9:15, 9:15]
        return Node(stamp, force, rate, position - rotation @ self._lever, np.zeros(3), attitude,
                    rotation, *known, covariance=covariance)

    def add_time_uncertainty(self, node: Node, deviation: float) -> None:
        """
        Make the time offset uncertain in a node that was estimated with an exact offset.

        With another offset the same poses would have given the state of another instant. The
        errors of the states are therefore the error of the offset times their rates. ``deviation``
        [s] is that of the offset; the velocity of the node is known.
        """
        acceleration = node.rotation @ (node.force - node.accelerometer_bias)
        acceleration[2] -= self.gravity
        change = np.zeros(STATES)
        change[POSITION], change[VELOCITY] = -node.velocity, -acceleration
        change[ATTITUDE] = node.gyroscope_bias - node.rate
        change[TIME_OFFSET] = 1.0
        node.covariance = self.covariance(node) + deviation ** 2 * np.outer(change, change)

    def doubt(self, node: Node, span: float) -> Node:
        """
        Add the uncertainty ``DOUBT`` to position, velocity, attitude and biases.

        A gyroscope bias that was wrong for ``span`` [s] has turned the attitude by ``span`` times
        its error. Both errors are therefore correlated, and a pose corrects the rate at once.
        """
        covariance = self.covariance(node) + self._doubt
        change = np.zeros((STATES, 3))
        change[GYROSCOPE_BIAS], change[ATTITUDE] = np.eye(3), -span * np.eye(3)
        covariance += DOUBT_RATE ** 2 * change @ change.T
        return replace(node, covariance=covariance)

    def without_marker_error(self, node: Node) -> Node:
        """
        Correct attitude and bias of the state at the last pose, for the time after it.

        An attitude error of the markers appears as an accelerometer bias perpendicular to gravity,
        which is wrong as soon as the robot turns. In one attitude only the sum of both errors is
        known, and their priors divide it. Beyond three standard deviations it is another error.
        """
        up, markers = node.rotation[2], (self.gravity * MARKER_STD) ** 2
        both = TRUE_BIAS_STD ** 2 + markers
        share = markers / both
        turn = share / self.gravity * rotations.cross(up, node.accelerometer_bias)
        if turn.dot(turn) > (3 * share / self.gravity) ** 2 * both:
            return node
        quaternion = rotations.normalized(rotations.multiply(
            node.quaternion, rotations.exp(-turn)))
        change = np.zeros((STATES, 3))      # with it, poses that return correct both again
        change[ATTITUDE] = np.eye(3)
        change[ACCELEROMETER_BIAS] = -self.gravity * rotations.skew(up)
        return replace(
            node, quaternion=quaternion, rotation=rotations.matrix(quaternion), before=None,
            accelerometer_bias=node.accelerometer_bias + self.gravity * rotations.cross(up, turn),
            covariance=self.covariance(node) + MARKER_STD ** 2 * change @ change.T)

    def covariance(self, node: Node) -> np.ndarray:
        """Covariance (16, 16) of a node, predicted now if it is pending."""
        kalman, steps = self.filter, [node]
        while (before := steps[-1].before) is not None:
            steps.append(before)
        for before, after in pairwise(reversed(steps)):
            dt = after.stamp - before.stamp
            kalman.x, kalman.P = self._no_error, before.covariance
            # Missing samples are interpolated, and the error grows with each of them.
            kalman.predict(F=transition(before, after, self._transition),
                           Q=self._process * (dt * max(1.0, dt / self._period) ** 3))
            after.covariance, after.before = kalman.P, None
        return node.covariance

    def time_deviation(self, node: Node) -> float:
        """Standard deviation of a node's time offset [s], without its walk while pending."""
        while node.before is not None:
            node = node.before
        return sqrt(node.covariance[TIME_OFFSET, TIME_OFFSET])

    def correct(self, prior: Node, position: np.ndarray, quaternion: np.ndarray) -> Node | None:
        """
        Correct a node with a pose of the marker body in world, captured at its stamp.

        Returns:
            the corrected node, or None if the pose fails the chi-square gate.

        """
        kalman, jacobian = self.filter, self.filter.H
        residual = np.empty(MEASUREMENTS)
        residual[:3] = position - prior.position
        x, y, z, w = prior.quaternion.tolist()
        measured = rotations.product(*quaternion.tolist(), *self.marker_to_base.tolist())
        residual[3:] = rotations.log(rotations.product(-x, -y, -z, w, *measured))
        residual[:3] -= prior.rotation.dot(self._lever)
        jacobian[0:3, ATTITUDE] = -prior.rotation.dot(self._turning)
        # A moving pose is displaced by motion times clock offset. Near rest velocity and rate are
        # mostly noise, which is correlated with the residual and would bias the offset.
        rate = prior.rate - prior.gyroscope_bias
        velocity = prior.velocity + prior.rotation.dot(rotations.cross(rate, self._lever))
        jacobian[0:3, TIME_OFFSET] = velocity if velocity.dot(velocity) > LEAST_SPEED ** 2 else 0.0
        jacobian[3:6, TIME_OFFSET] = rate if rate.dot(rate) > LEAST_RATE ** 2 else 0.0
        kalman.P = self.covariance(prior)
        kalman.x = self._no_error
        kalman.update(residual, H=jacobian)
        # The innovation is filterpy's y with inverse covariance SI; not <= also catches NaN.
        if not kalman.y.dot(kalman.SI).dot(kalman.y) <= self.gate:
            return None
        return self._inject(prior, kalman.x, kalman.P)

    def _inject(self, prior: Node, error: np.ndarray, covariance: np.ndarray) -> Node:
        """Add the estimated error to the state; the remaining error has mean zero."""
        turn = error[ATTITUDE].tolist()
        quaternion = rotations.normalized(np.array(rotations.product(
            *prior.quaternion.tolist(), *rotations.exp_parts(*turn))))
        # The remaining attitude error refers to the corrected attitude: right Jacobian of SO(3),
        # first order.
        shift = rotations.skew([-0.5 * angle for angle in turn])
        rows, columns = covariance[ATTITUDE, :], covariance[:, ATTITUDE]
        rows += shift.dot(rows)
        columns += columns.dot(shift.T)
        return Node(prior.stamp, prior.force, prior.rate,
                    prior.position + error[POSITION], prior.velocity + error[VELOCITY],
                    quaternion, rotations.matrix(quaternion),
                    prior.accelerometer_bias + error[ACCELEROMETER_BIAS],
                    prior.gyroscope_bias + error[GYROSCOPE_BIAS],
                    min(LARGEST_OFFSET,
                        max(-LARGEST_OFFSET, prior.time_offset + float(error[TIME_OFFSET]))),
                    0.5 * (covariance + covariance.T))

    def estimate(self, node: Node, readings: Sequence = ()) -> Estimate:
        """
        State of base_link at the stamp of the newest node, with its covariance.

        ``readings`` (stamp, specific force, rate) end with the node's.
        """
        age = node.time_offset
        late = age > SIGNIFICANT * self.time_deviation(node)
        position, velocity, quaternion, measured_rate = (
            self._extrapolated(node, age, readings) if late else
            (node.position, node.velocity, node.quaternion, node.rate))
        rate, arm = measured_rate - node.gyroscope_bias, self.parameters.imu.position
        if self._beside:
            rotation = rotations.matrix(quaternion)
            position = position - rotation.dot(arm)
            velocity = velocity - rotation.dot(rotations.cross(rate, arm))

        def covariance():
            # that at the stamp of the reading, which is up to 50 ms older than the estimate
            return self._covariance_at_base(
                rotations.matrix(quaternion), rate,
                self.covariance(node)[:ERROR_STATES, :ERROR_STATES], arm)

        return Estimate(node.stamp, position, velocity, quaternion, rate,
                        node.accelerometer_bias, node.gyroscope_bias, covariance,
                        self.parameters.imu.gyroscope_noise)

    def _extrapolated(self, node, age, readings) -> tuple[np.ndarray, ...]:
        """
        Extrapolate position, velocity, quaternion and rate over the latency in the IMU's stamps.

        A stamp on arrival can be late but not early. IMU stamps later than the MoCap's therefore
        mean a delayed reading. In the opposite case the MoCap's stamps are late and the reading is
        not delayed. The acceleration is constant over these few milliseconds, and the rate
        continues its trend, by least squares through the last readings. Without the trend, 25 ms
        are a phase lag of 18 deg at 2 Hz.
        """
        trend = np.zeros(3)     # angular acceleration [rad/s^2]
        if len(readings) >= TREND:
            stamps, _, rates = zip(*(readings[k] for k in range(-TREND, 0)))
            times = np.array(stamps)
            times -= np.add.reduce(times) / TREND
            trend = times.dot(rates) / times.dot(times)
        turn = (age * (node.rate - node.gyroscope_bias + 0.5 * age * trend)).tolist()
        acceleration = node.rotation.dot(node.force - node.accelerometer_bias)
        acceleration[2] -= self.gravity
        return (node.position + age * node.velocity + 0.5 * age ** 2 * acceleration,
                node.velocity + age * acceleration,
                np.array(rotations.product(*node.quaternion.tolist(),
                                           *rotations.exp_parts(*turn))),
                node.rate + age * trend)

    def _covariance_at_base(self, rotation, rate, covariance, lever: np.ndarray) -> np.ndarray:
        """Transform a covariance (15, 15) from the IMU: p = p_imu - R r, v = v_imu - R (w x r)."""
        # The noise of the rate w affects the velocity through the arm r.
        swing = rotations.cross(rate, lever)
        arm = rotation @ rotations.skew(lever)
        jacobian = np.eye(ERROR_STATES)
        jacobian[POSITION, ATTITUDE] = arm
        jacobian[VELOCITY, ATTITUDE] = rotation @ rotations.skew(swing)
        jacobian[VELOCITY, GYROSCOPE_BIAS] = -arm
        covariance = jacobian @ covariance @ jacobian.T
        covariance[VELOCITY, VELOCITY] += self.parameters.imu.gyroscope_noise ** 2 * arm @ arm.T
        return covariance
