"""Torques that motion, gravity and spinning rotors put on the tilt joints."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.gap.signals import Signals


def module_load(signals: Signals, theta: dict[str, float]) -> np.ndarray:
    """Torque of gravity and motion on each joint, from the file's modules (N, 4) [N m]."""
    robot, tilt = signals.robot, signals.joints(theta)[0]
    load = np.zeros_like(tilt)
    parts = robot.multibody
    if parts is None or 'module_reaction' in robot.effects:
        return load
    force, rate, turning = signals.imu(theta)
    module = parts.module
    outward, _, up = module.centre_of_mass
    for i, axis in enumerate(robot.tilt_axes):
        level = np.cross(axis, [0.0, 0.0, 1.0])
        normal = np.cos(tilt[:, i:i + 1]) * [0.0, 0.0, 1.0] + np.sin(tilt[:, i:i + 1]) * level
        place = robot.rotors.positions[i] + (outward - module.rotor_offset) * axis \
            + up * normal
        felt = force + np.cross(turning, place) + np.cross(rate, np.cross(rate, place))
        pull = -module.mass * up * np.cross(normal, felt) @ axis
        load[:, i] = pull - module.inertia[0] * turning @ axis
    return load


def spin_load(signals: Signals, theta: dict[str, float]) -> np.ndarray:
    """Torque of each rotor on its joint for each N m s of momentum in hover (N, 4) [rad/s]."""
    tilt, rate = signals.joints(theta)[0], signals.imu(theta)[1]
    thrust, robot = signals.thrust(theta)[0], signals.robot
    load = np.empty_like(tilt)
    for i, axis in enumerate(robot.tilt_axes):
        level = np.cross(axis, [0.0, 0.0, 1.0])
        normal = np.cos(tilt[:, i:i + 1]) * [0.0, 0.0, 1.0] + np.sin(tilt[:, i:i + 1]) * level
        speed = np.sqrt(np.maximum(thrust[:, i], 0) / robot.hover_thrust)
        load[:, i] = -robot.rotors.spin[i] * speed * (np.cross(rate, normal) @ axis)
    return load
