"""Effects on the forces and torques of the body; see :mod:`beetle_omni_ros.robot.effects`."""

import casadi as ca

from beetle_omni_ros.robot.effect_types import Effect, EffectParameter, Treatment, vector

NAN = float('nan')
UP = ca.DM([0, 0, 1])
REFERENCE_HEIGHT = 0.25     # [m] of the rotor, for which the gain of the ground effect is given
EXPONENTIAL_HEIGHT = 0.25   # [m] over which the exponential form falls to 1/e
LEAST_HEIGHT = 0.08         # [m] below which the forms are not valid


def _mass(terms, mass):
    terms.mass = mass


def _inertia(terms, inertia):
    terms.inertia = vector(inertia)


def _centre_of_mass(terms, offset):
    terms.centre_of_mass = _moved(terms.centre_of_mass, vector(offset))


def _moved(centre, shift):
    return shift if centre is None else centre + shift


def _module_reaction(terms, module_inertia, mass_moment):
    shift = 0
    for i in range(4):
        rate, acceleration = terms.tilt_rate[i], terms.tilt_acceleration[i]
        n, e = terms.thrust_directions[i], terms.tilt_axes[i]
        terms.torque = terms.torque - module_inertia * acceleration * e
        # The centre of mass of the module is below the joint axis. It moves against the thrust,
        # and its acceleration pushes back on the axis.
        shift = shift - mass_moment / terms.mass * (n - UP)
        sideways = ca.cross(e, n)
        terms.rotor_forces[i] = terms.rotor_forces[i] + mass_moment * (
            acceleration * sideways - rate * rate * n
            + 2 * rate * ca.cross(terms.angular_velocity, sideways))
    terms.centre_of_mass = _moved(terms.centre_of_mass, shift)


def _thrust_coefficient(terms, scale):
    terms.thrust = scale * terms.thrust


def _rotor_thrust_coefficient(terms, scale):
    terms.thrust = ca.vertcat(*scale) * terms.thrust if isinstance(scale, tuple) \
        else scale * terms.thrust


def _torque_coefficient(terms, torque_to_thrust_ratio):
    terms.torque_ratio = torque_to_thrust_ratio


def _wind(terms, force):
    terms.force_world = terms.force_world + vector(force)


def _body_drag(terms, coefficient):
    speed = ca.sqrt(ca.sumsqr(terms.velocity) + 1e-12)
    terms.force_world = terms.force_world - coefficient * speed * terms.velocity


def _rotor_drag(terms, coefficient):
    speeds = terms.rotor_speeds()
    for i, v in enumerate(terms.hub_velocities()):
        n = terms.thrust_directions[i]
        in_plane = v - n * ca.dot(n, v)
        terms.rotor_forces[i] = terms.rotor_forces[i] - coefficient / 4 * speeds[i] * in_plane


def _axial_inflow(terms, per_rotor):
    speeds = terms.rotor_speeds()
    loss = [per_rotor * speeds[i] * ca.dot(terms.thrust_directions[i], v)
            for i, v in enumerate(terms.hub_velocities())]
    terms.thrust = terms.thrust - ca.vertcat(*loss)


def _translational_lift(terms, per_rotor):
    gain = []
    for i, v in enumerate(terms.hub_velocities()):
        n = terms.thrust_directions[i]
        gain.append(per_rotor * ca.sumsqr(v - n * ca.dot(n, v)))
    terms.thrust = terms.thrust + ca.vertcat(*gain)


def _tilt_thrust_loss(terms, loss_at_60deg, cosine_share=0.0):
    sine, cosine = ca.sin(terms.tilt), ca.cos(terms.tilt)
    shape = (1 - cosine_share) * sine * sine / 0.75 + cosine_share * 2 * (1 - cosine)
    terms.thrust = terms.thrust * (1 - loss_at_60deg * shape)


def _ground_effect(terms, exponential_share=0.0, **values):
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


def _gyroscopic_load(servo, joint, angular_momentum_at_hover, spin_up_share=1.0,
                     joint_share=0.0):
    servo.load = servo.load + joint_share * angular_momentum_at_hover * servo.gyroscopic


def _propeller_gyroscopic_torque(terms, angular_momentum_at_hover, spin_up_share=1.0,
                                 joint_share=0.0):
    speeds = terms.rotor_speeds()
    for i in range(4):
        momentum = angular_momentum_at_hover * terms.spin[i] * speeds[i]
        turning = terms.angular_velocity + terms.tilt_rate[i] * terms.tilt_axes[i]
        terms.torque = terms.torque - momentum * ca.cross(turning, terms.thrust_directions[i])
    _rotor_acceleration_torque(terms, spin_up_share * angular_momentum_at_hover)


def _rotor_acceleration_torque(terms, angular_momentum_at_hover):
    speeds = terms.rotor_speeds()
    for i in range(4):
        # h ~ sqrt(f), so h' = h f' / 2 f; the floor keeps a stopped rotor finite
        rate = terms.thrust_rate[i] / (2 * terms.hover_thrust * ca.fmax(speeds[i], 0.1))
        terms.torque = terms.torque - angular_momentum_at_hover * terms.spin[i] * rate \
            * terms.thrust_directions[i]


BODY: dict[str, Effect] = {
    'mass': Effect(
        'body', {'mass': EffectParameter('kg', NAN, 0.05, 200, 0.05, 0.01, number='mass',
                                         tolerance='mass')},
        "m v' = F, Newton; INTERFACES: total mass", 'any flight',
        ('thrust_coefficient', 'voltage_sag', 'wind'),
        'weigh the robot, or fly fast turns: thrust scales torques too, mass does not', _mass,
        allocated=True, plant='model'),
    'inertia': Effect(
        'body', {'inertia': EffectParameter('kg m^2', (NAN,) * 3, 1e-5, 50, 0.2, 0.05,
                                            number='inertia', tolerance='inertia')},
        "I w' = tau - w x I w, Euler", 'fast turns about every axis',
        ('rotor_lag', 'propeller_gyroscopic_torque', 'thrust_coefficient'),
        'flips by 90 and 180 deg about each axis', _inertia, plant='model'),
    'centre_of_mass': Effect(
        'body', {'offset': EffectParameter('m', (0.0,) * 3, -0.2, 0.2, 0.005, 0.0015)},
        'forces turn the body about its centre of mass, which is displaced from base_link',
        'hover in several attitudes', ('rotor_thrust_coefficient', 'module_reaction'),
        'hover at roll 0, 90, 180 deg and pitch 90 deg', _centre_of_mass, plant='model'),
    'module_reaction': Effect(
        'body', {'module_inertia': EffectParameter('kg m^2', 0.0, 0.0, 0.1, 1e-4, 2e-5,
                                                   step=2e-5),
                 'mass_moment': EffectParameter('kg m', 0.0, 0.0, 1.0, 2e-3, 3e-4, 0.0,
                                                step=2e-4)},
        "servo torque J q'' on the body; centre of mass moved by -moment / m (t(q) - t(0)), "
        "reaction force moment (n'' + 2 w x n'); "
        'multibody section of the robot file', 'fast tilting, turned attitudes',
        ('centre_of_mass', 'inertia'), 'the same attitude with tilts turned by 180 deg',
        _module_reaction, channels='BJ', plant='model', treatments={'plant': Treatment(
            False, 'its modules are bodies with the masses of the multibody section; without '
                   'that section it acts')}),
    'thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', 1.0, 0.2, 2.0, 0.05, 0.01, tolerance='thrust')},
        'f = scale f*, all rotors', 'any flight', ('mass', 'voltage_sag', 'tilt_thrust_loss'),
        'weigh the robot; flights at two states of charge', _thrust_coefficient, allocated=True,
        plant='model'),
    'rotor_thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', (1.0,) * 4, 0.0, 2.0, 0.08, 0.015,
                                          tolerance='thrust')},
        'f_i = scale_i f*_i: damaged propeller or other speed controller',
        'hover in several attitudes', ('centre_of_mass', 'rotor_thrust_coefficient'),
        'tilted attitudes; exchange propellers 1 and 2', _rotor_thrust_coefficient, each='rotor',
        allocated=True, plant='model'),
    'torque_coefficient': Effect(
        'body', {'torque_to_thrust_ratio': EffectParameter(
            'm', NAN, 0.0, 0.2, 0.2, 0.03, number='rotors.torque_to_thrust_ratio',
            tolerance='torque_ratio')},
        'tau_i = -spin_i ratio f_i about the thrust axis', 'yaw steps, differential thrust',
        ('joint_offset', 'rotor_acceleration_torque'), 'yaw steps at zero tilt',
        _torque_coefficient, allocated=True, plant='model'),
    'ground_effect': Effect(
        'body', {'gain_at_0.25m': EffectParameter('1', 0.0, 0.0, 1.0, 0.08, 0.01),
                 'exponential_share': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        'f_i (1 + g s(h) n_z^2), s = (0.25 m / h)^2 after Cheeseman and Bennett 1955, or '
        'exp((0.25 m - h) / 0.25 m); h: rotor above the floor', 'hover below 0.6 m',
        ('thrust_coefficient', 'mass', 'tilt_thrust_loss'),
        'hover ladder at 0.2, 0.3, 0.5, 1.0 and 1.5 m at one state of charge', _ground_effect,
        forms=({'exponential_share': 0.0}, {'exponential_share': 1.0}), one_regime=True,
        plant='own'),
    'rotor_drag': Effect(
        'body', {'coefficient': EffectParameter('N s/m', 0.0, 0.0, 5.0, 0.4, 0.06)},
        'H-force of Faessler et al. 2018, in the rotor plane, grows with rotor speed '
        'sqrt(f / f_h)', 'translation above 1 m/s', ('body_drag', 'wind'),
        'passes at three speeds with two rotor tilts', _rotor_drag, plant='own'),
    'body_drag': Effect(
        'body', {'coefficient': EffectParameter('N s^2/m^2', 0.0, 0.0, 5.0, 0.05, 0.02)},
        'F = -c |v| v', 'translation above 2 m/s', ('rotor_drag', 'wind'),
        'passes above 4 m/s', _body_drag, plant='own'),
    'axial_inflow': Effect(
        'body', {'per_rotor': EffectParameter('N s/m', 0.0, 0.0, 5.0, 0.4, 0.04)},
        'f_i - k sqrt(f_i / f_h) v.n: momentum theory, linear part (Leishman 2006, ch. 2)',
        'climb and descent', ('rotor_lag', 'rotor_drag'),
        'steady climb and descent at 1 m/s beside thrust steps', _axial_inflow, plant='own'),
    'translational_lift': Effect(
        'body', {'per_rotor': EffectParameter('N s^2/m^2', 0.0, 0.0, 1.0, 0.03, 0.01)},
        'f_i + k |v_in_plane|^2: induced velocity falls with the flow through the disc '
        '(Leishman 2006, ch. 2)', 'fast passes', ('thrust_coefficient', 'axial_inflow'),
        'level passes at 1, 2 and 3 m/s', _translational_lift),
    'tilt_thrust_loss': Effect(
        'body', {'loss_at_60deg': EffectParameter('1', 0.0, 0.0, 0.9, 0.06, 0.01),
                 'cosine_share': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        'f_i (1 - L s(q)), s = sin^2 q / 0.75 or 2 (1 - cos q): arm and body in the wake',
        'large tilts', ('thrust_coefficient', 'mass', 'ground_effect'),
        'one attitude with tilts changed by internal force', _tilt_thrust_loss,
        forms=({'cosine_share': 0.0}, {'cosine_share': 1.0}), one_regime=True, plant='own'),
    'wind': Effect(
        'body', {'force': EffectParameter('N', (0.0,) * 3, -100, 100, 1.0, 0.1)},
        'constant force in world', 'any flight; yaw turns', ('mass', 'imu_misalignment',
                                                            'mocap_misalignment'),
        'hover at yaw 0 and 180 deg; fan off', _wind, allocated=True, plant='own'),
    'propeller_gyroscopic_torque': Effect(
        'body', {'angular_momentum_at_hover': EffectParameter('N m s', 0.0, 0.0, 1.0, 0.066,
                                                              0.008, step=5e-3),
                 'spin_up_share': EffectParameter('1', 1.0, 0.0, 1.0, default=1.0, form=True),
                 'joint_share': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        "-(w + q' e) x h s n - h' s n with h ~ sqrt(f): the propellers' angular momentum; the "
        'part about the tilt axis loads the servo where joint_share is 1',
        'fast turns and fast tilting', ('inertia', 'rotor_acceleration_torque', 'rotor_lag'),
        'fast tilting by internal force at rest', _propeller_gyroscopic_torque,
        _gyroscopic_load, channels='BJ',
        forms=({'spin_up_share': 0.0}, {'spin_up_share': -1.0}, {'joint_share': 1.0}),
        one_regime=True),
    'rotor_acceleration_torque': Effect(
        'body', {'angular_momentum_at_hover': EffectParameter('N m s', 0.0, 0.0, 1.0, 0.066,
                                                              0.008)},
        "-h' s n with h ~ sqrt(f): a change of rotor speed turns the body", 'thrust steps',
        ('torque_coefficient', 'propeller_gyroscopic_torque', 'rotor_lag'),
        'differential thrust chirp', _rotor_acceleration_torque),
}
