"""
The error-state model: what filterpy's Kalman filter is fed with at each step.

filterpy keeps the error state and does its covariance and gain algebra; around it stands
only what is particular to a rigid body: propagation and residual on SO(3), and the
injection of the estimated error into the state.
"""

from dataclasses import replace

from filterpy.kalman import KalmanFilter
import numpy as np
from scipy.special import gammaincinv

from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.propagation import (
    identity,
    Node,
    propagate,
    STATES,
    TIME_OFFSET,
    transition,
)
from beetle_omni_ros.estimation.samples import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    GYROSCOPE_BIAS,
    POSITION,
    VELOCITY,
)
from beetle_omni_ros.robot import rotations

MEASURED = 6  # position in world, rotation vector in base_link


class ErrorStateModel:
    """
    Prediction and correction of one node; holds constants and buffers, no state.

    Attributes:
        marker_to_base: (4,) quaternion of base_link's axes seen from the marker body.

    """

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
        self.filter = KalmanFilter(dim_x=STATES, dim_z=MEASURED)
        self._no_error = np.zeros(STATES)
        self._transition = identity()
        self._process = _process_noise(parameters)
        self._period = 1 / imu.rate
        # an unseen reading was at the limit of the sensor's range or beyond, in any direction
        self._shock = np.zeros(STATES)
        self._shock[VELOCITY] = imu.specific_force_limit ** 2
        self._shock[ATTITUDE] = imu.angular_velocity_limit ** 2
        self._impact = imu.impact_change ** 2
        doubt, variance = parameters.doubt, np.zeros(STATES)
        variance[POSITION] = doubt.position_std ** 2
        variance[VELOCITY], variance[ATTITUDE] = doubt.velocity_std ** 2, doubt.attitude_std ** 2
        variance[ACCELEROMETER_BIAS] = doubt.accelerometer_bias_std ** 2
        self._doubt = np.diag(variance)

        # the marker body, as seen from the navigated point (the IMU), in base_link axes
        self._lever = mocap.position - imu.position
        self._has_lever = bool(np.any(self._lever))
        self.marker_to_base = rotations.conjugate(rotations.exp(mocap.rotation))
        self.filter.H[0:3, POSITION] = np.eye(3)
        self.filter.H[3:6, ATTITUDE] = np.eye(3)
        self._claimed_noise = (mocap.position_noise ** 2, mocap.orientation_noise ** 2)
        self.scale_noise(1.0, 1.0)
        # quantile of the chi-square distribution
        self.gate = float(2 * gammaincinv(MEASURED / 2, mocap.gate_probability))

    def scale_noise(self, position: float, orientation: float) -> None:
        """Take the MoCap's variances as these multiples of the parameters' ones."""
        self.filter.R = np.diag([position * self._claimed_noise[0]] * 3
                                + [orientation * self._claimed_noise[1]] * 3)

    def start(self, stamp, force, rate, position, quaternion, biases: Node | None) -> Node:
        """
        Make the first node from one pose, at unknown velocity and as if its time were exact.

        Args:
            stamp: capture time of the pose [s].
            force: (3,) specific force then, base_link axes [m/s^2].
            rate: (3,) angular rate then, base_link axes [rad/s].
            position: (3,) of the marker body in world [m].
            quaternion: (4,) marker body to world, unit.
            biases: a node whose biases and time offset are kept with their covariance, or None.

        """
        first = self.parameters.initial
        attitude = rotations.normalized(rotations.multiply(quaternion, self.marker_to_base))
        rotation = rotations.matrix(attitude)
        arm = rotation @ rotations.skew(self._lever)
        noise = self.filter.R
        covariance = np.zeros((STATES, STATES))
        covariance[POSITION, POSITION] = noise[:3, :3] + arm @ noise[3:, 3:] @ arm.T
        covariance[POSITION, ATTITUDE] = arm @ noise[3:, 3:]
        covariance[ATTITUDE, POSITION] = covariance[POSITION, ATTITUDE].T
        covariance[ATTITUDE, ATTITUDE] = noise[3:, 3:]
        covariance[VELOCITY, VELOCITY] = first.velocity_std ** 2 * np.eye(3)
        if biases is None:
            known = np.zeros(3), np.zeros(3), first.time_offset
            covariance[9:, 9:] = np.diag([first.accelerometer_bias_std ** 2] * 3
                                         + [first.gyroscope_bias_std ** 2] * 3 + [0.0])
        else:
            known = biases.accelerometer_bias, biases.gyroscope_bias, biases.time_offset
            covariance[9:15, 9:15] = biases.covariance[9:15, 9:15]
        return Node(stamp, force, rate, position - rotation @ self._lever, np.zeros(3), attitude,
                    rotation, *known, covariance=covariance)

    def doubt_time(self, node: Node, deviation: float) -> None:
        """
        Make the time offset uncertain, in a node that was found as if it were exact.

        With another offset the same poses would have given the states of another moment: their
        errors are the offset's error times how they change.

        Args:
            node: its velocity must be known; its covariance is replaced.
            deviation: standard deviation of the offset [s].

        """
        acceleration = node.rotation @ (node.force - node.accelerometer_bias)
        acceleration[2] -= self.gravity
        change = np.zeros(STATES)
        change[POSITION], change[VELOCITY] = -node.velocity, -acceleration
        change[ATTITUDE] = node.gyroscope_bias - node.rate
        change[TIME_OFFSET] = 1.0
        node.covariance = node.covariance + deviation ** 2 * np.outer(change, change)

    def doubt(self, node: Node, span: float) -> Node:
        """
        The node with velocity, attitude and biases as uncertain as the parameters say.

        A gyroscope bias that was wrong for ``span`` [s] has turned the attitude by span times
        itself. Both errors are therefore correlated, and a pose corrects the rate at once.
        """
        covariance = node.covariance + self._doubt
        change = np.zeros((STATES, 3))
        change[GYROSCOPE_BIAS], change[ATTITUDE] = np.eye(3), -span * np.eye(3)
        covariance += self.parameters.doubt.gyroscope_bias_std ** 2 * change @ change.T
        return replace(node, covariance=covariance)

    def forget(self, node: Node, stamp: float, force: np.ndarray, rate: np.ndarray) -> Node:
        """Move a state across an unknown lapse of time: only the biases are still worth much."""
        limits = self.parameters
        covariance = node.covariance.copy()
        covariance[0:9, :] = covariance[:, 0:9] = 0.0
        covariance[POSITION, POSITION] = limits.mocap.position_limit ** 2 * np.eye(3)
        covariance[VELOCITY, VELOCITY] = limits.initial.velocity_std ** 2 * np.eye(3)
        covariance[ATTITUDE, ATTITUDE] = np.pi ** 2 * np.eye(3)
        return Node(stamp, force, rate, node.position, np.zeros(3), node.quaternion, node.rotation,
                    node.accelerometer_bias, node.gyroscope_bias, node.time_offset,
                    covariance=covariance)

    def predict(self, node: Node, stamp: float, force: np.ndarray, rate: np.ndarray,
                shaken: bool = False) -> Node:
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
        change = force - node.force
        jolt = float(change @ change)
        if shaken or jolt > self._impact:
            self._doubt_impulse(after, dt, jolt, shaken)
        return after

    def _doubt_impulse(self, node, dt, jolt, shaken) -> None:
        """Take the velocity, and after unseen readings the attitude, as shaken over a step."""
        node.shaken = shaken
        density = self._shock.copy() if shaken else np.zeros(STATES)
        density[VELOCITY] += jolt
        node.covariance = node.covariance + np.diag(density * dt ** 2)

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
            rotations.multiply(quaternion, self.marker_to_base)))
        if self._has_lever:
            residual[:3] -= prior.rotation @ self._lever
            kalman.H[0:3, ATTITUDE] = -prior.rotation @ rotations.skew(self._lever)
        self._linearise_time(prior)
        kalman.x = self._no_error
        kalman.P = prior.covariance
        kalman.update(residual, H=kalman.H)
        # The innovation is filterpy's y with inverse covariance SI; not <= also catches NaN.
        if not float(kalman.y @ kalman.SI @ kalman.y) <= self.gate:
            return None
        return self._inject(prior, kalman.x, kalman.P)

    @property
    def whitened_residual(self) -> np.ndarray:
        """(6,) residual of the last :meth:`correct` in standard deviations of the MoCap."""
        return np.ravel(self.filter.y) / np.sqrt(np.diag(self.filter.R))

    def _linearise_time(self, prior) -> None:
        """
        Write the columns of the time offset: what moves is seen displaced by motion x offset.

        At rest they are zero: there, the estimated velocity and rate are mostly noise, which is
        correlated with the residual and would pass for an offset.
        """
        least, jacobian = self.parameters.time_offset, self.filter.H
        rate = prior.rate - prior.gyroscope_bias
        velocity = prior.velocity
        if self._has_lever:
            velocity = velocity + prior.rotation @ np.cross(rate, self._lever)
        jacobian[0:3, TIME_OFFSET] = velocity if velocity @ velocity > least.speed ** 2 else 0.0
        jacobian[3:6, TIME_OFFSET] = rate if rate @ rate > least.rate ** 2 else 0.0

    def _inject(self, prior: Node, error: np.ndarray, covariance: np.ndarray) -> Node:
        """Move the estimated error into the state; the error that remains has mean zero."""
        turn = error[ATTITUDE]
        quaternion = rotations.normalized(
            rotations.multiply(prior.quaternion, rotations.exp(turn.tolist())))
        # The attitude error that remains counts from the corrected attitude: right Jacobian of
        # SO(3), first order.
        shift = -0.5 * rotations.skew(turn.tolist())
        covariance[ATTITUDE, :] += shift @ covariance[ATTITUDE, :]
        covariance[:, ATTITUDE] += covariance[:, ATTITUDE] @ shift.T
        limit = self.parameters.time_offset.limit
        return Node(prior.stamp, prior.force, prior.rate,
                    prior.position + error[POSITION], prior.velocity + error[VELOCITY],
                    quaternion, rotations.matrix(quaternion),
                    prior.accelerometer_bias + error[ACCELEROMETER_BIAS],
                    prior.gyroscope_bias + error[GYROSCOPE_BIAS],
                    min(limit, max(-limit, prior.time_offset + float(error[TIME_OFFSET]))),
                    prior.shaken, 0.5 * (covariance + covariance.T))


def _process_noise(parameters: EkfParameters) -> np.ndarray:
    """Spectral density (16, 16) of the process noise, per second."""
    imu = parameters.imu
    density = np.zeros(STATES)
    density[VELOCITY] = imu.accelerometer_noise ** 2 / imu.rate
    density[ATTITUDE] = imu.gyroscope_noise ** 2 / imu.rate
    density[ACCELEROMETER_BIAS] = imu.accelerometer_bias_walk ** 2
    density[GYROSCOPE_BIAS] = imu.gyroscope_bias_walk ** 2
    density[TIME_OFFSET] = parameters.time_offset.walk ** 2
    return np.diag(density)
