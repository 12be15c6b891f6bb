"""
Formulas: forces and torques as sums of products of the motion, each term with one coefficient.

A term is text, ``TARGET: FACTOR * FACTOR``, so that a formula is data in a file. Each target
admits the vectors that symmetry allows. Terms of rotors are summed over the four rotors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
import re

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
    """A scalar or vector (3,) in base_link of the motion."""

    unit: tuple[int, int, int]  # powers of N, m and s
    size: float         # usual in flight, in SI units; of N: of weight, of N m: of weight and arm
    symbol: str
    of: Callable        # (quantities, rotor 0 to 3) -> value


class Quantities:
    """What factors are made of, from the terms of the body's equations."""

    def __init__(self, terms: Terms):
        self.terms, turn = terms, terms.rotation.T
        self.thrust, self.normals = terms.thrust / terms.hover_thrust, terms.thrust_directions
        self.thrust_rate = terms.thrust_rate / terms.hover_thrust
        self.speeds, self.hubs = terms.rotor_speeds(), terms.hub_velocities()
        self.in_plane, self.velocity = terms.in_plane_velocities(), turn @ terms.velocity
        self.position = None if terms.position is None else turn @ terms.position
        self.rate, self.world = terms.angular_velocity, [turn @ axis for axis in AXES]
        forces = [terms.thrust[i] * self.normals[i] for i in range(4)]
        self.force = sum(forces)
        self.torque = sum(
            ca.cross(terms.rotor_positions[i], forces[i])
            - terms.spin[i] * terms.torque_ratio * forces[i] for i in range(4))


def length(vector):
    """Length of a vector (3,), with finite slopes."""
    return ca.sqrt(ca.sumsqr(vector) + SMALL)


ONE, SPEED, RATE, LENGTH, FORCE, TORQUE = (
    (0, 0, 0), (0, 1, -1), (0, 0, -1), (0, 1, 0), (1, 0, 0), (1, 1, 0))
# v: velocity of body or hub, f: thrust over that in hover, q: tilt, n: thrust direction, a: arm.
# The first two are of the body.
SCALARS = {
    'speed': Factor(SPEED, 1.0, '|v|', lambda q, i: length(q.velocity)),
    'turn': Factor(RATE, 1.0, '|w|', lambda q, i: length(q.rate)),
    'thrust': Factor(ONE, 1.0, 'f', lambda q, i: q.thrust[i]),
    'rotor_speed': Factor(ONE, 1.0, 'sqrt(f)', lambda q, i: q.speeds[i]),
    'thrust_rate': Factor(RATE, 2.0, "f'", lambda q, i: q.thrust_rate[i]),
    'spin_up': Factor(RATE, 1.0, "sqrt(f)'", lambda q, i: q.thrust_rate[i] / (
        2 * ca.fmax(q.speeds[i], 0.1))),
    'axial_speed': Factor(SPEED, 0.5, 'v_n', lambda q, i: ca.dot(q.normals[i], q.hubs[i])),
    'in_plane_speed': Factor(SPEED, 1.0, '|v_p|', lambda q, i: length(q.in_plane[i])),
    'tilt_rate': Factor(RATE, 2.0, "q'", lambda q, i: q.terms.tilt_rate[i]),
    'tilt_acceleration': Factor((0, 0, -2), 20.0, "q''",
                                lambda q, i: q.terms.tilt_acceleration[i]),
    'tilt_sine': Factor(ONE, 0.7, 'sin q', lambda q, i: ca.sin(q.terms.tilt[i])),
    'upright': Factor(ONE, 0.7, 'n_Z', lambda q, i: ca.dot(q.world[2], q.normals[i])),
    'ground': Factor(ONE, 0.1, '(0.25 m/h)^2', lambda q, i: (NEAR / ca.fmax(ca.dot(
        q.world[2], q.position + q.terms.rotor_positions[i]), LEAST_HEIGHT))**2),
    'voltage': Factor(ONE, 0.1, '(V/V_0 - 1)', lambda q, i: q.terms.voltage_ratio - 1),
    'spin': Factor(ONE, 1.0, 'spin', lambda q, i: q.terms.spin[i]),
    **{f'rotor_{k + 1}': Factor(ONE, 0.25, f'[rotor {k + 1}]', lambda q, i, k=k: float(i == k))
       for k in range(4)}}
VECTORS = {
    'velocity': Factor(SPEED, 1.0, 'v', lambda q, i: q.velocity),
    'position': Factor(LENGTH, 1.0, 'p', lambda q, i: q.position),
    'rate': Factor(RATE, 1.0, 'w', lambda q, i: q.rate),
    'rate_cross_velocity': Factor((0, 1, -2), 1.0, 'w x v',
                                  lambda q, i: ca.cross(q.rate, q.velocity)),
    'z_cross_velocity': Factor(SPEED, 1.0, 'z x v', lambda q, i: ca.cross(AXES[2], q.velocity)),
    'lean': Factor(ONE, 0.5, 'z x Z', lambda q, i: ca.cross(AXES[2], q.world[2])),
    'total_force': Factor(FORCE, 1.0, 'sum(f n)', lambda q, i: q.force),
    'in_plane_velocity': Factor(SPEED, 1.0, 'v_p', lambda q, i: q.in_plane[i]),
    'normal_cross_velocity': Factor(SPEED, 1.0, 'n x v',
                                    lambda q, i: ca.cross(q.normals[i], q.hubs[i])),
    'turning': Factor(RATE, 2.0, "n'", lambda q, i: ca.cross(
        q.rate + q.terms.tilt_rate[i] * q.terms.tilt_axes[i], q.normals[i])),
    'normal': Factor(ONE, 1.0, 'n', lambda q, i: q.normals[i]),
    'arm': Factor(ONE, 1.0, 'a', lambda q, i: q.terms.tilt_axes[i]),
    'side': Factor(ONE, 1.0, 'a x n', lambda q, i: ca.cross(q.terms.tilt_axes[i], q.normals[i]))}
for _k, _a in enumerate('xyz'):
    VECTORS |= {
        _a: Factor(ONE, 1.0, _a, lambda q, i, k=_k: AXES[k]),
        f'world_{_a}': Factor(ONE, 1.0, _a.upper(), lambda q, i, k=_k: q.world[k]),
        f'velocity_{_a}': Factor(SPEED, 0.7, f'v_{_a} {_a}',
                                 lambda q, i, k=_k: AXES[k] * q.velocity[k]),
        f'rate_{_a}': Factor(RATE, 0.7, f'w_{_a} {_a}', lambda q, i, k=_k: AXES[k] * q.rate[k]),
        f'torque_{_a}': Factor(TORQUE, 0.03, f'T_{_a} {_a}',
                               lambda q, i, k=_k: AXES[k] * q.torque[k]),
        f'{_a}_cross_force': Factor(FORCE, 0.7, f'{_a} x sum(f n)',
                                    lambda q, i, k=_k: ca.cross(AXES[k], q.force))}
FACTORS = VECTORS | SCALARS
# Target -> symbol, words, vectors that it admits (none: a scalar), whether of all rotors.
TARGETS: dict[str, tuple[str, str, tuple[str, ...], bool]] = {
    'force': ('F', 'force along', (
        'velocity', 'velocity_x', 'velocity_y', 'velocity_z', 'rate_cross_velocity', 'position',
        'world_x', 'world_y', 'world_z', 'x', 'y', 'z', 'total_force'), False),
    'torque': ('T', 'torque along', (
        'rate', 'rate_x', 'rate_y', 'rate_z', 'z_cross_velocity', 'lean', 'x', 'y', 'z',
        'torque_x', 'torque_y', 'torque_z', 'x_cross_force', 'y_cross_force',
        'z_cross_force'), False),
    'rotor_force': ('F_i', 'force at each rotor along', (
        'in_plane_velocity', 'normal_cross_velocity', 'arm', 'side'), True),
    'rotor_torque': ('T_i', 'torque at each rotor along', (
        'normal', 'normal_cross_velocity', 'in_plane_velocity', 'turning', 'arm', 'side'), True),
    'thrust': ('f_i', 'thrust of each rotor by', (), True)}
# Patterns of the terms that are searched; {a|b} is a choice.
LIBRARY = (
    'force: {velocity|velocity_x|velocity_y|velocity_z|position|total_force}{|speed}',
    'force: {world_x|world_y|world_z|x|y|z|rate_cross_velocity}',
    'torque: {rate|rate_x|rate_y|rate_z}{|turn}',
    'torque: {x|y|z|torque_x|torque_y|torque_z|x_cross_force|y_cross_force|z_cross_force}',
    'torque: {z_cross_velocity|lean}',
    'rotor_force: in_plane_velocity{|rotor_speed|thrust}',
    'rotor_force: in_plane_velocity * rotor_speed{in_plane_speed|axial_speed}',
    'rotor_force: {normal_cross_velocity * spin|arm * spin|arm}{rotor_speed|thrust}',
    'rotor_force: side{axial_speed|tilt_acceleration}',
    'rotor_force: side * thrust{tilt_rate|tilt_sine|rotor_1|rotor_2|rotor_3|rotor_4}',
    'rotor_torque: {normal_cross_velocity|turning}{|rotor_speed}',
    'rotor_torque: {in_plane_velocity|turning|normal|arm} * spin{rotor_speed|thrust}',
    'rotor_torque: {normal * spin * spin_up|arm * tilt_acceleration|arm * tilt_rate}',
    'rotor_torque: arm * thrust{tilt_rate|tilt_sine}',
    'thrust: {thrust|rotor_speed|thrust_rate|axial_speed|in_plane_speed|tilt_rate}',
    'thrust: {axial_speed * axial_speed|in_plane_speed * in_plane_speed}',
    'thrust: {rotor_speed|thrust}{axial_speed|in_plane_speed|tilt_rate|tilt_sine|upright|ground}',
    'thrust: thrust * voltage',
    'thrust: thrust{tilt_sine * tilt_sine|upright * upright|ground * upright|ground * ground}',
    'thrust: thrust{in_plane_speed * in_plane_speed|rotor_1|rotor_2|rotor_3|rotor_4}')
# Factor of a quantity of the terms that may be unknown -> that quantity.
MEASURED = {'ground': 'position', 'position': 'position', 'voltage': 'voltage_ratio'}
OF_ONE = 'rotor_1', 'rotor_2', 'rotor_3', 'rotor_4'
OF_TILT = 'tilt_rate', 'tilt_acceleration', 'tilt_sine', 'turning', 'arm', 'side', 'normal'


@cache
def parsed(term: str) -> tuple[str, list[str], list[Factor]]:
    """Target, names of the factors, and these, the vector first; or a ParameterError."""
    target, _, rest = str(term).partition(':')
    names = [part.strip() for part in rest.split('*')]
    if target not in TARGETS:
        raise ParameterError(f'term {quoted(term)}: expected TARGET: FACTOR * FACTOR with one of '
                             f'the targets {", ".join(TARGETS)}')
    _, _, vectors, rotors = TARGETS[target]
    for k, name in enumerate(names):
        known = vectors if vectors and not k else list(SCALARS)[:None if rotors else 2]
        if name not in known:
            raise ParameterError(f'term {quoted(term)}: factor {quoted(name)}: expected one of '
                                 f'{", ".join(known)}')
    return target, names, [FACTORS[name] for name in names]


def described(term: str) -> tuple[str, str, str]:
    """Unit of the coefficient k of a term, the term in words, and in symbols."""
    target, names, factors = parsed(term)
    symbol, words, *_ = TARGETS[target]
    powers = np.array([1, 'torque' in target, 0]) - np.sum([f.unit for f in factors], axis=0)
    over, under = ([f'{name}^{abs(p)}' if abs(p) > 1 else name
                    for name, p in zip(('N', 'm', 's'), powers, strict=True) if p * sign > 0]
                   for sign in (1, -1))
    return ((' '.join(over) or '1') + (f"/{'/'.join(under)}" if under else ''),
            f'{words} {", times ".join(names)}'.replace('_', ' '),
            f'{symbol} += k {" ".join(f.symbol for f in factors)}')


def size_of(term: str, weight: float, arm: float) -> float:
    """Typical coefficient of a term on a robot of this weight [N] and arm [m]."""
    target, _, factors = parsed(term)
    size = float(np.prod([f.size * weight**f.unit[0] * (arm if f.unit == TORQUE else 1.0)
                          for f in factors]))
    return SHARE * weight * (arm if 'torque' in target else 1.0) / size / (
        4 if TARGETS[target][3] else 1)


def apply(terms: Terms, expressions: tuple[str, ...], coefficients: tuple) -> None:
    """Add a formula to the terms of the body's equations, but for those of unknown quantities."""
    q, thrust = Quantities(terms), [0] * 4
    for law, coefficient in zip(expressions, coefficients, strict=True):
        target, names, factors = parsed(law)
        if any(getattr(terms, MEASURED[name]) is None for name in names if name in MEASURED):
            continue
        for i in range(4 if TARGETS[target][3] else 1):
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


def library(torques: bool = True, tilting: bool = True) -> tuple[str, ...]:
    """Terms that are searched; of single rotors and torques if ``torques`` are measured."""
    choices = ([part.split('|') for part in re.split('[{}]', pattern)] for pattern in LIBRARY)
    made = [' * '.join(filter(None, (part.strip(' *') for part in parts))).replace(': * ', ': ')
            for each in choices for parts in product(*each)]
    return tuple(term for term in made
                 if (torques or 'torque' not in parsed(term)[0]
                     and not set(OF_ONE) & set(parsed(term)[1]))
                 and (tilting or not set(OF_TILT) & set(parsed(term)[1])))
