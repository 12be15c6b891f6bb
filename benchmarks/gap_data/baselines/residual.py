"""
What measurement and described model disagree by, as a function of every parameter at once.

Four groups of channels: body wrench (IMU against model, 6), accelerations (IMU against MoCap, 3),
rates (MoCap against gyroscope, 3), joints (encoders against the servo's equation, 4). Parameters
are zero for the described robot; the residual is linearised about that.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
import yaml

from gap_data.baselines.logs import GRID, Log, smooth

CUT, EVERY = 8.0, 10  # [Hz] of the residuals; one grid row in so many is kept
# name -> (number of parameters, step of the finite difference, reported parameter, unit)
EFFECTS = {
    'mass': (1, 0.03, 'mass', 'kg'), 'centre_of_mass': (3, 1e-3, 'offset', 'm'),
    'inertia': (3, 1e-3, 'inertia', 'kg m^2'), 'thrust_coefficient': (1, 0.01, 'scale', '1'),
    'rotor_thrust_coefficient': (4, 0.01, 'scale', '1'),
    'torque_coefficient': (1, 1e-3, 'torque_to_thrust_ratio', 'm'),
    'ground_effect': (1, 0.02, 'gain_at_0.25m', '1'),
    'rotor_drag': (1, 0.05, 'coefficient', 'N s/m'),
    'body_drag': (1, 0.05, 'coefficient', 'N s^2/m^2'),
    'axial_inflow': (1, 0.05, 'per_rotor', 'N s/m'),
    'translational_lift': (1, 0.02, 'gain', 'N s^2/m^2'),
    'tilt_thrust_loss': (1, 0.01, 'loss_at_60deg', '1'), 'wind': (3, 0.1, 'force', 'N'),
    'propeller_gyroscopic_torque': (1, 0.01, 'angular_momentum_at_hover', 'N m s'),
    'rotor_acceleration_torque': (1, 0.01, 'angular_momentum_at_hover', 'N m s'),
    'voltage_sag': (1, 0.1, 'exponent', '1'), 'rotor_lag': (1, 0.005, 'time_constant', 's'),
    'rotor_dead_time': (1, 0.003, 'delay', 's'), 'command_latency': (1, 0.003, 'delay', 's'),
    'joint_command_latency': (1, 0.003, 'delay', 's'), 'joint_bandwidth': (2, 0.03, 'kp kd', ''),
    'joint_friction': (1, 0.002, 'coulomb', 'N m'),
    'joint_deflection': (1, 5e-4, 'deflection_per_newton', 'rad/N'),
    'joint_offset': (4, 0.005, 'offset', 'rad'), 'joint_feedback_delay': (1, 0.003, 'delay', 's'),
    'mocap_time_offset': (1, 0.003, 'delay', 's'), 'imu_filter_lag': (1, 0.003, 'delay', 's'),
    'imu_accelerometer_bias': (3, 0.05, 'bias', 'm/s^2'),
    'imu_gyroscope_bias': (3, 0.005, 'bias', 'rad/s'),
    'imu_misalignment': (3, 0.005, 'rotation', 'rad'),
    'imu_lever_arm': (3, 0.005, 'lever_arm', 'm'),
    'mocap_misalignment': (3, 0.005, 'rotation', 'rad')}
SLICES, SIZE = {}, 0
for _name, (_count, *_) in EFFECTS.items():
    SLICES[_name] = slice(SIZE, SIZE + _count)
    SIZE += _count
AGE = 0.010  # [s] nominal age of a command when it is executed


class Model:
    """The described robot, from the file that the workflow is told."""

    def __init__(self, path):
        given = yaml.safe_load(open(path).read())
        self.mass, self.gravity = given['mass'], given['gravity']
        self.inertia = np.array(given['inertia'])
        rotors, joints = given['rotors'], given['joints']
        self.places, self.yaw = np.array(rotors['positions']), np.array(rotors['arm_yaw'])
        self.spin, self.ratio = np.array(rotors['spin']), rotors['torque_to_thrust_ratio']
        self.lag = rotors['time_constant']
        self.joint = joints['inertia'], joints['kp'], joints['kd']
        self.hover = self.mass * self.gravity / 4


def residual(log: Log, model: Model, theta: np.ndarray) -> np.ndarray:
    """(rows, 16) residuals of all channels under deviations ``theta`` (SIZE,)."""
    p = {name: theta[s] for name, s in SLICES.items()}
    dt = 1 / GRID
    # sensors, turned back to what base_link feels
    ahead = log.t + p['imu_filter_lag'][0]
    turn = Rotation.from_rotvec(p['imu_misalignment']).as_matrix()
    gyro = _shift(log, log.gyro, ahead) @ turn.T - p['imu_gyroscope_bias']
    rate = smooth(gyro, 20.0)
    spin_up = np.gradient(rate, dt, axis=0)
    arm = p['imu_lever_arm']
    force = (_shift(log, log.specific_force, ahead) @ turn.T - p['imu_accelerometer_bias']
             - np.cross(spin_up, arm) - np.cross(rate, np.cross(rate, arm)))
    seen = log.t + p['mocap_time_offset'][0]
    attitude = (Rotation.from_quat(_shift(log, log.quaternion, seen))
                * Rotation.from_rotvec(-p['mocap_misalignment']))
    position = _shift(log, smooth(log.position, 6.0), seen)
    velocity = np.gradient(position, dt, axis=0)
    tilt = smooth(_shift(log, log.tilt, log.t + p['joint_feedback_delay'][0]), 20.0)
    thrust, thrust_rate = _thrust(log, model, p)
    wrench_force, wrench_torque = _wrench(log, model, p, attitude, position, velocity, rate, tilt,
                                          thrust, thrust_rate)
    offset = p['centre_of_mass']
    centre = force + np.cross(spin_up, offset) + np.cross(rate, np.cross(rate, offset))
    inertia = model.inertia + p['inertia']
    body = np.hstack([centre - wrench_force / (model.mass + p['mass'][0]),
                      spin_up - (wrench_torque - np.cross(rate, rate * inertia)) / inertia])
    world = attitude.apply(force) - [0, 0, model.gravity] - np.gradient(velocity, dt, axis=0)
    steps = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / dt
    rates = np.vstack([steps, steps[-1:]]) - gyro
    joints = _shift(log, log.tilt, log.t + p['joint_feedback_delay'][0]) - _servo(
        log, model, p, thrust)
    stacked = np.hstack([smooth(body, CUT), smooth(world, 2.5), smooth(rates, 5.0),
                         smooth(joints, 15.0)])
    return stacked[int(GRID):-int(GRID):EVERY]


def _shift(log, values, times):
    return np.column_stack([np.interp(times, log.t, column) for column in values.T])


def _held(log, columns, delay):
    """Commands on the grid, shifted by a delay; linear between, so that it is differentiable."""
    middle = log.commands[:, 0] + 0.5 * np.median(np.diff(log.commands[:, 0]))
    return np.column_stack([np.interp(log.t - delay, middle, c)
                            for c in log.commands[:, columns].T])


def _thrust(log, model, p):
    # the recursion takes a sample as held before it: half a sample early
    delay = AGE + p['rotor_dead_time'][0] + p['command_latency'][0] + 0.5 / GRID
    held = _held(log, slice(5, 9), delay)
    pole = np.exp(-1 / GRID / (model.lag + p['rotor_lag'][0]))
    thrust = lfilter([1 - pole], [1, -pole], held - held[0], axis=0) + held[0]
    scale = (1 + p['thrust_coefficient'][0] + p['rotor_thrust_coefficient']) * (
        log.voltage[:, None] / 25.2) ** p['voltage_sag'][0]
    return thrust * scale, np.gradient(thrust * scale, 1 / GRID, axis=0)


def _servo(log, model, p, thrust):
    inertia, kp, kd = model.joint
    stiff, damp = kp * (1 + p['joint_bandwidth'][0]), kd * (1 + p['joint_bandwidth'][1])
    # the recursion holds each sample until the next: half a sample late
    held = _held(log, slice(1, 5), AGE + p['joint_command_latency'][0]
                 + p['command_latency'][0] - 0.5 / GRID)
    held = held + p['joint_deflection'][0] * thrust
    held = held - p['joint_friction'][0] / kp * np.tanh(np.gradient(held, 1 / GRID, axis=0) / 0.05)
    step = expm(np.array([[0, 1, 0], [-stiff / inertia, -damp / inertia, stiff / inertia],
                          [0, 0, 0]]) / GRID)
    a, b = step[:2, :2], step[:2, 2]
    poles = [1, -np.trace(a), np.linalg.det(a)]
    zeros = [0, b[0], a[0, 1] * b[1] - a[1, 1] * b[0]]
    return lfilter(zeros, poles, held - held[0], axis=0) + held[0]


def _wrench(log, model, p, attitude, position, velocity, rate, tilt, thrust, thrust_rate):
    total, torque = np.zeros_like(rate), np.zeros_like(rate)
    speed_body = attitude.inv().apply(velocity)
    matrix = attitude.as_matrix()
    tilt_rate = np.gradient(tilt, 1 / GRID, axis=0)
    for i in range(4):
        ca, sa = np.cos(model.yaw[i]), np.sin(model.yaw[i])
        angle = tilt[:, i] + p['joint_offset'][i]
        axis = np.column_stack([np.sin(angle) * sa, -np.sin(angle) * ca, np.cos(angle)])
        place, f = model.places[i], thrust[:, i]
        root = np.sqrt(np.maximum(f, 0.05) / model.hover)
        speed = speed_body + np.cross(rate, place)
        along = np.einsum('ij,ij->i', speed, axis)
        across = speed - along[:, None] * axis
        height = np.maximum(position[:, 2] + matrix[:, 2] @ place, 0.1)
        upright = np.einsum('ij,ij->i', matrix[:, 2], axis)
        f = f * (1 + p['ground_effect'][0] * (0.25 / height) ** 2 * np.maximum(upright, 0) ** 2
                 - p['tilt_thrust_loss'][0] * np.sin(tilt[:, i]) ** 2 / 0.75)
        f = f - p['axial_inflow'][0] * along * root + p['translational_lift'][0] * np.einsum(
            'ij,ij->i', across, across)
        force = f[:, None] * axis - p['rotor_drag'][0] / 4 * root[:, None] * across
        momentum = model.spin[i] * root
        gyro = np.cross(rate + tilt_rate[:, i:i + 1] * [ca, sa, 0], axis) * momentum[:, None]
        up = model.spin[i] * 0.5 / np.maximum(root, 0.3) / model.hover * thrust_rate[:, i]
        ratio = model.ratio + p['torque_coefficient'][0]
        torque += (np.cross(place - p['centre_of_mass'], force)
                   - (model.spin[i] * ratio * f)[:, None] * axis
                   - p['propeller_gyroscopic_torque'][0] * gyro
                   - p['rotor_acceleration_torque'][0] * up[:, None] * axis)
        total += force
    fast = np.linalg.norm(velocity, axis=1, keepdims=True)
    world = p['wind'] - p['body_drag'][0] * fast * velocity
    return total + attitude.inv().apply(world), torque


def jacobian(log: Log, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Residual (rows, 16) of the described robot and its slopes (rows, 16, SIZE)."""
    start = residual(log, model, np.zeros(SIZE))
    slopes = np.empty((*start.shape, SIZE))
    for name, place in SLICES.items():
        for k in range(place.start, place.stop):
            theta = np.zeros(SIZE)
            theta[k] = EFFECTS[name][1]
            slopes[..., k] = (residual(log, model, theta) - start) / EFFECTS[name][1]
    return start, slopes
