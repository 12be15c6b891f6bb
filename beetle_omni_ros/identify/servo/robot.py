"""Servos of a robot file as parameter sets of the servo model, and back."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.servo.model import INDEX, NAMES, OFF, TERMS
from beetle_omni_ros.model.effects import delaying, per_joint
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import load_yaml

# Entry -> the terms that it changes; of the catalogue, but for the gain and the load.
ENTRIES = {
    'reading_gain': ('encoder_gain',),
    'joint_bandwidth': ('natural_frequency', 'damping_ratio'),
    'joint_command_latency': ('delay',),
    'joint_friction': ('coulomb_friction', 'stiction'),
    'joint_backlash': ('backlash',),
    'joint_offset': ('offset',),
    'joint_encoder_error': ('encoder_gain', 'encoder_sine', 'encoder_cosine'),
    'joint_load': ('load_sine', 'load_cosine'),
    'joint_velocity_limit': ('velocity_limit',),
    'joint_torque_limit': ('torque_limit',),
}
LIMITS = tuple(name for name in ENTRIES if name.endswith('_limit'))
JOINTS = 4
# Delays that a log does not separate from that of the entry above.
OTHER_DELAYS = tuple(name for name in delaying('tilt', 'encoders') if name not in ENTRIES)


def own_delay() -> float:
    """Delay [s] from a command to its reading that the simulator has for every robot."""
    simulator = load_yaml(share_path('params/simulator.yaml'))
    return simulator['command_delay'] + simulator['encoder_latency']


def other_delays(robot: RobotParameters) -> float:
    """Sum of the file's ``OTHER_DELAYS`` [s]."""
    return sum(robot.effects.get(name, {}).get('delay', 0.0) for name in OTHER_DELAYS)


def held(robot: RobotParameters) -> bool:
    """Whether the file's servos hold a command until the next one."""
    # The published gains come from a replay with interpolated commands; others hold for held ones.
    return any(name in robot.effects for name in (*ENTRIES, *OTHER_DELAYS))


def file_sets(robot: RobotParameters, flown: bool = False) -> np.ndarray:
    """
    Parameter sets (4, P) of the servos of a robot file with effects.

    Their delay is that of the simulator and of the file. The published servos have none unless
    ``flown``, because their gains come from a replay without it.

    Sign of the zero: the true tilt is the encoder's plus ``joint_offset``. A servo at rest has the
    commanded true tilt, so its encoder reads the command minus ``joint_offset``. Deflection is not
    included, because it needs a thrust.
    """
    joint, effects = robot.joints, robot.effects
    sets = np.tile(OFF, (JOINTS, 1))
    friction = effects.get('joint_friction', {'coulomb': 0.0, 'stiction': 0.0})
    encoder = effects.get('joint_encoder_error', {})
    for j in range(JOINTS):
        kp, kd = joint.of(j).kp, joint.of(j).kd
        coulomb, stiction = (per_joint(friction[name], j) for name in ('coulomb', 'stiction'))
        values = {
            'natural_frequency': np.sqrt(kp / joint.inertia),
            'damping_ratio': kd / (2 * np.sqrt(kp * joint.inertia)),
            'delay': effects.get('joint_command_latency', {}).get('delay', 0.0)
            + other_delays(robot) + (own_delay() if flown or held(robot) else 0.0),
            'offset': -effects.get('joint_offset', {}).get('offset', (0.0,) * JOINTS)[j],
            'coulomb_friction': coulomb / kp, 'stiction': max(stiction - coulomb, 0.0) / kp,
            'backlash': per_joint(effects.get('joint_backlash', {}).get('gap', 0.0), j) / 2,
            'velocity_limit': joint.velocity_limit, 'torque_limit': joint.effort_limit / kp,
            **{f'encoder_{name}': encoder[name][j] for name in encoder}}
        for name, value in values.items():
            sets[j, INDEX[name]] = np.clip(value, TERMS[name].low, TERMS[name].high)
    return sets


def catalogue_values(values: np.ndarray, robot: RobotParameters) -> dict[str, dict[str, float]]:
    """
    Parameters of the catalogue's joint entries for one parameter set (P,).

    Friction and torque limit of a log are position errors; times the stiffness they are torques.
    """
    value = dict(zip(NAMES, values, strict=True))
    kp = robot.joints.inertia * value['natural_frequency']**2
    band = value['coulomb_friction']
    return {
        'joint_bandwidth': {
            'kp': kp, 'kd': 2 * value['damping_ratio'] * kp / value['natural_frequency']},
        'joint_command_latency': {
            'delay': value['delay'] - other_delays(robot) - own_delay()},
        'joint_friction': {'coulomb': kp * band, 'stiction': kp * (band + value['stiction'])},
        # A log shows the play before the encoder only.
        'joint_backlash': {'gap': 2 * value['backlash'], 'at_encoder': 1.0},
        'joint_offset': {'offset': -value['offset']},
        'joint_encoder_error': {name: value[f'encoder_{name}']
                                for name in ('gain', 'sine', 'cosine')},
        'joint_velocity_limit': {'velocity_limit': value['velocity_limit']},
        'joint_torque_limit': {'effort_limit': kp * value['torque_limit']}}
