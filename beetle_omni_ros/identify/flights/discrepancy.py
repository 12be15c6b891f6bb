"""
The generic discrepancy: what a model may lack that no catalogue entry describes.

Relative changes of each rotor's thrust and forces along the axes of the world are linear in
features of the motion. The features have no mean, because a constant factor of thrusts and a
constant force are catalogue entries.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.model.parameters import RobotParameters

WAVES = 6               # random features
LEAN = 0.3              # [rad] scale of the tilt of the body
TURN, SWING = 1.0, 2.0  # [rad/s] scales of rates of the body and of tilts


def discrepancies(flights: Sequence) -> list[np.ndarray]:
    """
    Slopes of the channels by the weights of the discrepancy.

    Args:
        flights: objects with ``robot``, ``channels``, ``motion`` and ``time`` [s] of N samples.

    Returns:
        (N, C, 7, P) of each flight: channels by the thrust of each rotor and world forces. Thrusts
        and forces are of relative size one: hover thrust, and the weight.

    """
    features = [features_of(flight.motion, flight.time) for flight in flights]
    mean = np.concatenate(features).mean(axis=0)
    return [acting(flight.robot, flight.motion, own - mean, flight.channels)
            for flight, own in zip(flights, features, strict=True)]


def features_of(motion: dict[str, np.ndarray], time: np.ndarray, quick: bool = False
                ) -> np.ndarray:
    """
    (N, P) features of order one, and cosines of random directions among these.

    They are velocity in the body [m/s], tilt of the body, place [m] and time [min]; the ``quick``
    ones also tilts and rates.
    """
    rotation = Rotation.from_quat(motion['quaternion']).as_matrix()
    velocity = np.einsum('nji,nj->ni', rotation, motion['velocity'])
    lean = rotation[:, 2] if quick else rotation[:, 2, :2]
    parts = [velocity, lean / LEAN, motion['position'], time[:, None] / 60]
    if quick:
        parts += [motion['tilt'], motion['tilt_rate'] / SWING, motion['rate'] / TURN]
    plain = np.concatenate(parts, axis=1)
    rng, count = np.random.default_rng(int(quick)), WAVES * (2 if quick else 1)
    directions = rng.normal(size=(plain.shape[1], count))
    along = plain @ directions / np.sqrt(3) if quick else (plain - plain.mean(axis=0)) @ directions
    waves = np.cos(along + rng.uniform(0, 2 * np.pi, count))
    return np.concatenate([plain, waves], axis=1)


def acting(robot: RobotParameters, motion: dict[str, np.ndarray], features: np.ndarray,
           channels: Sequence[str]) -> np.ndarray:
    """Slopes (N, C, 7, P) of the channels by weights of ``features`` (N, P); velocity first."""
    rotation = Rotation.from_quat(motion['quaternion']).as_matrix()
    acting = np.zeros((len(features), 6, 7))
    for i in range(4):
        tilt, yaw = motion['tilt'][:, i], robot.rotors.arm_yaw[i]
        axis = np.stack([np.sin(tilt) * np.sin(yaw), -np.sin(tilt) * np.cos(yaw),
                         np.cos(tilt)], axis=1) * robot.hover_thrust
        acting[:, :3, i] = axis / robot.mass
        acting[:, 3:, i] = np.cross(robot.rotors.positions[i], axis) / robot.inertia
    acting[:, :3, 4:] = rotation.transpose(0, 2, 1) * robot.gravity
    # A force linear in velocity is the form of drag; as a discrepancy it would replace drag.
    world = np.concatenate([0 * features[:, :3], features[:, 3:]], axis=1)
    factor = np.stack([*[features] * 4, *[world] * 3], axis=1)
    out = np.zeros((len(features), len(channels), 7, features.shape[1]))
    names = ('force_x', 'force_y', 'force_z', 'torque_x', 'torque_y', 'torque_z')
    for c, name in enumerate(channels):
        if name in names:
            out[:, c] = acting[:, names.index(name), :, None] * factor
    return out
