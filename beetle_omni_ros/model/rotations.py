"""
Rotations with quaternions in scipy's order (x, y, z, w), body to world.

These functions convert to plain floats first, because arithmetic on numpy scalars takes several
times as long. For a few numbers ``ndarray.dot`` takes a third of the time of ``@``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, sin, sqrt
from typing import Any

import numpy as np

Vector = np.ndarray | Sequence[float]


def matrix(quaternion: Vector) -> np.ndarray:
    """Rotation matrix (3, 3) of a unit quaternion (x, y, z, w)."""
    # from flat entries, because nested sequences take longer
    return np.array(entries(*np.asarray(quaternion).tolist())).reshape(3, 3)


def entries(x: float, y: float, z: float, w: float) -> tuple[float, ...]:
    """Entries of :func:`matrix`, row by row."""
    return (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y))


def multiply(a: Vector, b: Vector) -> np.ndarray:
    """Quaternion product: first ``b``, then ``a`` (R(a) R(b))."""
    return np.array(product(*np.asarray(a).tolist(), *np.asarray(b).tolist()))


def product(ax, ay, az, aw, bx, by, bz, bw) -> tuple[Any, Any, Any, Any]:
    """Quaternion product of :func:`multiply` by components x, y, z, w, numbers or arrays."""
    return (aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz)


def conjugate(quaternion: Vector) -> np.ndarray:
    """Inverse of a unit quaternion."""
    x, y, z, w = np.asarray(quaternion).tolist()
    return np.array([-x, -y, -z, w])


def exp(vector: Vector) -> np.ndarray:
    """Unit quaternion of a rotation vector [rad]."""
    return np.array(exp_parts(*np.asarray(vector).tolist()))


def exp_parts(x: float, y: float, z: float) -> tuple[float, ...]:
    """Components x, y, z, w of :func:`exp`, for :func:`product`."""
    squared = x * x + y * y + z * z
    if squared < 1e-12:
        scale, w = 0.5 - squared / 48, 1 - squared / 8
    else:
        angle = sqrt(squared)
        scale, w = sin(0.5 * angle) / angle, cos(0.5 * angle)
    return scale * x, scale * y, scale * z, w


def log(quaternion: Vector) -> np.ndarray:
    """Rotation vector [rad] of a unit quaternion, at most pi long."""
    x, y, z, w = np.asarray(quaternion).tolist()
    if not w >= 0:
        x, y, z, w = -x, -y, -z, -w
    norm = sqrt(x * x + y * y + z * z)
    scale = 2.0 if norm < 1e-9 else 2 * atan2(norm, w) / norm
    return np.array([scale * x, scale * y, scale * z])


def normalized(quaternion: Vector) -> np.ndarray:
    """``quaternion`` scaled to unit length."""
    q = np.asarray(quaternion, dtype=float)
    return q / sqrt(q.dot(q))


def skew(vector: Vector) -> np.ndarray:
    """Cross-product matrix (3, 3) of a vector."""
    x, y, z = np.asarray(vector).tolist()
    return np.array((0.0, -z, y, z, 0.0, -x, -y, x, 0.0)).reshape(3, 3)


def cross(a: Vector, b: Vector) -> np.ndarray:
    """Cross product of two vectors (3,)."""
    (ax, ay, az), (bx, by, bz) = np.asarray(a).tolist(), np.asarray(b).tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def shortened(vector: np.ndarray, limit: float) -> np.ndarray:
    """The vector, at most ``limit`` long."""
    length = sqrt(vector.dot(vector))
    return vector if length <= limit else vector * (limit / length)


def geodesic_angle(a: Vector, b: Vector) -> float:
    """Angle [rad] of R(b)^T R(a), 0 to pi; the orientation error of this package."""
    bx, by, bz, bw = np.asarray(b).tolist()
    x, y, z, w = product(-bx, -by, -bz, bw, *np.asarray(a).tolist())
    return 2 * atan2(sqrt(x * x + y * y + z * z), abs(w))


def from_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Quaternion of R = Rz(yaw) Ry(pitch) Rx(roll), angles in rad."""
    cr, sr = cos(roll / 2), sin(roll / 2)
    cp, sp = cos(pitch / 2), sin(pitch / 2)
    cy, sy = cos(yaw / 2), sin(yaw / 2)
    return np.array([sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
                     cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy])


def to_rpy(quaternion: Vector) -> np.ndarray:
    """Roll, pitch, yaw [rad] with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z, w = np.asarray(quaternion).tolist()
    sin_pitch = min(1.0, max(-1.0, 2 * (w * y - z * x)))
    return np.array([atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
                     atan2(sin_pitch, sqrt(max(0.0, 1 - sin_pitch * sin_pitch))),
                     atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))])


@dataclass(slots=True, eq=False)
class BodyState:
    """Pose and velocities of base_link at one moment."""

    stamp: float                    # time [s]
    position: np.ndarray            # (3,) in world [m]
    velocity: np.ndarray            # (3,) in world [m/s]
    quaternion: np.ndarray          # (4,) body to world, (x, y, z, w), unit
    angular_velocity: np.ndarray    # (3,) in base_link [rad/s]
