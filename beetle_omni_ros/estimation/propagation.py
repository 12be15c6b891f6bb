"""
Strapdown propagation between two IMU samples, and its exact linearisation.

The measured signals are linear between two samples. The attitude uses the mean rate and the first
commutator (Magnus) term, so that coning motion does not drift. Velocity and position use the
trapezoidal rule in world, which needs no midpoint. The navigated point is the IMU. Its
accelerometer then needs no correction by the angular acceleration, which is not measured.
"""

from dataclasses import dataclass, field

import numpy as np

from beetle_omni_ros.estimation.samples import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    ERROR_STATES,
    GYROSCOPE_BIAS,
    POSITION,
    VELOCITY,
)
from beetle_omni_ros.robot import rotations

# The offset between the sensors' clocks follows the 15 error states of the estimate.
TIME_OFFSET = ERROR_STATES
STATES = ERROR_STATES + 1
UNKNOWN = np.full((STATES, STATES), np.nan)


@dataclass(slots=True, eq=False)
class Node:
    """
    IMU reading and state at one instant of the history; never changed in place.

    Attributes:
        stamp: [s].
        force: (3,) measured specific force, base_link axes [m/s^2].
        rate: (3,) measured angular rate, base_link axes [rad/s].
        position: (3,) of the IMU in world [m].
        velocity: (3,) of the IMU in world [m/s].
        quaternion: (4,) base_link to world.
        rotation: (3, 3) matrix of ``quaternion``.
        accelerometer_bias: (3,) base_link axes [m/s^2].
        gyroscope_bias: (3,) base_link axes [rad/s].
        time_offset: stamps of the IMU minus stamps of the MoCap at one instant [s].
        after_impact: whether readings just before were beyond the sensor's range.
        covariance: (16, 16) of the error states and the time offset; NaN before its prediction.

    """

    stamp: float
    force: np.ndarray
    rate: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    rotation: np.ndarray
    accelerometer_bias: np.ndarray
    gyroscope_bias: np.ndarray
    time_offset: float
    after_impact: bool = False
    covariance: np.ndarray = field(default_factory=lambda: UNKNOWN)


def propagate(node: Node, stamp: float, force: np.ndarray, rate: np.ndarray,
              gravity: float) -> Node:
    """
    Propagate the state, without its covariance, to the next IMU reading.

    Args:
        node: initial state.
        stamp: stamp of the next reading [s].
        force: (3,) specific force of the next reading, base_link axes [m/s^2].
        rate: (3,) angular rate of the next reading, base_link axes [rad/s].
        gravity: magnitude along world -z [m/s^2].

    """
    dt = stamp - node.stamp
    rate0 = node.rate - node.gyroscope_bias
    rate1 = rate - node.gyroscope_bias
    ax, ay, az = rate0.tolist()
    bx, by, bz = rate1.tolist()
    h, c = 0.5 * dt, dt * dt / 12
    turn = rotations.exp((h * (ax + bx) + c * (ay * bz - az * by),
                          h * (ay + by) + c * (az * bx - ax * bz),
                          h * (az + bz) + c * (ax * by - ay * bx)))
    x, y, z, w = rotations.multiply(node.quaternion.tolist(), turn.tolist()).tolist()
    scale = 1.5 - 0.5 * (x * x + y * y + z * z + w * w)  # Newton step of 1 / norm near 1
    unit = (scale * x, scale * y, scale * z, scale * w)
    rotation = rotations.matrix(unit)

    acceleration0 = node.rotation @ (node.force - node.accelerometer_bias)
    acceleration1 = rotation @ (force - node.accelerometer_bias)
    velocity = node.velocity + h * (acceleration0 + acceleration1)
    velocity[2] -= gravity * dt
    position = (node.position + dt * node.velocity
                + (dt * dt / 6) * (acceleration0 + acceleration0 + acceleration1))
    position[2] -= 0.5 * gravity * dt * dt
    return Node(stamp, force, rate, position, velocity, np.array(unit), rotation,
                node.accelerometer_bias, node.gyroscope_bias, node.time_offset)


def transition(before: Node, after: Node, out: np.ndarray) -> np.ndarray:
    """
    Linearise :func:`propagate`: error after = ``out`` @ error before.

    Args:
        before: initial node of the step.
        after: result of :func:`propagate`.
        out: (16, 16) buffer, identity in all unwritten blocks.

    """
    dt = after.stamp - before.stamp
    r0, r1 = before.rotation, after.rotation
    lever0 = r0 @ rotations.skew((before.force - before.accelerometer_bias).tolist())
    lever1 = r1 @ rotations.skew((after.force - after.accelerometer_bias).tolist())
    back = r1.T @ r0
    out[0, 3] = out[1, 4] = out[2, 5] = dt
    out[ATTITUDE, ATTITUDE] = back
    # right Jacobian of SO(3) over the step, to second order: mean of both ends
    drift = (-0.5 * dt) * back
    drift[0, 0] -= 0.5 * dt
    drift[1, 1] -= 0.5 * dt
    drift[2, 2] -= 0.5 * dt
    out[ATTITUDE, GYROSCOPE_BIAS] = drift

    end_attitude, end_drift = lever1 @ back, lever1 @ drift
    half, sixth = -0.5 * dt, -dt * dt / 6
    out[VELOCITY, ATTITUDE] = half * (lever0 + end_attitude)
    out[VELOCITY, ACCELEROMETER_BIAS] = half * (r0 + r1)
    out[VELOCITY, GYROSCOPE_BIAS] = half * end_drift
    out[POSITION, ATTITUDE] = sixth * (lever0 + lever0 + end_attitude)
    out[POSITION, ACCELEROMETER_BIAS] = sixth * (r0 + r0 + r1)
    out[POSITION, GYROSCOPE_BIAS] = sixth * end_drift
    return out


def identity() -> np.ndarray:
    """Make a buffer for :func:`transition`."""
    return np.eye(STATES)
