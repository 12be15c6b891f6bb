"""Values of effects in a robot file, their delays, and which programs ignore an effect."""

from collections.abc import Sequence

import numpy as np

from beetle_omni_ros.model.effects import CATALOGUE, NO_JOINTS
from beetle_omni_ros.model.schema import numbers, ParameterError, quoted, unknown

# Terms that the simulated plant and the gap finder have -> why NMPC and training leave out an
# effect of them.
MEASURED = {'voltage_ratio': 'it has no voltage and assumes a full pack',
            'charge_drawn': 'it has no current of the pack and assumes that no charge was drawn'}
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
    return checked


def _value(at, spec, value):
    array, shape = numbers(value, at, vars(spec)), np.shape(spec.neutral)
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
    if effect.measured and consumer in ('nmpc', 'training'):
        return '; '.join(MEASURED[term] for term in effect.measured)
    return effect.ignored_by.get(consumer) or _IGNORED.get(consumer, {}).get(effect.kind, '')
