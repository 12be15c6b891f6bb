"""Effects of rotors, joints and command timing; see :mod:`beetle_omni_ros.robot.effects`."""

import casadi as ca

from beetle_omni_ros.robot.effect_types import (
    Effect,
    EffectParameter,
    LimitStarts,
    Treatment,
    vector,
)

NAN = float('nan')


def _voltage_sag(terms, exponent):
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
    """Value of a joint, from one number for all joints or a tuple of four."""
    return value[joint] if isinstance(value, tuple) else value


def _joint_friction(servo, joint, coulomb, stiction):
    servo.coulomb = per_joint(coulomb, joint)
    servo.stiction = per_joint(stiction, joint)


def _delay(typical, smallest=0.003, **more):
    return {'delay': EffectParameter('s', 0.0, -0.05, 0.2, typical, smallest, curved=True, **more)}


def _friction():
    return EffectParameter('N m', 0.0, 0.0, 1.0, 0.01, 0.002, of_each=True, step=5e-4, curved=True)


def _number(key, unit, low, high, typical, smallest, step=0.01, **more):
    return EffectParameter(unit, NAN, low, high, typical, smallest, number=key, step=step,
                           curved=True, **more)


ACTUATOR: dict[str, Effect] = {
    'voltage_sag': Effect(
        'rotor', {'exponent': EffectParameter('1', 0.0, -1.0, 5.0, 1.0, 0.15)},
        'f = f* (V / V_full)^k: thrust of a thrust map without voltage; 6.9 %/V on this '
        "robot's map", 'flights at several states of charge', ('thrust_coefficient', 'mass'),
        'three flights at different charge; thrust steps by internal force', _voltage_sag,
        measured=('voltage_ratio',)),
    'rotor_lag': Effect(
        'rotor', {'time_constant': _number('rotors.time_constant', 's', 0.001, 2.0, 0.4, 0.12,
                                           step=0.02, tolerance='lag')},
        "T f' + f = f*", 'thrust steps', ('rotor_dead_time', 'axial_inflow', 'command_latency'),
        'thrust chirp 0.5 to 8 Hz: a lag reduces the amplitude, a delay shifts the phase only',
        same_response='rotor_dead_time'),
    'rotor_dead_time': Effect(
        'rotor', _delay(0.015), 'f*(t - d): delay of speed controllers and PWM', 'thrust steps',
        ('rotor_lag', 'command_latency'), 'thrust chirp 0.5 to 8 Hz', delays=('thrust',),
        same_response='rotor_lag'),
    'thrust_saturation': Effect(
        'rotor', {'thrust_max': _number('rotors.thrust_max', 'N', 1.0, 200, 0.3, 0.02)},
        'f = min(f*, f_max): voltage or speed controller limit', 'commands at the limit',
        ('voltage_sag', 'thrust_coefficient'), 'climb at full thrust',
        starts=LimitStarts('thrust', (0.95, 0.8), 1.2)),
    'command_latency': Effect(
        'timing', _delay(0.02), 'all commands act d later', 'fast tilting and thrust steps',
        ('joint_command_latency', 'rotor_dead_time', 'joint_bandwidth'),
        'sine sweep of the tilts 0.5 to 6 Hz with thrust steps', delays=('tilt', 'thrust'),
        channels='BJ'),
    'joint_command_latency': Effect(
        'joint', _delay(0.02),
        'q*(t - d)', 'fast tilting',
        ('joint_bandwidth', 'command_latency', 'joint_feedback_delay'),
        'sine sweep of the tilts 0.5 to 6 Hz', delays=('tilt',), channels='J'),
    'joint_bandwidth': Effect(
        'joint', {
            'kp': _number('joints.kp', 'N m/rad', 1e-4, 1e3, 0.3, 0.1, tolerance='lag',
                          of_each=True),
            'kd': _number('joints.kd', 'N m s/rad', 0.0, 1e2, 0.3, 0.1, tolerance='lag',
                          of_each=True)},
        "J q'' = Kp (q* - q) - Kd q'", 'fast tilting', ('joint_command_latency',
                                                       'joint_torque_limit'),
        'sine sweep of the tilts 0.5 to 6 Hz with two amplitudes', channels='J'),
    'joint_velocity_limit': Effect(
        'joint', {
            'velocity_limit': _number('joints.velocity_limit', 'rad/s', 0.1, 100, 0.5, 0.05)},
        "|q'| <= limit: voltage and gearing", 'large tilt steps',
        ('joint_torque_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg',
        channels='J', starts=LimitStarts('tilt_rate', (0.95, 0.8), 0.95)),
    'joint_torque_limit': Effect(
        'joint', {
            # The file's 3 N m is 60 times the demand of quick poses; the real limit may be lower.
            'effort_limit': _number('joints.effort_limit', 'N m', 0.001, 100, 0.8, 0.05,
                                    least=1e-3)},
        '|tau| <= limit: current limit, stall', 'large tilt steps',
        ('joint_velocity_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg',
        channels='J', starts=LimitStarts('torque', (1.1, 0.8, 0.5), 0.98)),
    'joint_friction': Effect(
        'joint', {
            'coulomb': _friction(), 'stiction': _friction()},
        "-coulomb sgn(q') while sliding, up to stiction at rest (Armstrong-Helouvry 1994); "
        'smooth over 0.05 rad/s in the model', 'slow reversals of the tilts',
        ('joint_backlash', 'joint_bandwidth'), 'triangle of 2 deg at 0.1 Hz',
        servo=_joint_friction, channels='J', starts=((0.004, 0.004), (0.012, 0.015))),
    'joint_backlash': Effect(
        'joint', {'gap': EffectParameter('rad', 0.0, 0.0, 0.3, 0.01, 0.003, of_each=True,
                                         curved=True),
                  'at_encoder': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        'play of width gap between motor and rotor; the encoder is on the side of the motor, with '
        'at_encoder 1 on that of the rotor', 'reversals of the tilts',
        ('joint_friction', 'joint_feedback_delay'), 'reversals loaded and unloaded',
        starts=((0.005,), (0.02,))),
    'joint_deflection': Effect(
        'joint', {'deflection_per_newton': EffectParameter('rad/N', 0.0, -0.05, 0.05, 0.002,
                                                           0.0004, step=1e-4, curved=True)},
        'thrust off the axis deflects the servo from its target: q* + c f', 'thrust steps',
        ('joint_friction', 'joint_offset'), 'internal force at rest, two levels',
        servo=_joint_deflection, channels='J'),
    'joint_offset': Effect(
        'joint', {'offset': EffectParameter('rad', (0.0,) * 4, -0.5, 0.5, 0.03, 0.008,
                                            tolerance='angle')},
        'true tilt = encoder + offset', 'several attitudes',
        ('joint_offset', 'torque_coefficient', 'imu_misalignment'),
        'attitudes with different sets of tilts; a jig', _joint_offset, each='joint'),
    'joint_encoder_error': Effect(
        'joint', {name: EffectParameter(unit, (0.0,) * 4, -0.3, 0.3, typical, smallest,
                                        default=(0.0,) * 4, sensor=f'encoder_{name}')
                  for name, unit, typical, smallest in (
                      ('gain', '1', 0.02, 0.005), ('sine', 'rad', 0.02, 0.008),
                      ('cosine', 'rad', 0.02, 0.008))},
        "encoder = q + gain q + sine sin q + cosine (cos q - 1): an axis off the encoder's",
        'large tilts', ('joint_offset', 'joint_bandwidth'), 'tilts held over the whole travel',
        each='joint', channels='J', treatments={
            'estimator': Treatment(False, 'the filter does not read the joints'),
            'gap': Treatment(False, 'a flight does not separate it from joint_offset: fit it to a '
                                    'response log')}),
    'joint_feedback_delay': Effect(
        'timing', _delay(0.01, sensor='encoder_delay', tolerance='delay'),
        'the encoder reading is older than its stamp by d',
        'fast tilting', ('joint_command_latency', 'mocap_time_offset', 'joint_backlash'),
        'tilting by internal force with the body at rest', delays=('encoders',), channels='BJ'),
}

SENSOR: dict[str, Effect] = {
    'mocap_time_offset': Effect(
        'timing', _delay(0.01, 0.002, sensor='mocap_delay', tolerance='delay'),
        'the pose is older than its stamp by d', 'fast turns', ('imu_filter_lag',),
        'any turn above 1 rad/s', delays=('mocap',), own_clock=True, channels='AW'),
    'imu_filter_lag': Effect(
        'timing', _delay(0.01, 0.002, sensor='imu_delay', tolerance='delay'),
        'specific force and rates are older than their stamp by d: '
        'filters of the IMU', 'fast turns', ('mocap_time_offset', 'rotor_dead_time'),
        'turns above 1 rad/s with thrust steps; log the raw gyroscope', delays=('imu',),
        channels='BAWJ'),
    'imu_accelerometer_bias': Effect(
        'sensor', {'bias': EffectParameter('m/s^2', (0.0,) * 3, -5, 5, 0.15, 0.03,
                                           sensor='accelerometer_bias',
                                           tolerance='bias_accelerometer')},
        'a_measured = a + b', 'several attitudes', ('wind', 'imu_misalignment', 'joint_offset'),
        'at rest in three attitudes before take-off', channels='BA'),
    'imu_gyroscope_bias': Effect(
        'sensor', {'bias': EffectParameter('rad/s', (0.0,) * 3, -1, 1, 0.02, 0.004,
                                           sensor='gyroscope_bias', tolerance='bias_gyroscope')},
        'w_measured = w + b', 'any flight', (), 'at rest before take-off', channels='BW'),
    'imu_misalignment': Effect(
        'sensor', {'rotation': EffectParameter('rad', (0.0,) * 3, -0.5, 0.5, 0.02, 0.004,
                                               sensor='imu_rotation', tolerance='angle',
                                               curved=True)},
        'IMU axes rotated by exp(rotation) against base_link',
        'several attitudes', ('mocap_misalignment', 'wind', 'joint_offset'),
        'hover in three attitudes', channels='BAW'),
    'imu_lever_arm': Effect(
        'sensor', {'offset': EffectParameter('m', (0.0,) * 3, -0.5, 0.5, 0.02, 0.006,
                                             sensor='imu_position')},
        "a + w' x l + w x (w x l)", 'fast turns', ('centre_of_mass', 'inertia'),
        'flips by 180 deg', channels='BA'),
    'mocap_misalignment': Effect(
        'sensor', {'rotation': EffectParameter('rad', (0.0,) * 3, -0.5, 0.5, 0.02, 0.004,
                                               sensor='mocap_rotation', tolerance='angle',
                                               curved=True)},
        'marker axes rotated by exp(rotation) against base_link', 'several attitudes',
        ('imu_misalignment', 'wind'), 'hover at yaw 0, 90, 180 and 270 deg', channels='AW'),
}
