"""
Formulas: forces and torques as sums of products of the motion, each term with one coefficient.

A term is text, ``TARGET: FACTOR * FACTOR``, so that a formula is data in a file. Each target
admits the vectors that symmetry allows. A force is a polar vector, a torque an axial one, and the
spin of a rotor changes sign in a mirror. Terms of rotors are summed over the four rotors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement, product

import casadi as ca
import numpy as np

from beetle_omni_ros.model.schema import ParameterError, quoted
from beetle_omni_ros.model.terms import Terms

SHARE = 0.02            # of weight, and of weight times arm: typical force and torque of a term
LEAST_HEIGHT, NEAR = 0.08, 0.25     # [m] smallest height of a rotor; height at which ground is 1
SMALL = 1e-9            # keeps the slopes of lengths finite at rest
AXES = [ca.DM([1, 0, 0]), ca.DM([0, 1, 0]), ca.DM([0, 0, 1])]


@dataclass(frozen=True)
class Factor:
    """
    A scalar or vector (3,) in base_link of the motion.

    Attributes:
        unit: powers of N, m and s.
        size: usual size in flight, in SI units, of N: of weight, of N m: of weight times arm.
        of: (quantities, rotor) -> value; the rotor is 0 to 3.
        symbol: in a formula.
        words: meaning.

    """

    unit: tuple[int, int, int]
    size: float
    of: Callable
    symbol: str
    words: str


class Quantities:
    """What factors are made of, from the terms of the body's equations."""

    def __init__(self, terms: Terms):
        self.terms, turn = terms, terms.rotation.T
        self.speeds, self.hubs = terms.rotor_speeds(), terms.hub_velocities()
        self.in_plane, self.velocity = terms.in_plane_velocities(), turn @ terms.velocity
        self.position = None if terms.position is None else turn @ terms.position
        self.world = [turn @ axis for axis in AXES]
        forces = [terms.thrust[i] * terms.thrust_directions[i] for i in range(4)]
        self.force = sum(forces)
        self.torque = sum(
            ca.cross(terms.rotor_positions[i], forces[i])
            - terms.spin[i] * terms.torque_ratio * forces[i] for i in range(4))

    def ground(self, i):
        """(0.25 m / height of the rotor)^2."""
        place = self.position + self.terms.rotor_positions[i]
        return (NEAR / ca.fmax(ca.dot(self.world[2], place), LEAST_HEIGHT))**2


def length(vector):
    """Length of a vector (3,), with finite slopes."""
    return ca.sqrt(ca.sumsqr(vector) + SMALL)


ONE, SPEED, RATE, LENGTH, FORCE, TORQUE = (
    (0, 0, 0), (0, 1, -1), (0, 0, -1), (0, 1, 0), (1, 0, 0), (1, 1, 0))
SCALARS = {
    'speed': Factor(SPEED, 1.0, lambda q, i: length(q.velocity), '|v|', 'speed'),
    'climb': Factor(SPEED, 0.5, lambda q, i: q.terms.velocity[2], 'v_z', 'rate of climb'),
    'turn': Factor(RATE, 1.0, lambda q, i: length(q.terms.angular_velocity), '|w|',
                   'rate of turn'),
    'thrust': Factor(ONE, 1.0, lambda q, i: q.terms.thrust[i] / q.terms.hover_thrust, 'f/f_h',
                     'thrust over that in hover'),
    'rotor_speed': Factor(ONE, 1.0, lambda q, i: q.speeds[i], 's',
                          'rotor speed over that in hover'),
    'thrust_rate': Factor(RATE, 2.0, lambda q, i: q.terms.thrust_rate[i] / q.terms.hover_thrust,
                          "f'/f_h", 'rate of the thrust'),
    'spin_up': Factor(RATE, 1.0, lambda q, i: q.terms.thrust_rate[i] / (
        2 * q.terms.hover_thrust * ca.fmax(q.speeds[i], 0.1)), "s'", 'rate of the rotor speed'),
    'axial_speed': Factor(SPEED, 0.5, lambda q, i: ca.dot(
        q.terms.thrust_directions[i], q.hubs[i]), 'v_n', 'velocity of the hub along the thrust'),
    'in_plane_speed': Factor(SPEED, 1.0, lambda q, i: length(q.in_plane[i]), '|v_p|',
                             'speed of the hub in the plane of the rotor'),
    'tilt_rate': Factor(RATE, 2.0, lambda q, i: q.terms.tilt_rate[i], "q'", 'tilt rate'),
    'tilt_acceleration': Factor((0, 0, -2), 20.0, lambda q, i: q.terms.tilt_acceleration[i],
                                "q''", 'tilt acceleration'),
    'tilt_sine': Factor(ONE, 0.7, lambda q, i: ca.sin(q.terms.tilt[i]), 'sin q',
                        'sine of the tilt'),
    'upright': Factor(ONE, 0.7, lambda q, i: ca.dot(q.world[2], q.terms.thrust_directions[i]),
                      'n_z', 'share of the thrust direction that points up'),
    'ground': Factor(ONE, 0.1, lambda q, i: q.ground(i), '(h_0/h)^2',
                     'square of 0.25 m over the height'),
    'spin': Factor(ONE, 1.0, lambda q, i: q.terms.spin[i], 'e', 'sense of rotation'),
    **{f'rotor_{k + 1}': Factor(ONE, 0.25, lambda q, i, k=k: float(i == k), f'[rotor {k + 1}]',
                                f'rotor {k + 1} alone') for k in range(4)}}
VECTORS = {
    'velocity': Factor(SPEED, 1.0, lambda q, i: q.velocity, 'v', 'velocity'),
    'position': Factor(LENGTH, 1.0, lambda q, i: q.position, 'p', 'position in world'),
    'rate': Factor(RATE, 1.0, lambda q, i: q.terms.angular_velocity, 'w', 'angular velocity'),
    'rate_cross_velocity': Factor((0, 1, -2), 1.0, lambda q, i: ca.cross(
        q.terms.angular_velocity, q.velocity), 'w x v', 'angular velocity times velocity'),
    'z_cross_velocity': Factor(SPEED, 1.0, lambda q, i: ca.cross(AXES[2], q.velocity), 'z x v',
                               'vertical axis of the body times velocity'),
    'lean': Factor(ONE, 0.5, lambda q, i: ca.cross(AXES[2], q.world[2]), 'z x up',
                   'axis about which the body leans'),
    'total_force': Factor(FORCE, 1.0, lambda q, i: q.force, 'F', 'force of all rotors'),
    'in_plane_velocity': Factor(SPEED, 1.0, lambda q, i: q.in_plane[i], 'v_p',
                                'velocity of the hub in the plane of the rotor'),
    'cross_velocity': Factor(SPEED, 1.0, lambda q, i: ca.cross(
        q.terms.thrust_directions[i], q.hubs[i]), 'n x v', 'thrust direction times velocity'),
    'turning': Factor(RATE, 2.0, lambda q, i: ca.cross(
        q.terms.angular_velocity + q.terms.tilt_rate[i] * q.terms.tilt_axes[i],
        q.terms.thrust_directions[i]), "n'", 'change of the thrust direction'),
    'normal': Factor(ONE, 1.0, lambda q, i: q.terms.thrust_directions[i], 'n',
                     'thrust direction'),
    'arm': Factor(ONE, 1.0, lambda q, i: q.terms.tilt_axes[i], 'a', 'arm'),
    'side': Factor(ONE, 1.0, lambda q, i: ca.cross(
        q.terms.tilt_axes[i], q.terms.thrust_directions[i]), 'a x n',
                   'arm times thrust direction')}
for _k, _axis in enumerate('xyz'):
    VECTORS |= {
        _axis: Factor(ONE, 1.0, lambda q, i, k=_k: AXES[k], _axis, f'{_axis} of the body'),
        f'world_{_axis}': Factor(ONE, 1.0, lambda q, i, k=_k: q.world[k], _axis.upper(),
                                 f'{_axis} of the world'),
        f'velocity_{_axis}': Factor(
            SPEED, 0.7, lambda q, i, k=_k: AXES[k] * q.velocity[k], f'v_{_axis} {_axis}',
            f'velocity along {_axis} of the body'),
        f'rate_{_axis}': Factor(
            RATE, 0.7, lambda q, i, k=_k: AXES[k] * q.terms.angular_velocity[k],
            f'w_{_axis} {_axis}', f'rate about {_axis}'),
        f'torque_{_axis}': Factor(
            TORQUE, 0.03, lambda q, i, k=_k: AXES[k] * q.torque[k], f'T_{_axis} {_axis}',
            f'torque of all rotors about {_axis}'),
        f'{_axis}_cross_force': Factor(
            FORCE, 0.7, lambda q, i, k=_k: ca.cross(AXES[k], q.force), f'{_axis} x F',
            f'force of all rotors at a lever along {_axis}')}
BODY = 'x', 'y', 'z'
# Target -> words, vectors that it admits (none: a scalar), whether it is summed over the rotors.
TARGETS: dict[str, tuple[str, tuple[str, ...], bool]] = {
    'force': ('a force along', (
        'velocity', *(f'velocity_{a}' for a in BODY), 'rate_cross_velocity', 'position',
        *(f'world_{a}' for a in BODY), *BODY, 'total_force'), False),
    'torque': ('a torque along', (
        'rate', *(f'rate_{a}' for a in BODY), 'z_cross_velocity', 'lean', *BODY,
        *(f'torque_{a}' for a in BODY), *(f'{a}_cross_force' for a in BODY)), False),
    'rotor_force': ('a force at each rotor along', (
        'in_plane_velocity', 'cross_velocity', 'arm', 'side'), True),
    'rotor_torque': ('a torque at each rotor along', (
        'normal', 'cross_velocity', 'in_plane_velocity', 'turning', 'arm', 'side'), True),
    'thrust': ('a change of the thrust of each rotor by', (), True)}
OF_ROTORS = tuple(SCALARS)[3:]
OF_HEIGHT = 'ground', 'position'
OF_TILT = 'tilt_rate', 'tilt_acceleration', 'tilt_sine', 'turning', 'arm', 'side', 'normal'


@cache
def parsed(term: str) -> tuple[str, tuple[str, ...]]:
    """
    Target and factors of a term; the vector is the first factor.

    Raises:
        ParameterError: it is no term; the message states what is expected.

    """
    target, _, rest = str(term).partition(':')
    factors = tuple(part.strip() for part in rest.split('*'))
    if target not in TARGETS:
        raise ParameterError(f'term {quoted(term)}: expected TARGET: FACTOR * FACTOR with one of '
                             f'the targets {", ".join(TARGETS)}')
    _, vectors, rotors = TARGETS[target]
    scalars = SCALARS if rotors else tuple(SCALARS)[:3]
    head, more = (factors[:1], factors[1:]) if vectors else ((), factors)
    for part, known in (*((part, vectors) for part in head), *((part, scalars) for part in more)):
        if part not in known:
            raise ParameterError(f'term {quoted(term)}: factor {quoted(part)}: expected one of '
                                 f'{", ".join(known)}')
    return target, factors


def _factors(term):
    target, names = parsed(term)
    return target, [VECTORS[name] if TARGETS[target][1] and not k else SCALARS[name]
                    for k, name in enumerate(names)]


def unit_of(term: str) -> str:
    """Unit of the coefficient of a term."""
    target, factors = _factors(term)
    powers = np.array([1, 'torque' in target, 0]) - np.sum([f.unit for f in factors], axis=0)
    over, under = ([f'{name}^{abs(p)}' if abs(p) > 1 else name
                    for name, p in zip(('N', 'm', 's'), powers, strict=True) if p * sign > 0]
                   for sign in (1, -1))
    return (' '.join(over) or '1') + (f"/{'/'.join(under)}" if under else '')


def size_of(term: str, weight: float, arm: float) -> float:
    """Typical coefficient of a term on a robot of this weight [N] and arm [m]."""
    target, factors = _factors(term)
    size = float(np.prod([f.size * weight**f.unit[0] * (arm if f.unit == TORQUE else 1.0)
                          for f in factors]))
    return SHARE * weight * (arm if 'torque' in target else 1.0) / size / (
        4 if TARGETS[target][2] else 1)


def words_of(term: str) -> str:
    """A term in words."""
    target, factors = _factors(term)
    return f'{TARGETS[target][0]} ' + ', times '.join(f.words for f in factors)


def symbols_of(term: str) -> str:
    """A term in symbols, with the coefficient k."""
    target, factors = _factors(term)
    left = {'force': 'F', 'torque': 'T', 'rotor_force': 'F_i', 'rotor_torque': 'T_i',
            'thrust': 'f_i'}[target]
    return f'{left} += k {" ".join(f.symbol for f in factors)}'


def apply(terms: Terms, expressions: tuple[str, ...], coefficients: tuple) -> None:
    """Add a formula to the terms of the body's equations; without position, less its terms."""
    q, thrust = Quantities(terms), [0] * 4
    for law, coefficient in zip(expressions, coefficients, strict=True):
        target, factors = _factors(law)
        if terms.position is None and set(OF_HEIGHT) & set(parsed(law)[1]):
            continue
        for i in range(4 if TARGETS[target][2] else 1):
            value = coefficient
            for factor in factors[::-1]:
                value = value * factor.of(q, i)
            if target == 'force':
                terms.force_world = terms.force_world + terms.rotation @ value
            elif target == 'rotor_force':
                terms.rotor_forces[i] = terms.rotor_forces[i] + value
            elif target == 'thrust':
                thrust[i] = thrust[i] + value
            else:
                terms.torque = terms.torque + value
    terms.thrust = terms.thrust + ca.vertcat(*thrust)


@cache
def library(torques: bool = True, tilting: bool = True) -> tuple[str, ...]:
    """
    Terms of at most three factors among which a formula is searched.

    Args:
        torques: whether torques are measured; without, there are no terms that only turn.
        tilting: whether the rotors tilt.

    """
    made = [f'force: {v}{s}' for v, s in product(
        TARGETS['force'][1], ('', ' * speed', ' * climb', ' * turn'))]
    made += [f'torque: {v}{s}' for v, s in product(
        TARGETS['torque'][1], ('', ' * speed', ' * turn'))]
    scales = ('', ' * rotor_speed', ' * thrust')
    made += [f'rotor_force: {v}{s}{m}' for v, s, m in product(
        ('in_plane_velocity',), scales, ('', ' * in_plane_speed', ' * axial_speed', ' * ground'))]
    made += [f'rotor_force: cross_velocity * spin{s}' for s in scales]
    made += [f'rotor_force: side * {s}' for s in (
        'axial_speed', 'thrust * tilt_rate', 'tilt_acceleration', 'thrust * tilt_sine',
        *(f'thrust * rotor_{k + 1}' for k in range(4)))]
    made += [f'rotor_force: arm * {s}' for s in ('thrust', 'thrust * spin', 'thrust * tilt_sine')]
    made += [f'rotor_torque: {v}{s}' for v, s in product(
        ('cross_velocity', 'in_plane_velocity * spin', 'turning * spin', 'normal * spin',
         'turning', 'arm * spin'), scales)]
    made += [f'rotor_torque: {v}' for v in (
        'normal * spin * spin_up', 'normal * spin * in_plane_speed', 'arm * tilt_acceleration',
        'arm * tilt_rate', 'arm * tilt_rate * thrust', 'arm * tilt_sine * thrust')]
    plain = ('thrust', 'rotor_speed', 'thrust_rate', 'axial_speed', 'in_plane_speed', 'tilt_rate',
             'tilt_sine', 'upright', 'ground')
    made += [f'thrust: {a}' for a in (*plain, *(f'thrust * rotor_{k + 1}' for k in range(4)))]
    made += [f'thrust: {a} * {b}' for a, b in combinations_with_replacement(plain, 2)]
    made += [f'thrust: thrust * {a} * {b}' for a, b in combinations_with_replacement(
        ('axial_speed', 'in_plane_speed', 'tilt_sine', 'upright', 'ground'), 2)]
    return tuple(term for term in made
                 if (torques or parsed(term)[0] not in ('torque', 'rotor_torque'))
                 and (tilting or not set(OF_TILT) & set(parsed(term)[1])))
