"""Geometry of the arrows of forces and torques, in base_link."""

import numpy as np

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters

NEWTON_PER_METRE = 40.0         # thrust that is drawn as one metre
TORQUE_RADIUS = 0.07            # [m] of the arcs of torques
TORQUE_HEIGHT = 0.03            # [m] of an arc above its rotor
RADIAN_PER_NEWTON_METRE = 12.0  # angle of the arc
LONGEST_ARC = 5.8               # [rad]
SEGMENTS = 16                   # lines of an arc, without the two of its tip
TIP = 0.025                     # [m]
WORLD_NEWTON_PER_METRE = 40.0   # external force that is drawn as one metre


def rotor_frames(robot: RobotParameters, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Compute the frames of the rotors at tilt angles (4,) [rad].

    Returns:
        (4, 3) centres [m] and (4, 3, 3) axes as columns, x outward along the arm, z along the
        thrust.

    """
    axes = np.empty((4, 3, 3))
    for k, outward in enumerate(robot.tilt_axes):
        turned = rotations.matrix(rotations.exp(outward * tilt[k]))
        axes[k] = turned @ np.column_stack([outward, np.cross([0, 0, 1], outward), [0, 0, 1]])
    return robot.rotors.positions, axes


def thrust_arrows(robot: RobotParameters, tilt: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """
    Return begin and end of each rotor's thrust arrow, (4, 2, 3) in base_link [m].

    ``tilt`` (4,) is in rad, ``thrust`` (4,) in N; NaN: no arrow.
    """
    centres, axes = rotor_frames(robot, tilt)
    length = np.nan_to_num(thrust) / NEWTON_PER_METRE
    return np.stack([centres, centres + length[:, None] * axes[:, :, 2]], axis=1)


def torque_arcs(robot: RobotParameters, tilt: np.ndarray, thrust: np.ndarray) -> np.ndarray:
    """
    Compute arcs for the reaction torque of each rotor on the body, -spin ratio f about its axis.

    The angle of an arc is proportional to the torque and has its direction. ``tilt`` (4,) is in
    rad, ``thrust`` (4,) in N; NaN: no arc.

    Returns:
        (4 * (SEGMENTS + 2), 2, 3) lines in base_link [m].

    """
    centres, axes = rotor_frames(robot, tilt)
    rotors = robot.rotors
    torque = -rotors.spin * rotors.torque_to_thrust_ratio * np.nan_to_num(thrust)
    swept = np.clip(torque * RADIAN_PER_NEWTON_METRE, -LONGEST_ARC, LONGEST_ARC)
    lines = [_arc(angle) @ frame.T + centre
             for angle, frame, centre in zip(swept, axes, centres, strict=True)]
    return np.concatenate(lines)


def _arc(swept):
    """Lines of an arc with a tip about z, in a rotor's frame."""
    angle = np.linspace(0, swept, SEGMENTS + 1)
    points = np.stack([TORQUE_RADIUS * np.cos(angle), TORQUE_RADIUS * np.sin(angle),
                       np.full_like(angle, TORQUE_HEIGHT)], axis=1)
    end, along = points[-1], np.array([-np.sin(swept), np.cos(swept), 0.0]) * np.sign(swept)
    outward = np.array([np.cos(swept), np.sin(swept), 0.0])
    size = min(TIP, TORQUE_RADIUS * abs(swept))
    wings = [end - size * along + side * 0.6 * size * outward for side in (1, -1)]
    return np.concatenate([np.stack([points[:-1], points[1:]], axis=1),
                           [[end, wing] for wing in wings]])
