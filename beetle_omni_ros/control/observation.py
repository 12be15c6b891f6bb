"""
Inputs of a policy: their table, and their computation from state and reference.

Inputs are in SI units without scaling; scaling is part of the policy file. All vectors are in
base_link, so that they do not depend on position, and on heading only by the attitude columns.
"""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.control.base import Reference, State


@dataclass(frozen=True)
class Block:
    """
    One named part of the observation.

    Attributes:
        name: of the quantity.
        size: number of values.
        unit: SI unit, '1' for pure numbers.
        frame: in which it is expressed, or what it belongs to.

    """

    name: str
    size: int
    unit: str
    frame: str


OBSERVATIONS = (
    Block('velocity', 3, 'm/s', 'base_link'),                 # R^T (v - v_ref)
    Block('angular_velocity', 3, 'rad/s', 'base_link'),       # w - R^T R_ref w_ref
    Block('target_position', 3, 'm', 'base_link'),            # R^T (p_ref - p)
    Block('attitude', 6, '1', 'world'),                       # x and z axis of base_link
    Block('target_attitude', 6, '1', 'world'),                # x and z axis of the reference
    Block('tilt', 4, 'rad', 'joint'),                         # measured
    Block('previous_action', 8, '1', 'action'),               # the command in force
)
DISTURBANCES = (
    Block('disturbance_force', 3, 'N', 'base_link'),          # estimated external force
    Block('disturbance_torque', 3, 'N m', 'base_link'),       # estimated external torque
)


def blocks(memory: bool) -> tuple[Block, ...]:
    """Table of the inputs of a policy; ``memory``: with the estimated disturbance."""
    return OBSERVATIONS + DISTURBANCES if memory else OBSERVATIONS


def size(table: tuple[Block, ...]) -> int:
    """Length of the observation with the blocks of ``table``."""
    return sum(block.size for block in table)


def observation(state: State, reference: Reference, previous_action,
                disturbance: np.ndarray | None = None) -> np.ndarray:
    """
    Observation (33,), with a disturbance (39,), as float64.

    Args:
        state: position, velocity, attitude, rates and tilts of the robot.
        reference: at the time of the state plus the lookahead.
        previous_action: (8,) the executed command as an action.
        disturbance: (6,) or longer: external force in world [N], torque in base_link [N m].

    """
    values = observed(state, reference, previous_action)
    if disturbance is not None:
        values += disturbed(state, disturbance)
    return np.array(values)


# Plain floats below: on vectors of three, numpy's calls cost ten times the arithmetic.


def observed(state, reference, previous_action) -> list[float]:
    """Give the first 33 numbers of :func:`observation` as a list, for the control loop."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _rotation(state.quaternion)
    ax, bx, cx, ay, by, cy, az, bz, cz = _rotation(reference.quaternion)
    px, py, pz = (reference.position - state.position).tolist()
    vx, vy, vz = (state.velocity - reference.velocity).tolist()
    wx, wy, wz = state.angular_velocity.tolist()
    p, q, r = reference.angular_velocity.tolist()
    if p or q or r:     # the reference's rates, to world and from there to base_link
        p, q, r = ax * p + bx * q + cx * r, ay * p + by * q + cy * r, az * p + bz * q + cz * r
        wx -= xx * p + yx * q + zx * r
        wy -= xy * p + yy * q + zy * r
        wz -= xz * p + yz * q + zz * r
    return [xx * vx + yx * vy + zx * vz, xy * vx + yy * vy + zy * vz,
            xz * vx + yz * vy + zz * vz, wx, wy, wz,
            xx * px + yx * py + zx * pz, xy * px + yy * py + zy * pz,
            xz * px + yz * py + zz * pz,
            xx, yx, zx, xz, yz, zz, ax, ay, az, cx, cy, cz,
            *state.tilt.tolist(), *previous_action]


def disturbed(state, disturbance) -> list[float]:
    """Give the last six numbers of :func:`observation`: force and torque in base_link."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _rotation(state.quaternion)
    fx, fy, fz, *torque = disturbance[:6].tolist()
    return [xx * fx + yx * fy + zx * fz, xy * fx + yy * fy + zy * fz,
            xz * fx + yz * fy + zz * fz, *torque]


def _rotation(quaternion):
    """Matrix of a unit quaternion (x, y, z, w), row by row."""
    x, y, z, w = quaternion.tolist()
    return (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y))
