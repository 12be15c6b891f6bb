"""
Flights of a quadrotor with fixed rotors that follow a motion exactly, without a simulator.

Position and yaw determine its attitude, thrusts and measurements (differential flatness, Mellinger
and Kumar 2011).
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.table_flight import TableFlight
from beetle_omni_ros.identify.recording.series import turning
from beetle_omni_ros.model.parameters import RobotParameters


def flat_flight(like: TableFlight, position: np.ndarray, yaw: np.ndarray) -> TableFlight:
    """
    A flight without noise.

    Args:
        like: a flight, whose signals the new one has.
        position: (N, 3) in world at the period of ``like`` [m].
        yaw: (N,) [rad].

    """
    robot, h, n = like.robot, like.period, len(yaw)
    velocity = np.gradient(position, h, axis=0)
    acceleration = np.gradient(velocity, h, axis=0)
    felt = acceleration + [0.0, 0.0, robot.gravity]
    up = felt / np.linalg.norm(felt, axis=1, keepdims=True)
    side = np.cross(up, np.stack([np.cos(yaw), np.sin(yaw), np.zeros(n)], axis=1))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = Rotation.from_matrix(np.stack([np.cross(side, up), side, up], axis=2))
    rate = turning(axes.as_quat(), h)
    force = np.stack([np.zeros(n), np.zeros(n), np.linalg.norm(felt, axis=1)], axis=1)
    torque = robot.inertia * np.gradient(rate, h, axis=0) + np.cross(rate, robot.inertia * rate)
    thrust = np.column_stack([robot.mass * force[:, 2], torque]) @ np.linalg.inv(mixer(robot)).T
    thrust += robot.rotors.time_constant * np.gradient(thrust, h, axis=0)   # before the lag
    known = {'position': position, 'quaternion': axes.as_quat(), 'velocity': velocity,
             'acceleration': acceleration, 'specific_force': force, 'angular_velocity': rate,
             'thrust': thrust, 'tilt': np.zeros((n, 4)), 'attitude': axes.as_euler('xyz')}
    values = {name: known[name] for name in like.table.values if name in known}
    if 'velocity' in values and like.table.format.signals['velocity'].frame == 'body':
        values['velocity'] = axes.inv().apply(velocity)
    if (motor := robot.rotors.motor) is not None and 'duty' in like.table.values:
        volts = np.linspace(0.0, motor.nominal_voltage, 200)
        curve = np.maximum.accumulate(np.polynomial.polynomial.polyval(volts, motor.coefficients))
        values['duty'] = np.interp(thrust, curve, volts) / motor.nominal_voltage
        if 'voltage' in like.table.values:
            values['voltage'] = np.full((n, 1), motor.nominal_voltage)
    flight = TableFlight(replace(like.table, name='next flight', values=values), robot, like.body,
                         like.keys)
    lost = {name.split('_')[0] for name in flight.channels} - {
        name.split('_')[0] for name in like.channels}
    flight.without(tuple(lost), 'not in the flights before')
    return flight


def mixer(robot: RobotParameters) -> np.ndarray:
    """(4, 4) thrust and torques [N], [N m] of level rotors, for each newton."""
    rotors = robot.rotors
    x, y, _ = rotors.positions.T
    return np.stack([np.ones(4), y, -x, -rotors.spin * rotors.torque_to_thrust_ratio])
