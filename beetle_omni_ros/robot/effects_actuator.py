"""Effects of rotors, joints and command timing; see :mod:`beetle_omni_ros.robot.effects`."""

from __future__ import annotations

import casadi as ca

from beetle_omni_ros.robot.effect_types import Effect, EffectParameter, vector

NAN = float('nan')


def _voltage_sag(terms, exponent):
    if terms.voltage_ratio is not None:
        terms.thrust = terms.thrust * ca.exp(exponent * ca.log(terms.voltage_ratio))


def _joint_offset(terms, offset):
    offset = vector(offset)
    turned = []
    for i in range(4):
        n, e = terms.thrust_directions[i], terms.tilt_axes[i]
        turned.append(ca.cos(offset[i]) * n + ca.sin(offset[i]) * ca.cross(e, n))
    terms.tilt, terms.thrust_directions = terms.tilt + offset, turned


def _joint_deflection(servo, joint, deflection_per_newton):
    servo.target = servo.target + per_joint(deflection_per_newton, joint) * servo.thrust


def per_joint(value, joint: int):
    """Value of the joint with this index, of one number for all or of four."""
    return value[joint] if isinstance(value, tuple) else value


def _joint_friction(servo, joint, coulomb, stiction):
    servo.coulomb = per_joint(coulomb, joint)
    servo.stiction = ca.fmax(per_joint(stiction, joint), servo.coulomb)


def _delay(typical, smallest=0.003):
    return {'delay': EffectParameter('s', 0.0, -0.05, 0.2, typical, smallest)}


ACTUATOR: dict[str, Effect] = {
    'voltage_sag': Effect(
        'rotor', {'exponent': EffectParameter('1', 0.0, -1.0, 5.0, 1.0, 0.15)},
        'f = f* (V / V_full)^k: a thrust map that does not know the voltage; 6.9 %/V on this '
        "robot's map", 'flights at several states of charge', ('thrust_coefficient', 'mass'),
        'three flights at different charge; thrust steps by internal force', _voltage_sag),
    'rotor_lag': Effect(
        'rotor', {'time_constant': EffectParameter('s', NAN, 0.001, 2.0, 0.4, 0.12)},
        "T f' + f = f*", 'thrust steps', ('rotor_dead_time', 'axial_inflow', 'command_latency'),
        'thrust chirp 0.5 to 8 Hz: a lag shrinks the answer, a delay only shifts it',
        settings={'time_constant': 'rotors.time_constant'}),
    'rotor_dead_time': Effect(
        'rotor', _delay(0.015), 'f*(t - d): speed controllers, PWM', 'thrust steps',
        ('rotor_lag', 'command_latency'), 'thrust chirp 0.5 to 8 Hz'),
    'thrust_saturation': Effect(
        'rotor', {'thrust_max': EffectParameter('N', NAN, 1.0, 200, 0.3, 0.02)},
        'f = min(f*, f_max): voltage or speed controller limit', 'commands at the limit',
        ('voltage_sag', 'thrust_coefficient'), 'climb at full thrust',
        settings={'thrust_max': 'rotors.thrust_max'}),
    'command_latency': Effect(
        'timing', _delay(0.02), 'all commands act d later', 'fast tilting and thrust steps',
        ('joint_command_latency', 'rotor_dead_time', 'joint_bandwidth'),
        'sine sweep of the tilts 0.5 to 6 Hz with thrust steps'),
    'joint_command_latency': Effect(
        'joint', _delay(0.02), 'q*(t - d)', 'fast tilting',
        ('joint_bandwidth', 'command_latency', 'joint_feedback_delay'),
        'sine sweep of the tilts 0.5 to 6 Hz'),
    'joint_bandwidth': Effect(
        'joint', {'kp': EffectParameter('N m/rad', NAN, 1e-4, 1e3, 0.3, 0.1),
                  'kd': EffectParameter('N m s/rad', NAN, 0.0, 1e2, 0.3, 0.1)},
        "J q'' = Kp (q* - q) - Kd q'", 'fast tilting', ('joint_command_latency',
                                                       'joint_torque_limit'),
        'sine sweep of the tilts 0.5 to 6 Hz with two amplitudes',
        settings={'kp': 'joints.kp', 'kd': 'joints.kd'}),
    'joint_velocity_limit': Effect(
        'joint', {'velocity_limit': EffectParameter('rad/s', NAN, 0.1, 100, 0.5, 0.05)},
        "|q'| <= limit: voltage and gearing", 'large tilt steps',
        ('joint_torque_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg',
        settings={'velocity_limit': 'joints.velocity_limit'}),
    'joint_torque_limit': Effect(
        'joint', {'effort_limit': EffectParameter('N m', NAN, 0.001, 100, 0.8, 0.05)},
        '|tau| <= limit: current limit, stall', 'large tilt steps',
        ('joint_velocity_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg',
        settings={'effort_limit': 'joints.effort_limit'}),
    'joint_friction': Effect(
        'joint', {'coulomb': EffectParameter('N m', 0.0, 0.0, 1.0, 0.01, 0.002, of_each=True),
                  'stiction': EffectParameter('N m', 0.0, 0.0, 1.0, 0.01, 0.002, of_each=True)},
        "-coulomb sgn(q') while sliding, up to stiction at rest (Armstrong-Helouvry 1994); "
        'smooth over 0.05 rad/s in the model', 'slow reversals of the tilts',
        ('joint_backlash', 'joint_bandwidth'), 'triangle of 2 deg at 0.1 Hz',
        servo=_joint_friction),
    'joint_backlash': Effect(
        'joint', {'gap': EffectParameter('rad', 0.0, 0.0, 0.3, 0.01, 0.003)},
        'play of gap between encoder and rotor', 'reversals of the tilts',
        ('joint_friction', 'joint_feedback_delay'), 'reversals loaded and unloaded'),
    'joint_deflection': Effect(
        'joint', {'deflection_per_newton': EffectParameter('rad/N', 0.0, -0.05, 0.05, 0.002,
                                                           0.0004)},
        'thrust off the axis turns the servo from its target: q* + c f', 'thrust steps',
        ('joint_friction', 'joint_offset'), 'internal force at rest, two levels',
        servo=_joint_deflection),
    'joint_offset': Effect(
        'joint', {'offset': EffectParameter('rad', (0.0,) * 4, -0.5, 0.5, 0.03, 0.008)},
        'true tilt = encoder + offset', 'several attitudes',
        ('joint_offset', 'torque_coefficient', 'imu_misalignment'),
        'attitudes with different sets of tilts; a jig', _joint_offset, each='joint'),
    'joint_feedback_delay': Effect(
        'timing', _delay(0.01, 0.003), 'the encoder reading is d older than its stamp',
        'fast tilting', ('joint_command_latency', 'mocap_time_offset', 'joint_backlash'),
        'tilting by internal force while the body rests'),
}

SENSOR: dict[str, Effect] = {
    'mocap_time_offset': Effect(
        'timing', _delay(0.01, 0.002), 'the pose is d older than its stamp', 'fast turns',
        ('imu_filter_lag',), 'any turn above 1 rad/s'),
    'imu_filter_lag': Effect(
        'timing', _delay(0.01, 0.002), 'specific force and rates are d older than their stamp: '
        'filters of the inertial unit', 'fast turns', ('mocap_time_offset', 'rotor_dead_time'),
        'turns above 1 rad/s with thrust steps; log the raw gyroscope'),
    'imu_accelerometer_bias': Effect(
        'sensor', {'bias': EffectParameter('m/s^2', (0.0,) * 3, -5, 5, 0.15, 0.03)},
        'a_measured = a + b', 'several attitudes', ('wind', 'imu_misalignment', 'joint_offset'),
        'at rest in three attitudes before take-off'),
    'imu_gyroscope_bias': Effect(
        'sensor', {'bias': EffectParameter('rad/s', (0.0,) * 3, -1, 1, 0.02, 0.004)},
        'w_measured = w + b', 'any flight', (), 'at rest before take-off'),
    'imu_misalignment': Effect(
        'sensor', {'rotation': EffectParameter('rad', (0.0,) * 3, -0.5, 0.5, 0.02, 0.004)},
        'a sensor with axes rotated by exp(rotation) against base_link',
        'several attitudes', ('mocap_misalignment', 'wind', 'joint_offset'),
        'hover in three attitudes'),
    'imu_lever_arm': Effect(
        'sensor', {'offset': EffectParameter('m', (0.0,) * 3, -0.5, 0.5, 0.02, 0.006)},
        "a + w' x l + w x (w x l)", 'fast turns', ('centre_of_mass', 'inertia'),
        'flips by 180 deg'),
    'mocap_misalignment': Effect(
        'sensor', {'rotation': EffectParameter('rad', (0.0,) * 3, -0.5, 0.5, 0.02, 0.004)},
        'markers with axes rotated by exp(rotation) against base_link', 'several attitudes',
        ('imu_misalignment', 'wind'), 'hover at yaw 0, 90, 180 and 270 deg'),
}
