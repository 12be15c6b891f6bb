"""
The catalogue of named effects: terms that reality may add to the model.

Each effect is declared once, with equation, source, parameters, excitation and the effects that
it is confused with. A robot file enables an effect by naming it; the place of action follows from
its kind, see :attr:`Effect.kind`.
"""

import casadi as ca

from beetle_omni_ros.model.terms import Effect, EffectParameter, NAN

UP = ca.DM([0, 0, 1])
REFERENCE_HEIGHT = 0.25     # [m] of the rotor, for which the gain of the ground effect is given
EXPONENTIAL_HEIGHT = 0.25   # [m] over which the exponential form falls to 1/e
LEAST_HEIGHT = 0.08         # [m] below which the forms are not valid
NO_JOINTS = 'the filter does not read the joints'


def vector(values):
    """(n,) column of a tuple of numbers or symbols; any other value unchanged."""
    return ca.vertcat(*ca.vertsplit(ca.SX(ca.vertcat(*values)))) if isinstance(values, tuple) \
        else values


def sets(term):
    """Equation of an effect whose one parameter replaces a term."""
    return lambda terms, **values: setattr(terms, term, vector(*values.values()))


def centre_of_mass(terms, offset):
    terms.centre_of_mass = terms.centre_of_mass + vector(offset)


def module_reaction(terms, module_inertia, mass_moment):
    for i in range(4):
        rate, acceleration = terms.tilt_rate[i], terms.tilt_acceleration[i]
        n, e = terms.thrust_directions[i], terms.tilt_axes[i]
        terms.torque = terms.torque - module_inertia * acceleration * e
        # The centre of mass of the module is below the joint axis. It moves against the thrust,
        # and its acceleration pushes back on the axis.
        terms.centre_of_mass = terms.centre_of_mass - mass_moment / terms.mass * (n - UP)
        sideways = ca.cross(e, n)
        terms.rotor_forces[i] = terms.rotor_forces[i] + mass_moment * (
            acceleration * sideways - rate * rate * n
            + 2 * rate * ca.cross(terms.angular_velocity, sideways))


def thrust_coefficient(terms, scale):
    terms.thrust = vector(scale) * terms.thrust


def wind(terms, force):
    terms.force_world = terms.force_world + vector(force)


def body_drag(terms, coefficient):
    speed = ca.sqrt(ca.sumsqr(terms.velocity) + 1e-12)
    terms.force_world = terms.force_world - coefficient * speed * terms.velocity


def rotor_drag(terms, coefficient):
    speeds = terms.rotor_speeds()
    for i, v in enumerate(terms.in_plane_velocities()):
        terms.rotor_forces[i] = terms.rotor_forces[i] - coefficient / 4 * speeds[i] * v


def rotor_hub_moment(terms, coefficient):
    speeds = terms.rotor_speeds()
    for i, v in enumerate(terms.hub_velocities()):
        terms.torque = terms.torque - coefficient / 4 * speeds[i] * ca.cross(
            terms.thrust_directions[i], v)


def axial_inflow(terms, per_rotor):
    speeds = terms.rotor_speeds()
    loss = [per_rotor * speeds[i] * ca.dot(terms.thrust_directions[i], v)
            for i, v in enumerate(terms.hub_velocities())]
    terms.thrust = terms.thrust - ca.vertcat(*loss)


def translational_lift(terms, per_rotor):
    gain = [per_rotor * ca.sumsqr(v) for v in terms.in_plane_velocities()]
    terms.thrust = terms.thrust + ca.vertcat(*gain)


def tilt_thrust_loss(terms, loss_at_60deg, cosine_share=0.0):
    sine, cosine = ca.sin(terms.tilt), ca.cos(terms.tilt)
    shape = (1 - cosine_share) * sine * sine / 0.75 + cosine_share * 2 * (1 - cosine)
    terms.thrust = terms.thrust * (1 - loss_at_60deg * shape)


def ground_effect(terms, exponential_share=0.0, **values):
    if terms.position is None:
        return
    scale = []
    for i in range(4):
        height = ca.fmax(terms.position[2] + (terms.rotation @ terms.rotor_positions[i])[2],
                         LEAST_HEIGHT)
        upright = (terms.rotation @ terms.thrust_directions[i])[2]
        ratio = REFERENCE_HEIGHT / height
        shape = (1 - exponential_share) * ratio * ratio + exponential_share * ca.exp(
            (REFERENCE_HEIGHT - height) / EXPONENTIAL_HEIGHT)
        scale.append(1 + values['gain_at_0.25m'] * shape * upright * upright)
    terms.thrust = terms.thrust * ca.vertcat(*scale)


def gyroscopic_load(servo, joint, angular_momentum_at_hover, spin_up_share=1.0, joint_share=0.0):
    servo.load = servo.load + joint_share * angular_momentum_at_hover * servo.gyroscopic


def propeller_gyroscopic_torque(terms, angular_momentum_at_hover, spin_up_share=1.0,
                                 joint_share=0.0):
    speeds = terms.rotor_speeds()
    for i in range(4):
        momentum = angular_momentum_at_hover * terms.spin[i] * speeds[i]
        turning = terms.angular_velocity + terms.tilt_rate[i] * terms.tilt_axes[i]
        terms.torque = terms.torque - momentum * ca.cross(turning, terms.thrust_directions[i])
    rotor_acceleration_torque(terms, spin_up_share * angular_momentum_at_hover)


def rotor_acceleration_torque(terms, angular_momentum_at_hover):
    speeds = terms.rotor_speeds()
    for i in range(4):
        # h ~ sqrt(f), so h' = h f' / 2 f; the floor keeps a stopped rotor finite
        rate = terms.thrust_rate[i] / (2 * terms.hover_thrust * ca.fmax(speeds[i], 0.1))
        terms.torque = terms.torque - angular_momentum_at_hover * terms.spin[i] * rate \
            * terms.thrust_directions[i]


def voltage_sag(terms, exponent):
    terms.thrust = terms.thrust * ca.exp(exponent * ca.log(terms.voltage_ratio))


def joint_offset(terms, offset):
    offset = vector(offset)
    turned = []
    for i in range(4):
        n, e = terms.thrust_directions[i], terms.tilt_axes[i]
        turned.append(ca.cos(offset[i]) * n + ca.sin(offset[i]) * ca.cross(e, n))
    terms.tilt, terms.thrust_directions = terms.tilt + offset, turned


def joint_deflection(servo, joint, deflection_per_newton):
    servo.target = servo.target + deflection_per_newton * servo.thrust


def per_joint(value, joint: int):
    """Value of a joint, from one number for all joints or a tuple of four."""
    return value[joint] if isinstance(value, tuple) else value


def joint_friction(servo, joint, coulomb, stiction):
    servo.coulomb, servo.stiction = per_joint(coulomb, joint), per_joint(stiction, joint)


def _delay(typical, smallest=0.003, **more):
    return {'delay': EffectParameter('s', 0.0, -0.05, 0.2, typical, smallest, **more)}


def _number(key, unit, low, high, typical, smallest, step=0.01, **more):
    return EffectParameter(unit, NAN, low, high, typical, smallest, number=key, step=step, **more)


# In order of application: the true tilt first, because it changes the thrust directions.
CATALOGUE: dict[str, Effect] = {
    'joint_offset': Effect(
        'joint', {'offset': EffectParameter('rad', (0.0,) * 4, -0.5, 0.5, 0.03, 0.008,
                                            tolerance='angle')},
        'true tilt = encoder + offset', 'several attitudes',
        ('joint_offset', 'torque_coefficient', 'imu_misalignment'),
        'attitudes with different sets of tilts; a jig', joint_offset, each='joint'),
    'mass': Effect(
        'body', {'mass': EffectParameter('kg', NAN, 0.005, 200, 0.05, 0.01, number='mass',
                                         tolerance='mass')},
        "m v' = F; total mass", 'any flight', ('thrust_coefficient', 'voltage_sag', 'wind'),
        'weigh the robot, or fly fast turns: thrust scales torques too, mass does not',
        sets('mass'), allocated=True),
    'inertia': Effect(
        'body', {'inertia': EffectParameter('kg m^2', (NAN,) * 3, 1e-6, 50, 0.2, 0.05,
                                            number='inertia', tolerance='inertia')},
        "I w' = tau - w x I w, Euler", 'fast turns about every axis',
        ('rotor_lag', 'propeller_gyroscopic_torque', 'thrust_coefficient'),
        'flips by 90 and 180 deg about each axis', sets('inertia')),
    'centre_of_mass': Effect(
        'body', {'offset': EffectParameter('m', (0.0,) * 3, -0.2, 0.2, 0.005, 0.0015)},
        'forces turn the body about its centre of mass, which is displaced from base_link',
        'hover in several attitudes', ('rotor_thrust_coefficient', 'module_reaction'),
        'hover at roll 0, 90, 180 deg and pitch 90 deg', centre_of_mass),
    'module_reaction': Effect(
        'body', {'module_inertia': EffectParameter('kg m^2', 0.0, 0.0, 0.1, 1e-4, 2e-5,
                                                   step=2e-5),
                 'mass_moment': EffectParameter('kg m', 0.0, 0.0, 1.0, 2e-3, 3e-4, 0.0,
                                                step=2e-4)},
        "servo torque J q'' on the body; centre of mass moved by -moment / m (t(q) - t(0)), "
        "reaction force moment (n'' + 2 w x n'); multibody section of the robot file",
        'fast tilting, turned attitudes', ('centre_of_mass', 'inertia'),
        'the same attitude with tilts turned by 180 deg', module_reaction, channels='BJ',
        ignored_by={'plant': 'its modules are bodies with the masses of the multibody section; '
                             'without that section it acts'}),
    'thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', 1.0, 0.2, 2.0, 0.05, 0.01, tolerance='thrust')},
        'f = scale f*, all rotors', 'any flight', ('mass', 'voltage_sag', 'tilt_thrust_loss'),
        'weigh the robot; flights at two states of charge', thrust_coefficient, allocated=True),
    'rotor_thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', (1.0,) * 4, 0.0, 2.0, 0.08, 0.015,
                                          tolerance='thrust')},
        'f_i = scale_i f*_i: damaged propeller or other speed controller',
        'hover in several attitudes', ('centre_of_mass', 'rotor_thrust_coefficient'),
        'tilted attitudes; exchange propellers 1 and 2', thrust_coefficient,
        each='rotor', allocated=True),
    'torque_coefficient': Effect(
        'body', {'torque_to_thrust_ratio': EffectParameter(
            'm', NAN, 0.0, 0.2, 0.2, 0.03, number='rotors.torque_to_thrust_ratio',
            tolerance='torque_ratio')},
        'tau_i = -spin_i ratio f_i about the thrust axis', 'yaw steps, differential thrust',
        ('joint_offset', 'rotor_acceleration_torque'), 'yaw steps at zero tilt',
        sets('torque_ratio'), allocated=True),
    'ground_effect': Effect(
        'body', {'gain_at_0.25m': EffectParameter('1', 0.0, 0.0, 1.0, 0.08, 0.01),
                 'exponential_share': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        'f_i (1 + g s(h) n_z^2), s = (0.25 m / h)^2 after Cheeseman and Bennett 1955, or '
        'exp((0.25 m - h) / 0.25 m); h: rotor above the floor', 'hover below 0.6 m',
        ('thrust_coefficient', 'mass', 'tilt_thrust_loss'),
        'hover ladder at 0.2, 0.3, 0.5, 1.0 and 1.5 m at one state of charge',
        ground_effect),
    'rotor_drag': Effect(
        'body', {'coefficient': EffectParameter('N s/m', 0.0, 0.0, 5.0, 0.4, 0.06)},
        'H-force of Faessler et al. 2018, in the rotor plane, grows with rotor speed '
        'sqrt(f / f_h)', 'translation above 1 m/s', ('body_drag', 'wind'),
        'passes at three speeds with two rotor tilts', rotor_drag),
    'rotor_hub_moment': Effect(
        'body', {'coefficient': EffectParameter('N s', 0.0, -5.0, 5.0, 0.1, 0.015)},
        '-k n x v of stiff blades: the disc tilts back and turns the hub, grows with rotor speed '
        'sqrt(f / f_h) (Mahony et al. 2012; Leishman 2006, ch. 4); k of all rotors',
        'translation above 0.5 m/s', ('centre_of_mass', 'inertia', 'rotor_drag'),
        'passes at three speeds, forwards and sideways', rotor_hub_moment),
    'body_drag': Effect(
        'body', {'coefficient': EffectParameter('N s^2/m^2', 0.0, 0.0, 5.0, 0.05, 0.02)},
        'F = -c |v| v', 'translation above 2 m/s', ('rotor_drag', 'wind'),
        'passes above 4 m/s', body_drag),
    'axial_inflow': Effect(
        'body', {'per_rotor': EffectParameter('N s/m', 0.0, 0.0, 5.0, 0.4, 0.04)},
        'f_i - k sqrt(f_i / f_h) v.n: momentum theory, linear part (Leishman 2006, ch. 2)',
        'climb and descent', ('rotor_lag', 'rotor_drag'),
        'steady climb and descent at 1 m/s beside thrust steps', axial_inflow),
    'translational_lift': Effect(
        'body', {'per_rotor': EffectParameter('N s^2/m^2', 0.0, 0.0, 1.0, 0.03, 0.01)},
        'f_i + k |v_in_plane|^2: induced velocity falls with the flow through the disc '
        '(Leishman 2006, ch. 2)', 'fast passes', ('thrust_coefficient', 'axial_inflow'),
        'level passes at 1, 2 and 3 m/s', translational_lift),
    'tilt_thrust_loss': Effect(
        'body', {'loss_at_60deg': EffectParameter('1', 0.0, 0.0, 0.9, 0.06, 0.01),
                 'cosine_share': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        'f_i (1 - L s(q)), s = sin^2 q / 0.75 or 2 (1 - cos q): arm and body in the wake',
        'large tilts', ('thrust_coefficient', 'mass', 'ground_effect'),
        'one attitude with tilts changed by internal force', tilt_thrust_loss),
    'wind': Effect(
        'body', {'force': EffectParameter('N', (0.0,) * 3, -100, 100, 1.0, 0.1)},
        'constant force in world', 'any flight; yaw turns', ('mass', 'imu_misalignment',
                                                            'mocap_misalignment'),
        'hover at yaw 0 and 180 deg; fan off', wind, allocated=True),
    'propeller_gyroscopic_torque': Effect(
        'body', {'angular_momentum_at_hover': EffectParameter('N m s', 0.0, 0.0, 1.0, 0.066,
                                                              0.008, step=5e-3),
                 'spin_up_share': EffectParameter('1', 1.0, 0.0, 1.0, default=1.0, form=True),
                 'joint_share': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        "-(w + q' e) x h s n - h' s n with h ~ sqrt(f): the propellers' angular momentum; the "
        'part about the tilt axis loads the servo where joint_share is 1',
        'fast turns and fast tilting', ('inertia', 'rotor_acceleration_torque', 'rotor_lag'),
        'fast tilting by internal force at rest', propeller_gyroscopic_torque,
        gyroscopic_load, channels='BJ'),
    'rotor_acceleration_torque': Effect(
        'body', {'angular_momentum_at_hover': EffectParameter('N m s', 0.0, 0.0, 1.0, 0.066,
                                                              0.008)},
        "-h' s n with h ~ sqrt(f): a change of rotor speed turns the body", 'thrust steps',
        ('torque_coefficient', 'propeller_gyroscopic_torque', 'rotor_lag'),
        'differential thrust chirp', rotor_acceleration_torque),
    'voltage_sag': Effect(
        'rotor', {'exponent': EffectParameter('1', 0.0, -1.0, 5.0, 1.0, 0.15)},
        'f = f* (V / V_full)^k: thrust of a thrust map without voltage; 6.9 %/V on this '
        "robot's map", 'flights at several states of charge', ('thrust_coefficient', 'mass'),
        'three flights at different charge; thrust steps by internal force', voltage_sag,
        measured=('voltage_ratio',)),
    'rotor_lag': Effect(
        'rotor', {'time_constant': _number('rotors.time_constant', 's', 0.001, 2.0, 0.4, 0.12,
                                           step=0.02, tolerance='lag')},
        "T f' + f = f*", 'thrust steps', ('rotor_dead_time', 'axial_inflow', 'command_latency'),
        'thrust chirp 0.5 to 8 Hz: a lag reduces the amplitude, a delay shifts the phase only'),
    'rotor_dead_time': Effect(
        'rotor', _delay(0.015), 'f*(t - d): delay of speed controllers and PWM', 'thrust steps',
        ('rotor_lag', 'command_latency'), 'thrust chirp 0.5 to 8 Hz', delays=('thrust',)),
    'thrust_saturation': Effect(
        'rotor', {'thrust_max': _number('rotors.thrust_max', 'N', 0.01, 200, 0.3, 0.02)},
        'f = min(f*, f_max): voltage or speed controller limit', 'commands at the limit',
        ('voltage_sag', 'thrust_coefficient'), 'climb at full thrust',
        starts=((0.95,), (0.8,)), limit=('thrust', 1.2)),
    'command_latency': Effect(
        'timing', _delay(0.02), 'all commands act d later', 'fast tilting and thrust steps',
        ('joint_command_latency', 'rotor_dead_time', 'joint_bandwidth'),
        'sine sweep of the tilts 0.5 to 6 Hz with thrust steps', delays=('tilt', 'thrust'),
        channels='BJ'),
    'joint_command_latency': Effect(
        'joint', _delay(0.02), 'q*(t - d)', 'fast tilting',
        ('joint_bandwidth', 'command_latency', 'joint_feedback_delay'),
        'sine sweep of the tilts 0.5 to 6 Hz', delays=('tilt',), channels='J'),
    'joint_bandwidth': Effect(
        'joint', {name: _number(f'joints.{name}', unit, low, high, 0.3, 0.1, tolerance='lag',
                                of_each=True) for name, unit, low, high in (
            ('kp', 'N m/rad', 1e-4, 1e3), ('kd', 'N m s/rad', 0.0, 1e2))},
        "J q'' = Kp (q* - q) - Kd q'", 'fast tilting', ('joint_command_latency',
                                                       'joint_torque_limit'),
        'sine sweep of the tilts 0.5 to 6 Hz with two amplitudes', channels='J'),
    'joint_velocity_limit': Effect(
        'joint', {
            'velocity_limit': _number('joints.velocity_limit', 'rad/s', 0.1, 100, 0.5, 0.05)},
        "|q'| <= limit: voltage and gearing", 'large tilt steps',
        ('joint_torque_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg',
        channels='J', starts=((0.95,), (0.8,)), limit=('tilt_rate', 0.95)),
    'joint_torque_limit': Effect(
        'joint', {
            # The file's 3 N m is 60 times the demand of quick poses; the real limit may be lower.
            'effort_limit': _number('joints.effort_limit', 'N m', 0.001, 100, 0.8, 0.05)},
        '|tau| <= limit: current limit, stall', 'large tilt steps',
        ('joint_velocity_limit', 'joint_bandwidth'), 'tilt steps of 30, 90 and 180 deg',
        channels='J', starts=((1.1,), (0.8,), (0.5,)), limit=('torque', 0.98)),
    'joint_friction': Effect(
        'joint', dict.fromkeys(('coulomb', 'stiction'), EffectParameter(
            'N m', 0.0, 0.0, 1.0, 0.01, 0.002, of_each=True, step=5e-4)),
        "-coulomb sgn(q') while sliding, up to stiction at rest (Armstrong-Helouvry 1994); "
        'smooth over 0.05 rad/s in the model', 'slow reversals of the tilts',
        ('joint_backlash', 'joint_bandwidth'), 'triangle of 2 deg at 0.1 Hz',
        servo=joint_friction, channels='J',
        starts=((0.003, 0.003), (0.008, 0.008), (0.02, 0.02))),
    'joint_backlash': Effect(
        'joint', {'gap': EffectParameter('rad', 0.0, 0.0, 0.3, 0.01, 0.003, of_each=True),
                  'at_encoder': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        'play of width gap between motor and rotor; the encoder is on the side of the motor, with '
        'at_encoder 1 on that of the rotor', 'reversals of the tilts',
        ('joint_friction', 'joint_feedback_delay'), 'reversals loaded and unloaded',
        starts=((0.005,), (0.02,), (0.05,))),
    'joint_deflection': Effect(
        'joint', {'deflection_per_newton': EffectParameter('rad/N', 0.0, -0.05, 0.05, 0.002,
                                                           0.0004, step=1e-4)},
        'thrust off the axis deflects the servo from its target: q* + c f', 'thrust steps',
        ('joint_friction', 'joint_offset'), 'internal force at rest, two levels',
        servo=joint_deflection, channels='J'),
    'joint_encoder_error': Effect(
        'joint', {name: EffectParameter(unit, (0.0,) * 4, -0.3, 0.3, typical, smallest,
                                        default=(0.0,) * 4, sensor=f'encoder_{name}')
                  for name, unit, typical, smallest in (
                      ('gain', '1', 0.02, 0.005), ('sine', 'rad', 0.02, 0.008),
                      ('cosine', 'rad', 0.02, 0.008))},
        "encoder = q + gain q + sine sin q + cosine (cos q - 1): an axis off the encoder's",
        'large tilts', ('joint_offset', 'joint_bandwidth'), 'tilts held over the whole travel',
        each='joint', channels='J', ignored_by={
            'estimator': NO_JOINTS, 'gap': 'a flight does not separate it from joint_offset: fit '
                                           'it to a response log'}),
    'joint_feedback_delay': Effect(
        'timing', _delay(0.01, sensor='encoder_delay', tolerance='delay'),
        'the encoder reading is older than its stamp by d', 'fast tilting',
        ('joint_command_latency', 'mocap_time_offset', 'joint_backlash'),
        'tilting by internal force with the body at rest', delays=('encoders',), channels='BJ'),
    'mocap_time_offset': Effect(
        'timing', _delay(0.01, 0.002, sensor='mocap_delay', tolerance='delay'),
        'the pose is older than its stamp by d', 'fast turns', ('imu_filter_lag',),
        'any turn above 1 rad/s', delays=('mocap',), channels='AW'),
    'imu_filter_lag': Effect(
        'timing', _delay(0.01, 0.002, sensor='imu_delay', tolerance='delay'),
        'specific force and rates are older than their stamp by d: filters of the IMU',
        'fast turns', ('mocap_time_offset', 'rotor_dead_time'),
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
                                               sensor='imu_rotation', tolerance='angle')},
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
                                               sensor='mocap_rotation', tolerance='angle')},
        'marker axes rotated by exp(rotation) against base_link', 'several attitudes',
        ('imu_misalignment', 'wind'), 'hover at yaw 0, 90, 180 and 270 deg', channels='AW'),
}
