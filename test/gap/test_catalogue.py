"""Every name that programs rely on is in the catalogue, with a complete description."""

import pytest

from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.model.effects import CATALOGUE

# layer -> names of its effects, with those of their parameters that are fixed
NAMES = {
    'body': 'mass.mass centre_of_mass.offset inertia.inertia thrust_coefficient.scale '
            'rotor_thrust_coefficient.scale torque_coefficient.torque_to_thrust_ratio '
            'ground_effect.gain_at_0.25m rotor_drag.coefficient body_drag.coefficient '
            'axial_inflow.per_rotor translational_lift tilt_thrust_loss.loss_at_60deg wind.force '
            'propeller_gyroscopic_torque.angular_momentum_at_hover rotor_acceleration_torque '
            'module_reaction.module_inertia',
    'rotor': 'voltage_sag.exponent rotor_lag.time_constant rotor_dead_time.delay '
             'thrust_saturation',
    'timing': 'command_latency.delay joint_feedback_delay.delay mocap_time_offset.delay '
              'imu_filter_lag.delay',
    'joint': 'joint_command_latency.delay joint_bandwidth.kp joint_bandwidth.kd '
             'joint_velocity_limit.velocity_limit joint_torque_limit joint_friction.coulomb '
             'joint_friction.stiction joint_backlash.gap joint_deflection.deflection_per_newton '
             'joint_offset.offset joint_encoder_error.gain joint_encoder_error.sine '
             'joint_encoder_error.cosine',
    'sensor': 'imu_accelerometer_bias.bias imu_gyroscope_bias.bias imu_misalignment.rotation '
              'imu_lever_arm mocap_misalignment.rotation'}


def test_fixed_names_exist_in_their_layer_with_their_parameters():
    for layer, names in NAMES.items():
        for entry in names.split():
            name, _, parameter = entry.partition('.')
            assert CATALOGUE[name].layer == layer, name
            assert not parameter or parameter in CATALOGUE[name].parameters, entry


@pytest.mark.parametrize('name', CATALOGUE)
def test_a_fit_has_a_complete_and_consistent_treatment_of_each_effect(name):
    treatment = TREATMENTS[name]
    assert list(treatment.sizes) == CATALOGUE[name].numbers
    assert treatment.excited_by and treatment.separated_by
    assert all(other in CATALOGUE for other in treatment.confused_with)
    assert set(treatment.channels) <= set('BAWJ') and treatment.channels
    assert all(len(start) == len(treatment.sizes) for start in treatment.starts)
    assert all(size.step > 0 and size.typical > size.smallest > 0
               for size in treatment.sizes.values())
