"""
The catalogue of named effects: what reality may add to the model.

Each effect is declared once: equation and source, its parameters with unit, neutral value (at
which the effect vanishes), physical range, realistic magnitude and smallest size worth naming,
what excites it, what it is confused with and what separates the two. A robot file switches an
effect on by naming it. Its equation then acts where its kind says:

- body effects and those of rotors on the body change the terms of the Newton-Euler equations,
- joint effects change the servo's equation,
- effects that only replace a number of the robot file (a lag, a gain, a limit) replace it when
  the file is read, so that plant, NMPC and training all see the number,
- delays of commands stand in :attr:`RobotParameters.command_delays`,
- those of sensors are values that the gap finder fits and whoever reads the sensor may use.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

import numpy as np

from beetle_omni_ros.robot.effect_types import (
    Asked,
    Effect,
    EffectParameter,
    SensorErrors,
    ServoTerms,
    Stand,
    Terms,
)
from beetle_omni_ros.robot.effects_actuator import ACTUATOR, SENSOR
from beetle_omni_ros.robot.effects_body import BODY
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.yaml_file import quoted, shortened

# In the order in which they act together: the true tilt first, for it turns the thrusts.
CATALOGUE: dict[str, Effect] = {'joint_offset': ACTUATOR['joint_offset'], **BODY, **ACTUATOR,
                                **SENSOR}

MEMBERS = 4         # joints of this kind of robot

__all__ = ['Asked', 'CATALOGUE', 'command_delays', 'delaying', 'Effect', 'EffectParameter',
           'sensor_errors', 'SensorErrors', 'separating', 'ServoTerms', 'settings', 'Terms',
           'validated']
CONSUMERS = {'nmpc': 'NMPC and allocation', 'training': 'training', 'plant': 'simulated plant',
             'estimator': 'estimator', 'buses': 'delays of the buses', 'gap': 'gap finder'}
ACTS = Stand(True)
_CORRECTED = Stand(False, 'the estimator corrects the readings first')
_NO_MODEL = Stand(False, 'the filter follows the IMU and has no model of forces or servos')
_NO_DELAY = Stand(False, 'the effect delays no command')
_NO_JOINTS = Stand(False, 'the filter does not read the joints')
_STANDS = {
    'nmpc': {'sensor': _CORRECTED, 'play': Stand(
        False, 'a play is an offset of the servos, which is estimated in flight')},
    'training': {'sensor': _CORRECTED, 'play': Stand(
        False, 'the model of the servos has no play: train with joint_deflection or '
               'joint_friction, or take the effect out of the file', error=True)},
    'plant': {'play': Stand(
        False, 'MuJoCo has no play between encoder and rotor', error=True)},
    'estimator': {**dict.fromkeys(('body', 'servo', 'number', 'command', 'play'), _NO_MODEL),
                  'feedback': _NO_JOINTS},
    'buses': dict.fromkeys(('body', 'servo', 'number', 'sensor', 'feedback', 'play'), _NO_DELAY),
    'gap': {}}


def settings(effects: dict[str, dict]) -> dict[str, float]:
    """Dotted keys of the robot file that checked effects replace, with the new values."""
    return {key: effects[name][parameter] for name in effects
            for parameter, key in CATALOGUE[name].settings.items()}


def separating(names: Sequence[str]) -> str:
    """Experiment that tells entries apart: of the one that names most others as confused."""
    return CATALOGUE[max(names, key=lambda name: len(
        set(CATALOGUE[name].confused_with) & set(names) - {name}))].separated_by


def delaying(*what: str) -> tuple[str, ...]:
    """Names of the effects that delay any of ``what``; see :attr:`Effect.delays`."""
    return tuple(name for name, entry in CATALOGUE.items() if set(what) & set(entry.delays))


def command_delays(effects: dict[str, dict]) -> tuple[float, float]:
    """Delays of tilt and of thrust commands [s] that checked effects add."""
    tilt, thrust = (sum(effects.get(name, {}).get('delay', 0.0) for name in delaying(what))
                    for what in ('tilt', 'thrust'))
    return tilt, thrust


def sensor_errors(effects: dict[str, dict]) -> SensorErrors:
    """What checked effects say of the sensors."""
    return SensorErrors(**{spec.sensor: values[parameter] for name, values in effects.items()
                           for parameter, spec in CATALOGUE[name].parameters.items()
                           if spec.sensor})


def validated(effects: dict | None) -> dict[str, dict]:
    """
    Check a robot file's ``effects`` mapping against the catalogue.

    Returns:
        name -> parameter -> float or tuple of floats, parameters complete.

    Raises:
        ParameterError: unknown effect or parameter, wrong shape, value out of range.

    """
    checked: dict[str, dict] = {}
    if not isinstance(effects, dict | None):
        raise ParameterError(f'effects: expected a mapping, found {quoted(effects)}')
    for name, given in (effects or {}).items():
        name = shortened(str(name))
        if name not in CATALOGUE:
            near = get_close_matches(name, CATALOGUE, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(CATALOGUE)}"
            raise ParameterError(f'effects.{name}: unknown effect{hint}')
        entry = CATALOGUE[name]
        needed = {key for key, spec in entry.parameters.items() if spec.default is None}
        if not isinstance(given, dict) or not needed <= set(given) <= set(entry.parameters):
            expected = ', '.join(entry.parameters)
            raise ParameterError(f'effects.{name}: expected the keys {expected}, '
                                 f'found {quoted(given)}')
        checked[name] = {key: _value(f'effects.{name}.{key}', spec, given.get(key, spec.default))
                         for key, spec in entry.parameters.items()}
    return checked


def _value(at, spec, value):
    try:
        array = np.array(value, dtype=float)
    except (OverflowError, TypeError, ValueError):
        raise ParameterError(f'{at}: expected numbers [{spec.unit}], '
                             f'found {quoted(value)}') from None
    shape = np.shape(spec.neutral)
    if spec.of_each and array.shape == (MEMBERS,):
        shape = array.shape
    if array.shape != shape:
        each = f' or {(MEMBERS,)}' if spec.of_each else ''
        raise ParameterError(f'{at}: expected shape {shape}{each}, found {array.shape}')
    if not np.all((array >= spec.low) & (array <= spec.high)):
        raise ParameterError(f'{at}: {quoted(value)} is outside '
                             f'{spec.low:g} to {spec.high:g} {spec.unit}')
    return tuple(map(float, array)) if shape else float(array)


def stand(consumer: str, name: str) -> Stand:
    """
    Stand of a consumer on an effect: whether it acts on it, leaves it to another or refuses it.

    It follows from how the effect acts (:attr:`Effect.kind`), so that a new entry of the
    catalogue has a stand everywhere. One test over all of them holds that the stand is true.

    Args:
        consumer: one of ``CONSUMERS``.
        name: of the catalogue.

    """
    effect = CATALOGUE[name]
    return effect.stands.get(consumer) or _STANDS[consumer].get(effect.kind, ACTS)


def check(consumer: str, effects: Iterable[str]) -> None:
    """
    Refuse effects of a robot file that the consumer cannot have.

    Raises:
        ParameterError: naming the effect and the reason.

    """
    for name in effects:
        found = stand(consumer, name)
        if found.error:
            raise ParameterError(f'effects.{name}: the {CONSUMERS[consumer]} refuses this effect: '
                                 f'{found.reason}')
