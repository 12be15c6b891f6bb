"""
State of the filter, its propagation between two IMU samples, and the output.

The signals are linear between two samples. The attitude uses the mean rate and the first
commutator (Magnus) term, so that coning motion does not drift, velocity and position the
trapezoidal rule in world. The navigated point is the IMU: no angular acceleration is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.rotations import BodyState

# The 15 error states: position and velocity in world, attitude as rotation vector in base_link
# (R_true = R exp(theta)), accelerometer and gyroscope bias. The offset between the sensors' clocks
# follows them.
POSITION = slice(0, 3)
VELOCITY = slice(3, 6)
ATTITUDE = slice(6, 9)
ACCELEROMETER_BIAS = slice(9, 12)
GYROSCOPE_BIAS = slice(12, 15)
ERROR_STATES = 15
TIME_OFFSET = ERROR_STATES
STATES = ERROR_STATES + 1
ACCELERATING = slice(ATTITUDE.start, GYROSCOPE_BIAS.stop)  # errors that change the acceleration
SAME_INSTANT = 1e-6  # [s] well below a sample period, well above the resolution of a stamp
UNKNOWN = np.full((STATES, STATES), np.nan)


@dataclass(slots=True, eq=False)
class Node:
    """
    IMU reading and state at one instant of the history.

    The covariance of a predicted node is computed on demand, see
    :meth:`.model.ErrorStateModel.covariance`. A replay replaces most predicted nodes before that.

    """

    stamp: float                    # [s]
    force: np.ndarray               # (3,) measured specific force, base_link axes [m/s^2]
    rate: np.ndarray                # (3,) measured angular rate, base_link axes [rad/s]
    position: np.ndarray            # (3,) of the IMU in world [m]
    velocity: np.ndarray            # (3,) of the IMU in world [m/s]
    quaternion: np.ndarray          # (4,) base_link to world
    rotation: np.ndarray            # (3, 3) matrix of it
    accelerometer_bias: np.ndarray  # (3,) base_link axes [m/s^2]
    gyroscope_bias: np.ndarray      # (3,) base_link axes [rad/s]
    time_offset: float              # stamps of the IMU minus those of the MoCap [s]
    # (16, 16) of the error states and the time offset; NaN while pending
    covariance: np.ndarray = field(default_factory=lambda: UNKNOWN)
    before: Node | None = None      # from which a pending covariance is predicted


def propagate(node: Node, stamp: float, force: np.ndarray, rate: np.ndarray,
              gravity: float) -> Node:
    """Propagate the state, without its covariance, to the next IMU reading, in base_link axes."""
    dt = stamp - node.stamp
    ax, ay, az = (node.rate - node.gyroscope_bias).tolist()
    bx, by, bz = (rate - node.gyroscope_bias).tolist()
    h, c = 0.5 * dt, dt * dt / 12
    turn = rotations.exp_parts(h * (ax + bx) + c * (ay * bz - az * by),
                               h * (ay + by) + c * (az * bx - ax * bz),
                               h * (az + bz) + c * (ax * by - ay * bx))
    x, y, z, w = rotations.product(*node.quaternion.tolist(), *turn)
    scale = 1.5 - 0.5 * (x * x + y * y + z * z + w * w)  # Newton step of 1 / norm near 1
    quaternion = np.array((scale * x, scale * y, scale * z, scale * w))
    rotation = rotations.matrix(quaternion)

    # ndarray.dot takes a third of the time of @ at this size
    acceleration0 = node.rotation.dot(node.force - node.accelerometer_bias)
    acceleration1 = rotation.dot(force - node.accelerometer_bias)
    velocity = node.velocity + h * (acceleration0 + acceleration1)
    velocity[2] -= gravity * dt
    position = node.position + dt * node.velocity \
        + dt * dt / 6 * (acceleration0 + acceleration0 + acceleration1)
    position[2] -= 0.5 * gravity * dt * dt
    return Node(stamp, force, rate, position, velocity, quaternion, rotation,
                node.accelerometer_bias, node.gyroscope_bias, node.time_offset, before=node)


def transition(before: Node, after: Node, out: np.ndarray) -> np.ndarray:
    """
    Linearise :func:`propagate`: error after = ``out`` @ error before.

    ``out`` is a (16, 16) buffer, identity in all unwritten blocks.
    """
    dt = after.stamp - before.stamp
    r0, r1 = before.rotation, after.rotation
    lever0 = r0.dot(rotations.skew(before.force - before.accelerometer_bias))
    lever1 = r1.dot(rotations.skew(after.force - after.accelerometer_bias))
    back = r1.T.dot(r0)
    # right Jacobian of SO(3) over the step, to second order: mean of both ends
    drift = (-0.5 * dt) * back
    drift[0, 0] -= 0.5 * dt
    drift[1, 1] -= 0.5 * dt
    drift[2, 2] -= 0.5 * dt
    out[0, 3] = out[1, 4] = out[2, 5] = dt
    out[ATTITUDE, ATTITUDE] = back
    out[ATTITUDE, GYROSCOPE_BIAS] = drift

    # negative derivatives of the acceleration at both ends: by attitude, accelerometer bias and
    # gyroscope bias, in the order of the error states
    start, end = np.zeros((3, 9)), np.empty((3, 9))
    start[:, 0:3], start[:, 3:6] = lever0, r0
    end[:, 0:3], end[:, 3:6], end[:, 6:9] = lever1.dot(back), r1, lever1.dot(drift)
    out[VELOCITY, ACCELERATING] = (-0.5 * dt) * (start + end)
    out[POSITION, ACCELERATING] = (-dt * dt / 6) * (start + start + end)
    return out


@dataclass(eq=False)
class Estimate(BodyState):
    """State of base_link at the newest IMU sample, with biases removed."""

    accelerometer_bias: np.ndarray  # (3,) in base_link axes [m/s^2]
    gyroscope_bias: np.ndarray      # (3,) in base_link axes [rad/s]
    compute_covariance: Callable[[], np.ndarray] = field(repr=False)
    gyroscope_noise: float          # standard deviation of a sample, each axis [rad/s]

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (15, 15) of the error, in the order of this module's slices."""
        return self.compute_covariance()

    def pose_covariance(self) -> np.ndarray:
        """
        Covariance (6, 6) of position [m] and rotation about world axes [rad].

        The filter's rotation error is about body axes, that of nav_msgs/Odometry about world axes.
        """
        jacobian = np.zeros((6, ERROR_STATES))
        jacobian[:3, POSITION] = np.eye(3)
        jacobian[3:, ATTITUDE] = rotations.matrix(self.quaternion)
        return jacobian @ self.covariance @ jacobian.T

    def twist_covariance(self) -> np.ndarray:
        """Covariance (6, 6) of linear [m/s] and angular [rad/s] velocity in base_link."""
        to_body = rotations.matrix(self.quaternion).T
        jacobian = np.zeros((6, ERROR_STATES))
        jacobian[:3, VELOCITY] = to_body
        jacobian[:3, ATTITUDE] = rotations.skew(to_body @ self.velocity)
        jacobian[3:, GYROSCOPE_BIAS] = -np.eye(3)
        covariance = jacobian @ self.covariance @ jacobian.T
        covariance[3:, 3:] += self.gyroscope_noise ** 2 * np.eye(3)
        return covariance
