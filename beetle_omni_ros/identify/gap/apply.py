"""The robot file with the named effects added; taking the keys out again undoes it."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from beetle_omni_ros import __version__
from beetle_omni_ros.identify.robot_file import rounded, write_robot_file
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

# What the rotors or joints share stands once in a file; what each has of its own, for all four.
MEMBERS = 4


def effects_with(robot: RobotParameters, named: list[dict]) -> dict[str, dict]:
    """
    The file's effects and the named ones, most likely member of each set.

    Args:
        robot: as believed.
        named: ``effects`` of the results.

    """
    effects = {name: dict(values) for name, values in robot.effects.items()}
    parts = [(effect, effect['names'][0], effect['parameters']) for effect in named]
    parts += [(effect, name, found) for effect in named
              for name, found in effect.get('also', {}).items()]
    for effect, name, parameters in parts:
        if not is_read(name):
            continue
        entry = CATALOGUE[name]
        member = effect.get('rotor') or effect.get('joint')
        values = effects.setdefault(name, {})
        for parameter, found in parameters.items():
            spec = entry.parameters[parameter]
            value = found['value']
            if member:
                all_four = list(values.get(parameter, spec.neutral))
                all_four[member - 1] = value
                value = all_four
            elif spec.of_each:
                value = _of_each(values.get(parameter, spec.neutral), found)
            low, high = spec.low, spec.high
            values[parameter] = [rounded(min(max(v, low), high)) for v in value] \
                if isinstance(value, (list, tuple)) else rounded(min(max(value, low), high))
    return effects


def _of_each(own, found):
    """
    One number where all joints share it, else a list of four.

    A log gives each joint's (``each``). A flight gives one for all: differences between joints
    that the file already has stay.
    """
    each = found.get('each')
    if each is None:
        if not isinstance(own, (list, tuple)):
            return found['value']
        mean = sum(own) / MEMBERS
        return [value + found['value'] - mean for value in own]
    before = list(own) if isinstance(own, (list, tuple)) else [own] * MEMBERS
    return [each.get(str(k + 1), before[k]) for k in range(MEMBERS)]


def is_read(name: str) -> bool:
    """Whether anything reads the effect from a robot file; sensors' own are for their drivers."""
    entry = CATALOGUE[name]
    return bool(entry.apply or entry.servo or entry.settings) or name in (
        'command_latency', 'joint_command_latency', 'rotor_dead_time', 'joint_backlash')


def write_corrected(path: Path, results: dict, robot: RobotParameters,
                    base: Path | None) -> None:
    """
    Write a robot file that extends the believed one by the named effects.

    Effects of sensors, which nothing reads from a robot file, stand under ``provenance`` only.

    Args:
        path: to write.
        results: of the analysis.
        robot: as believed.
        base: its file; None: the shipped one.

    Raises:
        ParameterError: the file cannot be written, or would not be a robot.

    """
    effects = effects_with(robot, results['effects'])
    try:
        replace(robot, effects={name: {k: tuple(v) if isinstance(v, list) else v
                                       for k, v in values.items()}
                                for name, values in effects.items()})
    except ParameterError as error:
        raise ParameterError(f'{path}: the corrected robot is not possible: {error}') from None
    named = [{'names': effect['names'],
              **{key: effect[key] for key in ('rotor', 'joint') if key in effect},
              'parameters': {key: {'value': entry['value'], 'interval': entry.get('interval'),
                                   'unit': entry['unit']}
                             for key, entry in effect['parameters'].items()}}
             for effect in results['effects']]
    content = {'effects': _plain(effects), 'provenance': _plain({
        'written_by': f'beetle_omni gap {__version__}',
        'date': datetime.now(timezone.utc).strftime('%Y-%m-%d'),
        'runs': results['meta']['runs'], 'holdout': results['meta']['holdout'],
        'robot_hash': robot.hash(), 'verdict': results['verdict'],
        'closure': results['closure'], 'named': named})}
    head = ('# Robot file with the effects that `beetle_omni gap` named. SI units; see\n'
            '# docs/gap.md. Removing an entry below `effects` undoes it.\n')
    write_robot_file(path, head, content, base)


def _plain(value):
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return rounded(value)
    return value
