"""
Fitted scalars: parameters of the catalogue, tolerances of the robot, delays of the bus.

A fit works with deviations from the robot file: differences, or logarithms of ratios for masses,
gains and the like. Mass, inertia and thrust scaled by one factor do not change the motion, and
in logarithms this direction is a straight line. A key is 'effect.parameter' or
'effect.parameter[index]'.

A key always has a narrow prior about the robot file: its tolerance, or half of the smallest
relevant deviation. A candidate adds its typical deviation. Each flight deviates from the common
value by what sensors and vehicles differ from flight to flight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from operator import attrgetter

import numpy as np

from beetle_omni_ros.identify.flights.treatment import Size, TREATMENTS
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.model.effects import CATALOGUE, delaying, ignored
from beetle_omni_ros.model.formula import size_of as size_of_term
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.terms import EffectParameter

MODULES = 'module_reaction'
NO_SIZE = Size(0.5, 0.0)     # of a parameter that only selects a form
# Parameter of a servo -> effect that may also be of one joint, with keys 'servo.PARAMETER[k]'.
OF_ONE = {parameter: name for name, treatment in TREATMENTS.items() for parameter in
          treatment.sizes if CATALOGUE[name].parameters[parameter].of_each}
# Effects without a slope at their neutral value; they need a start where they act.
LIMITS = tuple(name for name, treatment in TREATMENTS.items() if treatment.starts)
DROOP = 'droop.ratio'        # logarithm of the gradient of the servos' speed limit
SWING = 'swing.ratio'        # logarithm of the apparent inertia of the servos
TILT_BUS, THRUST_BUS = 'base.tilt_delay', 'base.thrust_delay'   # delays of commands
# Typical and smallest deviations of the catalogue are those of a robot of this size.
WEIGHT, ARM = 29.8, 0.2754      # [N], [m] params/robot.yaml
# Power of weight and of arm by which a deviation of a unit grows with the size of a robot.
SIZE = {'N': (1, 0), 'N s/m': (1, 0), 'N s^2/m^2': (1, 0), 'N m': (1, 1), 'N s': (1, 1),
        'N m s': (1, 1), 'm': (0, 1), 'kg m': (1, 1), 'kg m^2': (1, 2)}
# Standard deviations between the flights of one vehicle, by key.
FLIGHT = {'thrust_coefficient.scale': 0.017, 'rotor_thrust_coefficient.scale': 0.01,
          'imu_accelerometer_bias.bias': 0.05,
          'imu_gyroscope_bias.bias': 0.004, 'imu_misalignment.rotation': 0.002,
          'mocap_misalignment.rotation': 0.002, 'rotor_dead_time.delay': 0.002}
# Typical differences of sensors between the flights of a laboratory.
VARYING = {'mocap_time_offset.delay': 0.008, 'imu_filter_lag.delay': 0.008,
           'joint_feedback_delay.delay': 0.008, 'imu_accelerometer_bias.bias': 0.1,
           'imu_gyroscope_bias.bias': 0.008, 'imu_misalignment.rotation': 0.005,
           'mocap_misalignment.rotation': 0.005}
AIR = 0.3               # [m/s] moves up or down; its force is that of a typical drag
VERTICAL = 'wind.force[2]', 'wind_velocity.velocity[2]'
FLIGHT_OFFSET = 0.0033          # share of the arm: centre of mass, repeats of one vehicle


@dataclass(frozen=True)
class Key:
    """
    One scalar of a fit.

    Attributes:
        name: 'effect.parameter[index]'.
        effect: catalogue name.
        parameter: its name there.
        index: index in a vector, or None.
        base: value of the robot file.
        relative: whether a deviation is the logarithm of a ratio to ``base``.
        typical: typical deviation.
        smallest: smallest relevant deviation.
        groups: channel groups that depend on it.
        body: whether it is in the body equations, not in a signal.
        step: step of finite differences.
        form: whether it selects a form and is not fitted.
        ends_at_none: whether the smallest value means no effect, as of drag or friction.

    """

    name: str
    effect: str
    parameter: str
    index: int | None
    base: float
    relative: bool
    typical: float
    smallest: float
    groups: str
    body: bool = False
    step: float = 1e-3
    form: bool = False
    ends_at_none: bool = False

    def value(self, deviation: float) -> float:
        """Catalogue value of a deviation."""
        return self.base * math.exp(deviation) if self.relative else self.base + deviation


def of_start(start: str) -> tuple[str, int | None]:
    """Effect of a start, 'effect@k' or 'effect[joint]@k', and its joint if it is of one."""
    name, _, member = start.partition('@')[0].partition('[')
    return name, int(member[:-1]) if member else None


def number_of(robot: RobotParameters, key: str) -> float | np.ndarray:
    """Value of the robot file at a dotted key."""
    return attrgetter(key)(robot)


def base_of(spec: EffectParameter, value) -> np.ndarray:
    """
    Base values (n,) of the keys of a parameter.

    A flight fits the mean of the joints; differences between joints stay as in the file.
    """
    return np.atleast_1d(np.mean(value) if spec.of_each else np.array(value, dtype=float))


def names_of(effect: str, parameter: str) -> list[str]:
    """Key names of a parameter."""
    neutral, text = CATALOGUE[effect].parameters[parameter].neutral, f'{effect}.{parameter}'
    return [f'{text}[{k}]' for k in range(len(neutral))] if isinstance(neutral, tuple) else [text]


def delays_of(*what: str) -> tuple[str, ...]:
    """Key names of delays of any of ``what``; see :attr:`Effect.delays`."""
    return tuple(f'{name}.delay' for name in delaying(*what))


def friction(robot: RobotParameters) -> tuple[np.ndarray, np.ndarray]:
    """Coulomb friction and stiction of the file [N m], (4,) each; stiction is the larger one."""
    own = robot.effects.get('joint_friction', {'coulomb': 0.0, 'stiction': 0.0})
    coulomb, stiction = (np.broadcast_to(own[name], 4) for name in ('coulomb', 'stiction'))
    return coulomb, np.maximum(stiction, coulomb)


def all_keys(robot: RobotParameters) -> dict[str, Key]:
    """Keys of the whole catalogue with base values of ``robot``, by name."""
    keys: dict[str, Key] = {}
    effects = _effects_of(robot)
    for name, effect in CATALOGUE.items():
        if name not in TREATMENTS or ignored('gap', name) or (
                effect.beside and not set(effect.beside) & set(effects)):
            continue
        treatment = TREATMENTS[name]
        if effect.each == 'term':
            keys |= _terms(robot, name, treatment.sizes['coefficients'])
            continue
        # The file's modules load the joints by their share, so this entry is only the excess.
        groups = 'B' if name == MODULES and robot.multibody else treatment.channels
        for parameter, spec in effect.parameters.items():
            absent = bool(np.isnan(spec.neutral).any())
            relative = absent or parameter == 'scale'
            own = number_of(robot, spec.number) if absent else spec.neutral
            size = treatment.sizes.get(parameter, NO_SIZE)
            base = base_of(spec, effects.get(name, {}).get(parameter, own))
            texts = names_of(name, parameter)
            for k, (text, value) in enumerate(zip(texts, base, strict=True)):
                keys[text] = Key(text, name, parameter, k if len(texts) > 1 else None,
                                 float(value), relative, size.typical, size.smallest, groups,
                                 effect.apply is not None, size.step, spec.form,
                                 not relative and spec.low == 0.0)
    return keys


def _effects_of(robot):
    """Effects of the file; stiction is the larger one."""
    return robot.effects if 'joint_friction' not in robot.effects else {
        **robot.effects, 'joint_friction': dict(zip(
            CATALOGUE['joint_friction'].parameters, friction(robot), strict=True))}


def _terms(robot, name, size):
    """Keys of the terms of a formula; together, narrow ones have the smallest relevant size."""
    own = robot.effects.get(name, {'expressions': (), 'coefficients': ()})
    weight, arm = robot.mass * robot.gravity, ARM * size_of(robot, 'm')
    keys: dict[str, Key] = {}
    for k, (term, value) in enumerate(zip(*own.values(), strict=True)):
        typical, text = size_of_term(term, weight, arm), f'{name}.coefficients[{k}]'
        keys[text] = Key(text, name, 'coefficients', k, value, False, size.typical * typical,
                         size.smallest * typical / len(own['expressions'])**0.5, 'B', True)
    return keys


def tolerances(p: GapParameters) -> dict[str, float]:
    """Prior deviations of the keys by which every robot differs from the robot file."""
    result = {key: getattr(p, f'tolerance_{size.tolerance}')
              for name, treatment in TREATMENTS.items()
              for parameter, size in treatment.sizes.items() if size.tolerance
              for key in names_of(name, parameter)}
    result |= {'modules.share': p.modules_tolerance, DROOP: p.tolerance_gradient}
    for k in range(4):
        result |= {f'rotor.lag[{k}]': p.tolerance_lag, f'servo.kp[{k}]': p.tolerance_lag,
                   f'servo.kd[{k}]': p.tolerance_lag}
    for k in range(12):
        result[f'position.offset[{k}]'] = p.tolerance_position
    return result


def extra_keys(robot: RobotParameters) -> dict[str, Key]:
    """Keys outside the catalogue: rotor positions, modules, single servos, delays of the bus."""
    keys = {}

    def add(name, index, typical, groups, **more):
        effect, parameter = name.split('[')[0].split('.')
        keys[name] = Key(name, effect, more.pop('parameter', parameter), index, 0.0, False,
                         typical, 0.0, groups, **more)

    for k in range(12):
        add(f'position.offset[{k}]', k, 0.001, 'B', body=True)
    add('modules.share', None, 0.05, 'BJ', step=0.05)
    for name in (SWING, DROOP):
        add(name, None, 0.3, 'J', step=0.01)
    common = all_keys(robot)
    for k in range(4):
        add(f'rotor.lag[{k}]', k, 0.1, 'B', step=0.02)
    for parameter, name in OF_ONE.items():
        spec, like = CATALOGUE[name].parameters[parameter], common[f'{name}.{parameter}']
        own = number_of(robot, spec.number) if spec.number else spec.neutral
        each = np.broadcast_to(_effects_of(robot).get(name, {}).get(parameter, own), 4)
        keys |= {text: replace(like, name=text, effect='servo', index=k, base=float(each[k]))
                 for k, text in enumerate(f'servo.{parameter}[{k}]' for k in range(4))}
    for name, groups in ((TILT_BUS, 'J'), (THRUST_BUS, 'B')):
        add(name, None, 0.005, groups, parameter='delay')
    return keys


@dataclass(frozen=True)
class Prior:
    """Prior standard deviations of one key: narrow, of a candidate, between flights."""

    narrow: float
    typical: float
    flight: float


@dataclass(frozen=True)
class Entry:
    """A catalogue entry, of one rotor where its parameters are one for each."""

    name: str
    keys: tuple[str, ...]
    member: int | None = None
    in_loop: bool = True        # on channels with noise that a controller answers
    varying: bool = False       # differs from flight to flight, with keys for each flight

    @property
    def label(self) -> str:
        """Name with the number of the rotor."""
        if self.varying:
            return f'{self.name} by flight'
        return self.name if self.member is None else f'{self.name}[{self.member}]'


def size_of(robot: RobotParameters, unit: str) -> float:
    """Factor of a typical deviation with this unit for a robot of another size."""
    weight, arm = SIZE.get(unit, (0, 0))
    length = float(np.linalg.norm(robot.rotors.positions[:, :2], axis=1).mean())
    return (robot.mass * robot.gravity / WEIGHT)**weight * (length / ARM)**arm


def keys_of(robot: RobotParameters, names: set[str]) -> dict[str, Key]:
    """Fitted keys of the named catalogue entries."""
    return {name: key for name, key in all_keys(robot).items()
            if key.effect in names and not key.form}


def prior_of(robot: RobotParameters, key: Key, tolerance: float, stamps: float) -> Prior:
    """Priors of a key; ``tolerance`` of robots (0: none), ``stamps`` of a clock [s]."""
    unit = CATALOGUE[key.effect].parameters[key.parameter].unit
    size = 1.0 if key.relative else size_of(robot, unit)
    plain = f'{key.effect}.{key.parameter}'
    flight = FLIGHT.get(plain, 0.0)
    if plain == 'centre_of_mass.offset':
        flight = FLIGHT_OFFSET * ARM * size_of(robot, 'm')
    if plain == 'rotor_dead_time.delay':
        flight = max(flight, stamps)
    typical = key.typical
    if key.name in VERTICAL:
        drag = TREATMENTS['rotor_drag'].sizes['coefficient'].typical
        typical = AIR * (drag if plain == 'wind.force' else 1.0)
    return Prior(tolerance or 0.5 * key.smallest * size, typical * size, flight)


def entries_of(keys: dict[str, Key]) -> list[Entry]:
    """Entries of the catalogue that these keys belong to."""
    result = []
    for name in dict.fromkeys(key.effect for key in keys.values()):
        effect = CATALOGUE[name]
        own = tuple(key for key, at in keys.items() if at.effect == name and not at.form)
        # noise of IMU and MoCap reaches the commands; servos are simulated from commands
        body = any(keys[key].body or 'J' not in keys[key].groups for key in own)
        result += [Entry(name, (key,), k + 1, body) for k, key in enumerate(own)] \
            if effect.each else [Entry(name, own, None, body)]
    return result
