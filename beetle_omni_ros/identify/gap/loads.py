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
    module, turning = parts.module, signals.imu(theta)[2]
    outward, _, up = module.centre_of_mass
    for i, axis in enumerate(robot.tilt_axes):
        normal = _normal(axis, tilt[:, i:i + 1])
        place = robot.rotors.positions[i] + (outward - module.rotor_offset) * axis \
            + up * normal
        pull = -module.mass * up * np.cross(normal, _felt(signals, theta, place)) @ axis
        load[:, i] = pull - module.inertia[0] * turning @ axis
    return load


def undescribed_load(signals: Signals, theta: dict[str, float]) -> tuple[np.ndarray, ...]:
    """
    Torque on each joint of modules that the file does not describe.

    Returns:
        (N, 4) for each kg m of mass moment, (N, 4) for each kg m^2 of inertia about the joint's
        axis; nothing where the file describes them.

    """
    robot, tilt = signals.robot, signals.joints(theta)[0]
    if robot.multibody is not None:
        return ()
    hanging, turning = np.empty_like(tilt), -signals.imu(theta)[2] @ robot.tilt_axes.T
    for i, axis in enumerate(robot.tilt_axes):
        felt = _felt(signals, theta, robot.rotors.positions[i])
        hanging[:, i] = np.cross(_normal(axis, tilt[:, i:i + 1]), felt) @ axis
    return hanging, turning


def _felt(signals, theta, place):
    """Specific force (N, 3) at a place of the body, in its axes [m/s^2]."""
    force, rate, turning = signals.imu(theta)
    return force + np.cross(turning, place) + np.cross(rate, np.cross(rate, place))


def _normal(axis, tilt):
    """(N, 3) thrust direction of a rotor at tilts (N, 1)."""
    level = np.cross(axis, [0.0, 0.0, 1.0])
    return np.cos(tilt) * [0.0, 0.0, 1.0] + np.sin(tilt) * level


def spin_load(signals: Signals, theta: dict[str, float]) -> np.ndarray:
    """Torque of each rotor on its joint for each N m s of momentum in hover (N, 4) [rad/s]."""
    tilt, rate = signals.joints(theta)[0], signals.imu(theta)[1]
    thrust, robot = signals.thrust(theta)[0], signals.robot
    load = np.empty_like(tilt)
    for i, axis in enumerate(robot.tilt_axes):
        normal = _normal(axis, tilt[:, i:i + 1])
        speed = np.sqrt(np.maximum(thrust[:, i], 0) / robot.hover_thrust)
        load[:, i] = -robot.rotors.spin[i] * speed * (np.cross(rate, normal) @ axis)
    return load
