"""
Separation of accelerometer bias and attitude error of the markers, for dead reckoning.

Let the markers be turned against base_link by a small theta (3,), so that R = R_true exp(theta) is
the attitude by the poses. With specific force f, accelerometer bias b and gravity g in world

    acceleration = R (f - b) + R (f x theta) + g.

In one attitude at rest, b and f x theta have the same effect. In other attitudes theta turns with
the robot differently from b, so that poses in several attitudes determine both. A linear Kalman
filter of position, velocity, b and theta compares the poses with the twice integrated acceleration
and learns them. Nothing of it enters the estimate as long as poses arrive.
"""

from dataclasses import replace
from math import inf

from filterpy.kalman import KalmanFilter
import numpy as np
from scipy.special import gammaincinv

from beetle_omni_ros.estimation.model import FIRST_SPEED
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.state import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    Node,
    SAME_INSTANT,
    STATES,
)
from beetle_omni_ros.robot import rotations

POSES = 20          # averaged in one update
GATE = float(2 * gammaincinv(3 / 2, 0.99999))   # of the chi-square distribution
PLAUSIBLE = 3.0     # standard deviations of an error that the priors explain
MOTION, ERRORS = slice(0, 6), slice(6, 12)  # position and velocity; bias and attitude error
BIAS, TURN = slice(6, 9), slice(9, 12)


class MarkerAlignment:
    """Estimates both errors from used poses, and corrects the state when the poses end."""

    def __init__(self, parameters: EkfParameters, gravity: float):
        """
        Start with the priors.

        Args:
            parameters: of the EKF.
            gravity: magnitude along world -z [m/s^2].

        """
        self._priors, self._gravity = parameters.dead_reckoning, gravity
        self._lever = parameters.mocap.position - parameters.imu.position
        self._walk = self._priors.velocity_walk ** 2
        self._walk_by_rate = self._priors.velocity_walk_by_rate ** 2
        self._bias_walk = parameters.imu.accelerometer_bias_walk ** 2
        self._spread = np.repeat([self._priors.accelerometer_bias_std ** 2,
                                  self._priors.marker_attitude_std ** 2], 3)
        self._kalman = KalmanFilter(dim_x=12, dim_z=3)
        self._kalman.x = np.zeros(12)
        self._kalman.P = np.diag([*np.zeros(6), *self._spread])
        self._stamp = -inf      # of the last pose
        self._window: list[tuple[Node, Node, np.ndarray]] = []

    @property
    def bias(self) -> np.ndarray:
        """(3,) of the accelerometer in base_link [m/s^2]."""
        return self._kalman.x[BIAS]

    @property
    def turn(self) -> np.ndarray:
        """(3,) attitude error of the markers, a rotation vector in base_link [rad]."""
        return self._kalman.x[TURN]

    @property
    def covariance(self) -> np.ndarray:
        """(6, 6) of bias and attitude error."""
        return self._kalman.P[ERRORS, ERRORS]

    def _distrust(self):
        """Be as uncertain as by the priors again, after a sensor has changed."""
        covariance = self._kalman.P
        covariance[ERRORS, :] = covariance[:, ERRORS] = 0.0
        covariance[ERRORS, ERRORS] = np.diag(self._spread)
        self._stamp = -inf

    def add(self, first: Node, last: Node, position: np.ndarray, variance: float) -> None:
        """
        Use one pose.

        Args:
            first: state after the correction by the previous pose.
            last: state predicted from it to the capture time of this pose.
            position: (3,) of the marker body in world [m].
            variance: of each axis of it [m^2].

        """
        if abs(first.stamp - self._stamp) > SAME_INSTANT or last.stamp <= first.stamp:
            self._restart(position - last.rotation @ self._lever)
        else:
            self._window.append((first, last, position))
            if len(self._window) == POSES:
                self._use(variance)
                self._window.clear()
        self._stamp = last.stamp

    def _restart(self, position):
        """Begin with unknown velocity; what is known of the errors stays."""
        kalman = self._kalman
        kalman.x[MOTION] = *position, 0.0, 0.0, 0.0
        kalman.P[MOTION, :] = kalman.P[:, MOTION] = 0.0
        kalman.P[range(6), range(6)] = [1.0] * 3 + [FIRST_SPEED ** 2] * 3
        self._window.clear()

    def _use(self, variance):
        """Update with the poses of the window, and predict to its end."""
        firsts, lasts, positions = zip(*self._window)
        rotation = np.array([node.rotation for node in lasts])
        velocity = np.array([node.velocity for node in firsts])
        dt = np.array([node.stamp for node in lasts]) - [node.stamp for node in firsts]
        bias = np.array([node.accelerometer_bias for node in firsts])
        rate = np.array([node.rate for node in lasts]) - firsts[0].gyroscope_bias
        each = dt[:, None]
        # Effects on the velocity: of both errors (columns 0 to 5), and of the IMU (6).
        step = np.empty((POSES, 3, 7))
        step[:, :, 0:3] = -each[:, :, None] * rotation
        step[:, :, 3:6] = -step[:, :, 0:3] @ np.array(
            [rotations.skew(node.force) for node in lasts])
        known = (step[:, :, 0:3] @ bias[:, :, None])[:, :, 0]
        step[:, :, 6] = np.array([node.velocity for node in lasts]) - velocity - known
        gained = step.cumsum(axis=0)
        # The same on the position.
        moves = each[:, :, None] * (gained - 0.5 * step)
        moves[:, :, 6] = each * (gained - step)[:, :, 6] + np.array(
            [after.position - before.position for before, after in zip(firsts, lasts)]) \
            - each * (velocity + 0.5 * known)
        moved, times = moves.cumsum(axis=0), dt.cumsum()
        places = np.array(positions) - rotation @ self._lever
        self._update(float(times.mean()), moved.mean(axis=0), places.mean(axis=0), variance)
        self._predict(float(times[-1]), moved[-1], gained[-1],
                      float(dt @ (rate * rate).sum(axis=1)))

    def _update(self, time, moved, position, variance):
        """Compare the mean position with the one expected from the start of the window."""
        kalman, jacobian = self._kalman, np.zeros((3, 12))
        jacobian[:, 0:3], jacobian[:, 3:6] = np.eye(3), time * np.eye(3)
        jacobian[:, ERRORS] = moved[:, :6]
        before = kalman.x, kalman.P
        kalman.update(position - moved[:, 6], R=variance / POSES * np.eye(3), H=jacobian)
        if not kalman.y.dot(kalman.SI).dot(kalman.y) <= GATE:
            kalman.x, kalman.P = before
            self._distrust()

    def _predict(self, time, moved, gained, turned):
        """Predict to the end of the window."""
        kalman, transition, noise = self._kalman, np.eye(12), np.zeros((12, 12))
        transition[0:3, 3:6] = time * np.eye(3)
        transition[0:3, ERRORS], transition[3:6, ERRORS] = moved[:, :6], gained[:, :6]
        density = (self._walk * time + self._walk_by_rate * turned) * np.eye(3)
        noise[0:3, 0:3] = density * (time ** 2 / 3)
        noise[0:3, 3:6] = noise[3:6, 0:3] = density * (time / 2)
        noise[3:6, 3:6] = density
        noise[BIAS, BIAS] = self._bias_walk * time * np.eye(3)
        kalman.predict(F=transition, Q=noise)
        kalman.x[MOTION] += [*moved[:, 6], *gained[:, 6]]

    def corrected(self, node: Node, covariance: np.ndarray) -> Node:
        """
        Correct attitude and bias of a state, for the time after the last pose.

        Args:
            node: state whose attitude contains the error of the markers.
            covariance: (16, 16) of it.

        Returns:
            the state, unchanged if its bias or the attitude error is beyond the priors: then it is
            another error.

        """
        bias, turn = self._spread[0], self._spread[3]
        up = node.rotation[2]
        across = node.accelerometer_bias - up * up.dot(node.accelerometer_bias)
        if not turn or across.dot(across) > PLAUSIBLE ** 2 * (bias + self._gravity ** 2 * turn) \
                or self.turn.dot(self.turn) > 3 * PLAUSIBLE ** 2 * turn:
            return node
        quaternion = rotations.normalized(rotations.multiply(
            node.quaternion, rotations.exp(-self.turn)))
        effect = np.zeros((STATES, 6))
        effect[ACCELEROMETER_BIAS, 0:3], effect[ATTITUDE, 3:6] = np.eye(3), -np.eye(3)
        return replace(node, quaternion=quaternion, rotation=rotations.matrix(quaternion),
                       accelerometer_bias=self.bias.copy(), before=None,
                       covariance=covariance + effect @ self.covariance @ effect.T)
