"""
The catalogue of named effects: terms that reality may add to the model.

Each effect is declared once, with equation, source and parameters. A robot file enables an effect
by naming it; the place of action follows from its kind, see :attr:`Effect.kind`.
"""

import casadi as ca
import numpy as np

from beetle_omni_ros.model import formula
from beetle_omni_ros.model.schema import numbers, ParameterError, quoted, unknown
from beetle_omni_ros.model.terms import Effect, EffectParameter, NAN

UP = ca.DM([0, 0, 1])
REFERENCE_HEIGHT = 0.25     # [m] of the rotor, for which the gain of the ground effect is given
LEAST_HEIGHT = 0.08         # [m] below which the law is not valid
NO_JOINTS = 'the filter does not read the joints'
# Terms that the simulated plant and the gap finder have -> why NMPC and training leave out an
# effect of them.
MEASURED = {'voltage_ratio': 'it has no voltage and assumes a full pack'}
NO_STATE = 'it does not integrate the state of an effect'
CONSUMERS = {'nmpc': 'NMPC and allocation', 'training': 'training', 'plant': 'simulated plant',
             'estimator': 'estimator', 'buses': 'delays of the buses', 'gap': 'gap finder'}
_CORRECTED = 'the estimator corrects the readings first'
_NO_MODEL = 'the filter integrates the IMU and has no model of forces or servos'
# Consumer -> kind of effect -> why it ignores effects of this kind.
_IGNORED = {
    'nmpc': {'sensor': _CORRECTED,
             'play': 'a play is an offset of the servos, which is estimated in flight'},
    'training': {'sensor': _CORRECTED},
    'estimator': {**dict.fromkeys(('body', 'servo', 'number', 'command', 'play'), _NO_MODEL),
                  'feedback': NO_JOINTS},
    'buses': dict.fromkeys(('body', 'servo', 'number', 'sensor', 'feedback', 'play'),
                           'the effect delays no command')}


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


def wind_velocity(terms, velocity):
    terms.velocity = terms.velocity - vector(velocity)


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


def tilt_thrust_loss(terms, loss_at_60deg):
    sine = ca.sin(terms.tilt)
    terms.thrust = terms.thrust * (1 - loss_at_60deg * (sine * sine / 0.75))


def ground_effect(terms, **values):
    if terms.position is None:
        return
    scale = []
    for i in range(4):
        height = ca.fmax(terms.position[2] + (terms.rotation @ terms.rotor_positions[i])[2],
                         LEAST_HEIGHT)
        upright = (terms.rotation @ terms.thrust_directions[i])[2]
        ratio = REFERENCE_HEIGHT / height
        scale.append(1 + values['gain_at_0.25m'] * ratio * ratio * upright * upright)
    terms.thrust = terms.thrust * ca.vertcat(*scale)


def propeller_gyroscopic_torque(terms, angular_momentum_at_hover):
    speeds = terms.rotor_speeds()
    for i in range(4):
        momentum = angular_momentum_at_hover * terms.spin[i] * speeds[i]
        turning = terms.angular_velocity + terms.tilt_rate[i] * terms.tilt_axes[i]
        terms.torque = terms.torque - momentum * ca.cross(turning, terms.thrust_directions[i])
    rotor_acceleration_torque(terms, angular_momentum_at_hover)


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


def _delay(**more):
    return {'delay': EffectParameter('s', 0.0, -0.05, 0.2, **more)}


def _number(key, unit, low, high, **more):
    return EffectParameter(unit, NAN, low, high, number=key, **more)


# In order of application: the true tilt first, because it changes the thrust directions.
CATALOGUE: dict[str, Effect] = {
    'joint_offset': Effect(
        'joint', {'offset': EffectParameter('rad', (0.0,) * 4, -0.5, 0.5)},
        'true tilt = encoder + offset', joint_offset, each='joint'),
    'mass': Effect(
        'body', {'mass': _number('mass', 'kg', 0.005, 200)}, "m v' = F; total mass",
        sets('mass'), allocated=True),
    'inertia': Effect(
        'body', {'inertia': EffectParameter('kg m^2', (NAN,) * 3, 1e-6, 50, number='inertia')},
        "I w' = tau - w x I w, Euler", sets('inertia')),
    'centre_of_mass': Effect(
        'body', {'offset': EffectParameter('m', (0.0,) * 3, -0.2, 0.2)},
        'forces turn the body about its centre of mass, which is displaced from base_link',
        centre_of_mass),
    'module_reaction': Effect(
        'body', {'module_inertia': EffectParameter('kg m^2', 0.0, 0.0, 0.1),
                 'mass_moment': EffectParameter('kg m', 0.0, 0.0, 1.0, default=0.0)},
        "servo torque J q'' on the body; centre of mass moved by -moment / m (t(q) - t(0)), "
        "reaction force moment (n'' + 2 w x n'); multibody section of the robot file",
        module_reaction, ignored_by={
            'plant': 'its modules are bodies with the masses of the multibody section; '
                     'without that section it acts'}),
    'thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', 1.0, 0.2, 2.0)}, 'f = scale f*, all rotors',
        thrust_coefficient, allocated=True),
    'rotor_thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', (1.0,) * 4, 0.0, 2.0)},
        'f_i = scale_i f*_i: damaged propeller or other speed controller', thrust_coefficient,
        each='rotor', allocated=True),
    'torque_coefficient': Effect(
        'body', {'torque_to_thrust_ratio': _number(
            'rotors.torque_to_thrust_ratio', 'm', 0.0, 0.2)},
        'tau_i = -spin_i ratio f_i about the thrust axis', sets('torque_ratio'), allocated=True),
    'ground_effect': Effect(
        'body', {'gain_at_0.25m': EffectParameter('1', 0.0, 0.0, 1.0)},
        'f_i (1 + g (0.25 m / h)^2 n_z^2) after Cheeseman and Bennett 1955; h: rotor above the '
        'floor', ground_effect),
    'wind_velocity': Effect(
        'body', {'velocity': EffectParameter('m/s', (0.0,) * 3, -50, 50)},
        'drag, inflow and lift by the velocity v - w against air that moves by w in world '
        '(Mahony et al. 2012)', wind_velocity, beside=(
            'rotor_drag', 'rotor_hub_moment', 'body_drag', 'axial_inflow', 'translational_lift',
            'formula')),
    'rotor_drag': Effect(
        'body', {'coefficient': EffectParameter('N s/m', 0.0, 0.0, 5.0)},
        'H-force of Faessler et al. 2018, in the rotor plane, grows with rotor speed '
        'sqrt(f / f_h)', rotor_drag),
    'rotor_hub_moment': Effect(
        'body', {'coefficient': EffectParameter('N s', 0.0, -5.0, 5.0)},
        '-k n x v of stiff blades: the disc tilts back and turns the hub, grows with rotor speed '
        'sqrt(f / f_h) (Mahony et al. 2012; Leishman 2006, ch. 4); k of all rotors',
        rotor_hub_moment),
    'body_drag': Effect(
        'body', {'coefficient': EffectParameter('N s^2/m^2', 0.0, 0.0, 5.0)}, 'F = -c |v| v',
        body_drag),
    'axial_inflow': Effect(
        'body', {'per_rotor': EffectParameter('N s/m', 0.0, 0.0, 5.0)},
        'f_i - k sqrt(f_i / f_h) v.n: momentum theory, linear part (Leishman 2006, ch. 2)',
        axial_inflow),
    'translational_lift': Effect(
        'body', {'per_rotor': EffectParameter('N s^2/m^2', 0.0, 0.0, 1.0)},
        'f_i + k |v_in_plane|^2: induced velocity falls with the flow through the disc '
        '(Leishman 2006, ch. 2)', translational_lift),
    'tilt_thrust_loss': Effect(
        'body', {'loss_at_60deg': EffectParameter('1', 0.0, 0.0, 0.9)},
        'f_i (1 - L sin^2 q / 0.75): arm and body in the wake',
        tilt_thrust_loss),
    'wind': Effect(
        'body', {'force': EffectParameter('N', (0.0,) * 3, -100, 100)},
        'constant force in world', wind, allocated=True),
    'propeller_gyroscopic_torque': Effect(
        'body', {'angular_momentum_at_hover': EffectParameter('N m s', 0.0, 0.0, 1.0)},
        "-(w + q' e) x h s n - h' s n with h ~ sqrt(f): the propellers' angular momentum",
        propeller_gyroscopic_torque),
    'rotor_acceleration_torque': Effect(
        'body', {'angular_momentum_at_hover': EffectParameter('N m s', 0.0, 0.0, 1.0)},
        "-h' s n with h ~ sqrt(f): a change of rotor speed turns the body",
        rotor_acceleration_torque),
    'voltage_sag': Effect(
        'rotor', {'exponent': EffectParameter('1', 0.0, -1.0, 5.0)},
        'f = f* (V / V_full)^k: thrust of a thrust map without voltage; 6.9 %/V on this '
        "robot's map", voltage_sag, measured=('voltage_ratio',)),
    'formula': Effect(
        'body', {'expressions': EffectParameter('', ('force: velocity',), 0, 0, form=True,
                                                text=True),
                 'coefficients': EffectParameter('SI', (0.0,), -1e6, 1e6)},
        'sum of terms k a b c, which a file lists: gap --learn writes one', formula.apply,
        each='term'),
    'rotor_lag': Effect(
        'rotor', {'time_constant': _number('rotors.time_constant', 's', 0.001, 2.0)},
        "T f' + f = f*"),
    'rotor_dead_time': Effect(
        'rotor', _delay(), 'f*(t - d): delay of speed controllers and PWM', delays=('thrust',)),
    'thrust_saturation': Effect(
        'rotor', {'thrust_max': _number('rotors.thrust_max', 'N', 0.01, 200)},
        'f = min(f*, f_max): voltage or speed controller limit'),
    'command_latency': Effect(
        'timing', _delay(), 'all commands act d later', delays=('tilt', 'thrust')),
    'joint_command_latency': Effect('joint', _delay(), 'q*(t - d)', delays=('tilt',)),
    'joint_bandwidth': Effect(
        'joint', {name: _number(f'joints.{name}', unit, low, high, of_each=True)
                  for name, unit, low, high in (
            ('kp', 'N m/rad', 1e-4, 1e3), ('kd', 'N m s/rad', 0.0, 1e2))},
        "J q'' = Kp (q* - q) - Kd q'"),
    'joint_velocity_limit': Effect(
        'joint', {'velocity_limit': _number('joints.velocity_limit', 'rad/s', 0.1, 100)},
        "|q'| <= limit: voltage and gearing"),
    'joint_torque_limit': Effect(
        'joint', {'effort_limit': _number('joints.effort_limit', 'N m', 0.001, 100)},
        '|tau| <= limit: current limit, stall'),
    'joint_friction': Effect(
        'joint', dict.fromkeys(('coulomb', 'stiction'), EffectParameter(
            'N m', 0.0, 0.0, 1.0, of_each=True)),
        "-coulomb sgn(q') while sliding, up to stiction at rest (Armstrong-Helouvry 1994); "
        'smooth over 0.05 rad/s in the model', servo=joint_friction),
    'joint_backlash': Effect(
        'joint', {'gap': EffectParameter('rad', 0.0, 0.0, 0.3, of_each=True),
                  'at_encoder': EffectParameter('1', 0.0, 0.0, 1.0, default=0.0, form=True)},
        'play of width gap between motor and rotor; the encoder is on the side of the motor, with '
        'at_encoder 1 on that of the rotor'),
    'joint_deflection': Effect(
        'joint', {'deflection_per_newton': EffectParameter('rad/N', 0.0, -0.05, 0.05)},
        'thrust off the axis deflects the servo from its target: q* + c f',
        servo=joint_deflection),
    'joint_encoder_error': Effect(
        'joint', {name: EffectParameter(unit, (0.0,) * 4, -0.3, 0.3, default=(0.0,) * 4,
                                        sensor=f'encoder_{name}')
                  for name, unit in (('gain', '1'), ('sine', 'rad'), ('cosine', 'rad'))},
        "encoder = q + gain q + sine sin q + cosine (cos q - 1): an axis off the encoder's",
        each='joint', ignored_by={
            'estimator': NO_JOINTS, 'gap': 'a flight does not separate it from joint_offset: fit '
                                           'it to a response log'}),
    'joint_feedback_delay': Effect(
        'timing', _delay(sensor='encoder_delay'),
        'the encoder reading is older than its stamp by d', delays=('encoders',)),
    'mocap_time_offset': Effect(
        'timing', _delay(sensor='mocap_delay'), 'the pose is older than its stamp by d',
        delays=('mocap',)),
    'imu_filter_lag': Effect(
        'timing', _delay(sensor='imu_delay'),
        'specific force and rates are older than their stamp by d: filters of the IMU',
        delays=('imu',)),
    'imu_accelerometer_bias': Effect(
        'sensor', {'bias': EffectParameter('m/s^2', (0.0,) * 3, -5, 5,
                                           sensor='accelerometer_bias')}, 'a_measured = a + b'),
    'imu_gyroscope_bias': Effect(
        'sensor', {'bias': EffectParameter('rad/s', (0.0,) * 3, -1, 1, sensor='gyroscope_bias')},
        'w_measured = w + b'),
    'imu_misalignment': Effect(
        'sensor', {'rotation': EffectParameter('rad', (0.0,) * 3, -0.5, 0.5,
                                               sensor='imu_rotation')},
        'IMU axes rotated by exp(rotation) against base_link'),
    'imu_lever_arm': Effect(
        'sensor', {'offset': EffectParameter('m', (0.0,) * 3, -0.5, 0.5, sensor='imu_position')},
        "a + w' x l + w x (w x l)"),
    'mocap_misalignment': Effect(
        'sensor', {'rotation': EffectParameter('rad', (0.0,) * 3, -0.5, 0.5,
                                               sensor='mocap_rotation')},
        'marker axes rotated by exp(rotation) against base_link'),
}


def settings(effects: dict[str, dict]) -> dict[str, float]:
    """Dotted keys of the robot file that validated effects replace, with the new values."""
    return {key: effects[name][parameter] for name in effects
            for parameter, key in CATALOGUE[name].settings.items()}


def delaying(*what: str) -> tuple[str, ...]:
    """Names of the effects that delay any of ``what``; see :attr:`Effect.delays`."""
    return tuple(name for name, entry in CATALOGUE.items() if set(what) & set(entry.delays))


def validated(effects: dict) -> dict[str, dict]:
    """Complete and validate the parameters of effects: name -> parameter -> float or tuple."""
    checked: dict[str, dict] = {}
    for name, given in effects.items():
        if name not in CATALOGUE:
            raise unknown(f'effects.{name}', 'effect', name, CATALOGUE)
        entry = CATALOGUE[name]
        needed = {key for key, spec in entry.parameters.items() if spec.default is None}
        if not isinstance(given, dict) or not needed <= set(given) <= set(entry.parameters):
            expected = ', '.join(entry.parameters)
            raise ParameterError(f'effects.{name}: expected the keys {expected}, '
                                 f'found {quoted(given)}')
        checked[name] = {key: _value(f'effects.{name}.{key}', spec, given.get(key, spec.default))
                         for key, spec in entry.parameters.items()}
        if entry.beside and not set(entry.beside) & set(effects):
            raise ParameterError(f'effects.{name}: expected one of the effects '
                                 f"{', '.join(entry.beside)} beside it, by which it acts")
        if entry.each == 'term' and len({len(value) for value in checked[name].values()}) > 1:
            raise ParameterError(f'effects.{name}: expected one coefficient for each expression')
    return checked


def _value(at, spec, value):
    if spec.text:
        if not isinstance(value, (list, tuple)) or not value:
            raise ParameterError(f'{at}: expected a list of expressions, found {quoted(value)}')
        for term in value:
            formula.parsed(term)
        return tuple(value)
    array, shape = numbers(value, at, vars(spec)), np.shape(spec.neutral)
    if shape == (1,) and array.ndim == 1:     # of each term
        shape = array.shape
    if spec.of_each and array.shape == (4,):
        shape = array.shape
    if array.shape != shape:
        each = ' or (4,)' if spec.of_each else ''
        raise ParameterError(f'{at}: expected shape {shape}{each}, found {array.shape}')
    return tuple(map(float, array)) if shape else float(array)


def ignored(consumer: str, name: str) -> str:
    """
    Why a consumer of ``CONSUMERS`` ignores an effect; '' if the effect acts in it.

    This follows from the kind of effect, so that each new entry has a treatment.
    ``test/gap/test_consumers.py`` checks every pair against the consumer's results.
    """
    effect = CATALOGUE[name]
    if consumer in ('nmpc', 'training'):
        lacking = [MEASURED[term] for term in effect.measured] + [NO_STATE] * bool(effect.rate)
        if lacking:
            return '; '.join(lacking)
    return effect.ignored_by.get(consumer) or _IGNORED.get(consumer, {}).get(effect.kind, '')
