"""The robot file with the named effects; removing their keys undoes it."""

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.flights.keys import names_of, number_of
from beetle_omni_ros.identify.robot_file import rounded, write_robot_file
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import nest, ParameterError

MEMBERS = 4     # length of a list with one value for each rotor or joint


def effects_with(robot: RobotParameters, named: list[dict]) -> dict[str, dict]:
    """The file's effects and the first member of each of the ``named`` sets of the results."""
    effects = {name: dict(values) for name, values in robot.effects.items()}
    for effect in named:
        name = effect['names'][0]
        if 'expressions' in effect:     # a formula that was learned
            effects[name] = {'expressions': effect['expressions'], 'coefficients': [
                rounded(found['value']) for found in effect['parameters'].values()]}
            continue
        member = effect.get('rotor') or effect.get('joint') or effect.get('term')
        values = effects.setdefault(name, {})
        for parameter, found in effect['parameters'].items():
            spec = CATALOGUE[name].parameters[parameter]
            value = found['value']
            own = values.get(parameter, number_of(robot, spec.number) if spec.number
                             else spec.neutral)
            if member:
                value = found.get('written', value)     # a zero is reported over a log's angles
                every = list(own if np.ndim(own) else [own] * MEMBERS)
                every[member - 1] = value
                value = every
            elif spec.of_each:
                value = _of_each(own, found)
            values[parameter] = rounded(np.clip(value, spec.low, spec.high))
    return effects


def robot_with(robot: RobotParameters, effects: dict[str, dict]) -> RobotParameters:
    """The robot with other effects; a ParameterError reports an impossible one."""
    return replace(robot, effects={name: {k: tuple(v) if isinstance(v, list) else v
                                          for k, v in values.items()}
                                   for name, values in effects.items()})


def own_numbers(robot: RobotParameters, tolerances: dict[str, dict],
                named: Iterable[str] = ()) -> dict:
    """
    Values of the robot file, corrected by the fitted ``tolerances`` of the results.

    An effect in ``named`` that replaces a value has priority.

    Returns:
        mass, inertia, gains, lags and rotor positions, nested as in a robot file.

    """
    result: dict = {}
    for name, effect in CATALOGUE.items():
        for parameter, spec in effect.parameters.items():
            found = [tolerances[key]['deviation'] for key in names_of(name, parameter)
                     if key in tolerances]
            if spec.number and found and name not in {*robot.effects, *named}:
                value = number_of(robot, spec.number) * np.exp(
                    found if len(found) > 1 else found[0])
                result[spec.number] = np.asarray(value).tolist()
    moved = [tolerances.get(f'position.offset[{k}]', {'deviation': 0.0})['deviation']
             for k in range(12)]
    if any(moved):
        result['rotors.positions'] = (robot.rotors.positions + np.reshape(moved, (4, 3))).tolist()
    if any(moved) or 'mass' in result:      # alone they would move the inertia
        result.setdefault('inertia', robot.inertia.tolist())
    return nest(result)


def _of_each(own, found):
    """
    One value if all joints share it, else a list of four.

    A log has a value for each joint (``each``). A flight has one for all, and differences between
    the joints of the file stay.
    """
    each, own = found.get('each'), own.tolist() if isinstance(own, np.ndarray) else own
    if each is None:
        if not isinstance(own, (list, tuple)):
            return found['value']
        mean = sum(own) / MEMBERS
        return [value + found['value'] - mean for value in own]
    before = list(own) if isinstance(own, (list, tuple)) else [own] * MEMBERS
    return [each.get(str(k + 1), before[k]) for k in range(MEMBERS)]


def write_corrected(path: Path, results: dict, robot: RobotParameters,
                    base: Path | None, tolerances: bool = False) -> None:
    """
    Write a robot file that extends the base file by the named effects.

    It includes effects of sensors, which the estimator reads.

    Args:
        path: output file.
        results: results of the analysis.
        robot: parameters of the base file.
        base: path of the base file; None: the shipped one.
        tolerances: whether fitted tolerances replace values of the base file.

    Raises:
        ParameterError: the file cannot be written, or the corrected robot is invalid.

    """
    effects = effects_with(robot, results['effects'])
    try:
        robot_with(robot, effects)
    except ParameterError as error:
        raise ParameterError(f'{path}: the corrected robot is not possible: {error}') from None
    named = [{'names': effect['names'],
              **{key: effect[key] for key in ('rotor', 'joint') if key in effect},
              'parameters': {key: {'value': entry['value'], **_interval(entry),
                                   'unit': entry['unit']}
                             for key, entry in effect['parameters'].items()}}
             for effect in results['effects']]
    numbers = own_numbers(robot, results.get('tolerances') or {}, effects) if tolerances else {}
    content = {**rounded(numbers), 'effects': rounded(effects), 'provenance': rounded({
        'written_by': f'beetle_omni gap {__version__}',
        'date': datetime.now(timezone.utc).strftime('%Y-%m-%d'),
        'runs': results['meta']['runs'], 'holdout': results['meta']['holdout'],
        'robot_hash': robot.hash(), 'verdict': results['verdict'],
        'closure': results['closure'], 'named': named})}
    head = ('# Robot file with the effects that `beetle_omni gap` named. SI units; see\n'
            '# docs/gap.md. Removing an entry below `effects` undoes it.\n')
    write_robot_file(path, head, content, base)


def _interval(entry):
    """The interval of a fitted parameter; {} for a number that was not fitted."""
    interval = entry.get('interval')
    return {'interval': interval} if interval and np.ptp(interval, axis=-1).any() else {}
