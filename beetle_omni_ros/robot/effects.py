"""
The catalogue of named effects: terms that reality may add to the model.

Each effect is declared once, with equation, source, parameters, excitation and the effects that
it is confused with. A robot file enables an effect by naming it. Its place of action follows from
its kind:

- Effects on the body change the terms of the Newton-Euler equations.
- Joint effects change the equation of the servo.
- Effects that replace a number of the robot file (a lag, a gain, a limit) do so when the file is
  read. Plant, NMPC and training then use the new number.
- Delays of commands are in :attr:`RobotParameters.command_delays`.
- Sensor effects are in :attr:`RobotParameters.sensors`. The gap finder fits them.
"""

from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np

from beetle_omni_ros.robot.effect_types import (
    Effect,
    EffectParameter,
    LimitStarts,
    MEASURED,
    SensorErrors,
    ServoTerms,
    Terms,
    Treatment,
)
from beetle_omni_ros.robot.effects_actuator import ACTUATOR, SENSOR
from beetle_omni_ros.robot.effects_body import BODY
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.yaml_file import quoted, shortened

# In order of application: the true tilt first, because it changes the thrust directions.
CATALOGUE: dict[str, Effect] = {'joint_offset': ACTUATOR['joint_offset'], **BODY, **ACTUATOR,
                                **SENSOR}

JOINTS = 4

__all__ = ['CATALOGUE', 'command_delays', 'delaying', 'Effect', 'EffectParameter', 'LimitStarts',
           'sensor_errors', 'SensorErrors', 'separating_experiment', 'ServoTerms', 'settings',
           'Terms', 'validated']
CONSUMERS = {'nmpc': 'NMPC and allocation', 'training': 'training', 'plant': 'simulated plant',
             'estimator': 'estimator', 'buses': 'delays of the buses', 'gap': 'gap finder'}
ACTS = Treatment(True)
_CORRECTED = Treatment(False, 'the estimator corrects the readings first')
_NO_MODEL = Treatment(False, 'the filter integrates the IMU and has no model of forces or servos')
_NO_DELAY = Treatment(False, 'the effect delays no command')
_NO_JOINTS = Treatment(False, 'the filter does not read the joints')
_TREATMENTS = {
    'nmpc': {'sensor': _CORRECTED, 'play': Treatment(
        False, 'a play is an offset of the servos, which is estimated in flight')},
    'training': {'sensor': _CORRECTED},
    'plant': {},
    'estimator': {**dict.fromkeys(('body', 'servo', 'number', 'command', 'play'), _NO_MODEL),
                  'feedback': _NO_JOINTS},
    'buses': dict.fromkeys(('body', 'servo', 'number', 'sensor', 'feedback', 'play'), _NO_DELAY),
    'gap': {}}


def settings(effects: dict[str, dict]) -> dict[str, float]:
    """Dotted keys of the robot file that validated effects replace, with the new values."""
    return {key: effects[name][parameter] for name in effects
            for parameter, key in CATALOGUE[name].settings.items()}


def separating_experiment(names: Sequence[str]) -> str:
    """Experiment that distinguishes entries, from the one with most others as confused."""
    return CATALOGUE[max(names, key=lambda name: len(
        set(CATALOGUE[name].confused_with) & set(names) - {name}))].separated_by


def delaying(*what: str) -> tuple[str, ...]:
    """Names of the effects that delay any of ``what``; see :attr:`Effect.delays`."""
    return tuple(name for name, entry in CATALOGUE.items() if set(what) & set(entry.delays))


def command_delays(effects: dict[str, dict]) -> tuple[float, float]:
    """Delays of tilt and of thrust commands [s] from validated effects."""
    tilt, thrust = (sum(effects.get(name, {}).get('delay', 0.0) for name in delaying(what))
                    for what in ('tilt', 'thrust'))
    return tilt, thrust


def sensor_errors(effects: dict[str, dict]) -> SensorErrors:
    """Sensor errors from validated effects."""
    return SensorErrors(**{spec.sensor: values[parameter] for name, values in effects.items()
                           for parameter, spec in CATALOGUE[name].parameters.items()
                           if spec.sensor})


def validated(effects: dict | None) -> dict[str, dict]:
    """
    Validate a robot file's ``effects`` mapping against the catalogue.

    Returns:
        name -> parameter -> float or tuple of floats, with all parameters of each effect.

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
    if spec.of_each and array.shape == (JOINTS,):
        shape = array.shape
    if array.shape != shape:
        each = f' or {(JOINTS,)}' if spec.of_each else ''
        raise ParameterError(f'{at}: expected shape {shape}{each}, found {array.shape}')
    if not np.all((array >= spec.low) & (array <= spec.high)):
        raise ParameterError(f'{at}: {quoted(value)} is outside '
                             f'{spec.low:g} to {spec.high:g} {spec.unit}')
    return tuple(map(float, array)) if shape else float(array)


def treatment(consumer: str, name: str) -> Treatment:
    """
    How a consumer treats an effect: it acts on it or states why not.

    This follows from the kind of effect (:attr:`Effect.kind`), so that each new entry has a
    treatment. ``test/gap/test_consumers.py`` checks every pair against the consumer's results.

    Args:
        consumer: one of ``CONSUMERS``.
        name: name in the catalogue.

    """
    effect = CATALOGUE[name]
    if consumer in effect.treatments:
        return effect.treatments[consumer]
    if effect.measured and consumer in ('nmpc', 'training'):
        return Treatment(False, '; '.join(MEASURED[term] for term in effect.measured))
    return _TREATMENTS[consumer].get(effect.kind, ACTS)
