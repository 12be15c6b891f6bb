"""Every name of INTERFACES is in the catalogue, with a complete description."""

import math

import numpy as np
import pytest

from beetle_omni_ros.identify.gap.keys import all_keys
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters

NAMES = {
    'body': 'mass centre_of_mass inertia thrust_coefficient rotor_thrust_coefficient '
            'torque_coefficient ground_effect rotor_drag body_drag axial_inflow '
            'translational_lift tilt_thrust_loss wind propeller_gyroscopic_torque '
            'rotor_acceleration_torque module_reaction',
    'rotor': 'voltage_sag rotor_lag rotor_dead_time thrust_saturation',
    'timing': 'command_latency joint_feedback_delay mocap_time_offset imu_filter_lag',
    'joint': 'joint_command_latency joint_bandwidth joint_velocity_limit joint_torque_limit '
             'joint_friction joint_backlash joint_deflection joint_offset '
             'joint_encoder_error',
    'sensor': 'imu_accelerometer_bias imu_gyroscope_bias imu_misalignment imu_lever_arm '
              'mocap_misalignment'}
PARAMETERS = {
    'mass': ['mass'], 'centre_of_mass': ['offset'], 'inertia': ['inertia'],
    'thrust_coefficient': ['scale'], 'rotor_thrust_coefficient': ['scale'],
    'torque_coefficient': ['torque_to_thrust_ratio'], 'rotor_drag': ['coefficient'],
    'body_drag': ['coefficient'], 'wind': ['force'], 'ground_effect': ['gain_at_0.25m'],
    'tilt_thrust_loss': ['loss_at_60deg'], 'axial_inflow': ['per_rotor'],
    'propeller_gyroscopic_torque': ['angular_momentum_at_hover'],
    'module_reaction': ['module_inertia'], 'rotor_lag': ['time_constant'],
    'voltage_sag': ['exponent'], 'joint_friction': ['coulomb', 'stiction'],
    'joint_backlash': ['gap'], 'joint_velocity_limit': ['velocity_limit'],
    'joint_bandwidth': ['kp', 'kd'], 'joint_offset': ['offset'],
    'joint_encoder_error': ['gain', 'sine', 'cosine'],
    'joint_deflection': ['deflection_per_newton'], 'command_latency': ['delay'],
    'joint_command_latency': ['delay'], 'rotor_dead_time': ['delay'],
    'joint_feedback_delay': ['delay'], 'mocap_time_offset': ['delay'],
    'imu_filter_lag': ['delay'], 'imu_accelerometer_bias': ['bias'],
    'imu_gyroscope_bias': ['bias'], 'imu_misalignment': ['rotation'],
    'mocap_misalignment': ['rotation']}
ROBOT = RobotParameters.load()


def test_fixed_names_exist_in_their_layer_with_their_parameters():
    for layer, names in NAMES.items():
        for name in names.split():
            assert CATALOGUE[name].layer == layer, name
    for name, parameters in PARAMETERS.items():
        assert set(parameters) <= set(CATALOGUE[name].parameters), name


def test_a_value_of_the_robot_file_is_varied_by_a_ratio():
    keys = all_keys(ROBOT)
    assert keys['mass.mass'].relative
    assert keys['mass.mass'].value(math.log(1.1)) == pytest.approx(1.1 * ROBOT.mass)
    assert not keys['wind.force[1]'].relative
    assert keys['wind.force[1]'].value(0.7) == 0.7
    assert all(math.isfinite(key.base) and key.low < key.high for key in keys.values())
    assert np.allclose([keys[f'inertia.inertia[{k}]'].base for k in range(3)], ROBOT.inertia)
