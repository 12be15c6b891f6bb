"""
The catalogue of named effects: what reality may add to the model.

Each effect is declared once: its parameters with unit, neutral value (at which the
effect vanishes) and physical range, and, for those of the body layer, the equation
that the CasADi dynamics use. A robot file switches an effect on by naming it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches

import casadi as ca
import numpy as np

from beetle_omni_ros.robot.schema import ParameterError

_UP = ca.DM([0, 0, 1])


@dataclass(frozen=True)
class EffectParameter:
    """One number, or vector, of an effect: unit, value of no effect, legal range."""

    unit: str
    neutral: float | tuple[float, ...]
    low: float
    high: float


@dataclass
class Terms:
    """
    The forces of one instant while they are put together, CasADi expressions throughout.

    Attributes:
        mass: [kg].
        inertia: (3,) diagonal about the centre of mass [kg m^2].
        centre_of_mass: (3,) seen from base_link's origin [m], or None where it is the origin.
        torque: (3,) torque added on the body, in base_link [N m].
        tilt: (4,) tilt angles [rad].
        tilt_acceleration: (4,) of the tilt joints [rad/s^2].
        tilt_axes: list of four (3,) unit vectors in base_link, outward along the arms.
        thrust: (4,) rotor thrusts after their lag [N].
        velocity: (3,) of the centre of gravity in world [m/s].
        angular_velocity: (3,) in base_link [rad/s].
        rotation: (3, 3) body to world.
        thrust_directions: list of four (3,) unit vectors in base_link.
        rotor_positions: list of four (3,) [m] in base_link.
        hover_thrust: of each rotor [N].
        force_world: (3,) force added in world [N].
        rotor_forces: list of four (3,) forces added at the rotors, in base_link [N].
        torque_ratio: reaction torque for each newton [m].

    """

    mass: ca.SX
    inertia: ca.SX
    centre_of_mass: ca.SX | None
    torque: ca.SX
    tilt: ca.SX
    tilt_acceleration: ca.SX
    tilt_axes: list
    thrust: ca.SX
    velocity: ca.SX
    angular_velocity: ca.SX
    rotation: ca.SX
    thrust_directions: list
    rotor_positions: list
    hover_thrust: float
    force_world: ca.SX
    rotor_forces: list
    torque_ratio: ca.SX


@dataclass(frozen=True)
class Effect:
    """
    One catalogue entry.

    Attributes:
        layer: 'body', 'rotor', 'joint', 'timing' or 'sensor'.
        parameters: name -> :class:`EffectParameter`.
        apply: changes :class:`Terms` in place; called as apply(terms, **values).
        source: where the equation comes from.

    """

    layer: str
    parameters: dict[str, EffectParameter]
    apply: Callable
    source: str


def _mass(terms, mass):
    terms.mass = mass


def _inertia(terms, inertia):
    terms.inertia = _vector(inertia)


def _centre_of_mass(terms, offset):
    terms.centre_of_mass = _moved(terms.centre_of_mass, _vector(offset))


def _module_reaction(terms, module_inertia, mass_moment):
    shift = 0
    for i in range(4):
        terms.torque = terms.torque - module_inertia * terms.tilt_acceleration[i] \
            * terms.tilt_axes[i]
        # The module's centre of mass hangs below the joint axis: it moves against the thrust.
        shift = shift - mass_moment / terms.mass * (terms.thrust_directions[i] - _UP)
    terms.centre_of_mass = _moved(terms.centre_of_mass, shift)


def _moved(centre, shift):
    return shift if centre is None else centre + shift


def _vector(values):
    return ca.vertcat(*ca.vertsplit(ca.SX(ca.vertcat(*values)))) if isinstance(values, tuple) \
        else values


def _thrust_coefficient(terms, scale):
    terms.thrust = scale * terms.thrust


def _rotor_thrust_coefficient(terms, scale):
    terms.thrust = ca.vertcat(*scale) * terms.thrust if isinstance(scale, tuple) \
        else scale * terms.thrust


def _torque_coefficient(terms, torque_to_thrust_ratio):
    terms.torque_ratio = torque_to_thrust_ratio


def _wind(terms, force):
    terms.force_world = terms.force_world + _vector(force)


def _body_drag(terms, coefficient):
    speed = ca.sqrt(ca.sumsqr(terms.velocity) + 1e-12)
    terms.force_world = terms.force_world - coefficient * speed * terms.velocity


def _rotor_drag(terms, coefficient):
    air_velocity = terms.rotation.T @ terms.velocity
    for i in range(4):
        n = terms.thrust_directions[i]
        v = air_velocity + ca.cross(terms.angular_velocity, terms.rotor_positions[i])
        in_plane = v - n * ca.dot(n, v)
        speed_ratio = ca.sqrt(ca.fmax(terms.thrust[i], 0) / terms.hover_thrust + 1e-9)
        terms.rotor_forces[i] = terms.rotor_forces[i] - coefficient / 4 * speed_ratio * in_plane


CATALOGUE: dict[str, Effect] = {
    'mass': Effect('body', {'mass': EffectParameter('kg', float('nan'), 0.05, 200)}, _mass,
                   "m v' = F"),
    'inertia': Effect(
        'body', {'inertia': EffectParameter('kg m^2', (float('nan'),) * 3, 1e-5, 50)}, _inertia,
        "I w' = tau - w x I w"),
    'centre_of_mass': Effect(
        'body', {'offset': EffectParameter('m', (0.0,) * 3, -0.2, 0.2)}, _centre_of_mass,
        'forces turn the body about its centre of mass, base_link moves with it'),
    'module_reaction': Effect(
        'body', {'module_inertia': EffectParameter('kg m^2', 0.0, 0.0, 0.1),
                 'mass_moment': EffectParameter('kg m', 0.0, 0.0, 1.0)}, _module_reaction,
        "servo torque J q'' on the body; centre of mass moved by -moment / m (t(q) - t(0))"),
    'thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', 1.0, 0.2, 2.0)}, _thrust_coefficient,
        'f = scale f*'),
    'rotor_thrust_coefficient': Effect(
        'body', {'scale': EffectParameter('1', (1.0,) * 4, 0.0, 2.0)}, _rotor_thrust_coefficient,
        'f_i = scale_i f*_i'),
    'torque_coefficient': Effect(
        'body', {'torque_to_thrust_ratio': EffectParameter('m', float('nan'), 0.0, 0.2)},
        _torque_coefficient, 'tau_i = -spin_i ratio f_i'),
    'wind': Effect('body', {'force': EffectParameter('N', (0.0,) * 3, -100, 100)}, _wind,
                   'constant force in world'),
    'body_drag': Effect('body', {'coefficient': EffectParameter('N s^2/m^2', 0.0, 0.0, 5.0)},
                        _body_drag, 'F = -c |v| v'),
    'rotor_drag': Effect('body', {'coefficient': EffectParameter('N s/m', 0.0, 0.0, 5.0)},
                         _rotor_drag,
                         'H-force of Faessler et al. 2018, grows with rotor speed sqrt(f / f_h)'),
}


def validated(effects: dict | None) -> dict[str, dict]:
    """
    Check a robot file's ``effects`` mapping against the catalogue.

    Returns:
        name -> parameter -> float or tuple of floats, parameters complete.

    Raises:
        ParameterError: unknown effect or parameter, wrong shape, value out of range.

    """
    checked: dict[str, dict] = {}
    for name, given in (effects or {}).items():
        if name not in CATALOGUE:
            near = get_close_matches(str(name), CATALOGUE, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(CATALOGUE)}"
            raise ParameterError(f'effects.{name}: unknown effect{hint}')
        entry = CATALOGUE[name]
        if not isinstance(given, dict) or set(given) != set(entry.parameters):
            expected = ', '.join(entry.parameters)
            raise ParameterError(f'effects.{name}: expected the keys {expected}, found {given!r}')
        checked[name] = {key: _value(f'effects.{name}.{key}', spec, given[key])
                         for key, spec in entry.parameters.items()}
    return checked


def _value(at, spec, value):
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f'{at}: expected numbers [{spec.unit}], found {value!r}') from None
    shape = np.shape(spec.neutral)
    if array.shape != shape:
        raise ParameterError(f'{at}: expected shape {shape}, found {array.shape}')
    if not np.all((array >= spec.low) & (array <= spec.high)):
        raise ParameterError(f'{at}: {value} is outside {spec.low:g} to {spec.high:g} {spec.unit}')
    return tuple(map(float, array)) if shape else float(array)
