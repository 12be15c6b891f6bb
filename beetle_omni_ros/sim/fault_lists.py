"""Lists of faults: the named faults of params/faults.yaml, and the faults of one flight."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError, quoted, shortened
from beetle_omni_ros.sim.faults import Fault, near

# Signals without effect if the devices are emulated.
DEVICES = 'joints', 'rotors', 'battery', 'command'
OUTCOMES = ('flies_on', 'lands', 'stops', 'refused')


class Case(NamedTuple):
    """One named fault of the campaign."""

    name: str
    expected: str                   # outcome, one of OUTCOMES
    what: str                       # description
    strike: tuple[Fault, ...]       # its faults; ``at`` counts from the onset


def load_cases(path: str | Path | None = None) -> dict[str, Case]:
    """Read named faults, by default the shipped ones; a ParameterError has file and key."""
    path = path or share_path('params/faults.yaml')
    return {str(name): _case(str(name), entry, f"{path}: key 'faults.{shortened(str(name))}'")
            for name, entry in _content(path, dict, 'a mapping of names').items()}


def _content(path, kind, what):
    given = schema.load_yaml(path)
    for key in given:
        if key != 'faults':
            raise ParameterError(f'{path}: key {quoted(key)}: unknown key; known: faults')
    if not isinstance(given.get('faults'), kind):
        raise ParameterError(f"{path}: key 'faults': expected {what}")
    return given['faults']


def _case(name, entry, at):
    if not isinstance(entry, dict) or set(entry) != {'expected', 'what', 'strike'} \
            or not isinstance(entry['strike'], list) or not entry['strike']:
        raise ParameterError(f'{at}: expected the keys expected, what and strike, a list of '
                             'faults')
    if entry['expected'] not in OUTCOMES:
        raise ParameterError(f"{at}: expected: one of {', '.join(OUTCOMES)}, "
                             f"found {quoted(entry['expected'])}")
    return Case(name, entry['expected'], str(entry['what']), tuple(
        _fault(one, f'{at}: strike {k}') for k, one in enumerate(entry['strike'], 1)))


def chosen(cases: dict[str, Case], names: list[str]) -> list[Case]:
    """Cases by name; a ParameterError reports an unknown one."""
    for name in names:
        if name not in cases:
            raise ParameterError(f'fault {quoted(name)} is unknown{near(name, cases)}')
    return [cases[name] for name in names]


def _fault(entry, at, key='kind'):
    """Fault of a mapping whose ``key`` is the kind."""
    if not isinstance(entry, dict) or not isinstance(entry.get(key), str):
        raise ParameterError(f"{at}: expected a mapping with the key '{key}'")
    try:
        return Fault(entry[key], **{str(name): value for name, value in entry.items()
                                    if name != key})
    except ParameterError as error:
        raise ParameterError(f'{at}: {error}') from None


def load_faults(path: str | Path) -> list[Fault]:
    """
    Read the faults of one flight, each with the keys what, at [s], duration [s] and numbers.

    ``what`` is a name of the shipped list without numbers, or a kind. A ParameterError has file
    and key.
    """
    named = load_cases()
    return [fault for k, entry in enumerate(_content(path, list, 'a list'), 1)
            for fault in _placed(entry, f'{path}: fault {k}', named)]


def _placed(entry, at, named):
    what = entry.get('what') if isinstance(entry, dict) else None
    if isinstance(what, str) and what in named and set(entry) <= {'what', 'at', 'duration'}:
        times = {key: value for key, value in entry.items() if key != 'what'}
        return [_fault({'kind': fault.kind, **fault.numbers, 'duration': fault.duration, **times},
                       at) for fault in named[what].strike]
    return [_fault(entry, at, 'what')]


def parse_faults(text: str) -> list[Fault]:
    """Parse a text such as 'rotor_stops rotor=2; mocap_lost duration=3'."""
    faults = []
    for part in filter(None, (part.strip() for part in text.split(';'))):
        kind, *given = part.split()
        try:
            numbers = {key: float(value) for key, _, value in (one.partition('=')
                                                               for one in given)}
        except ValueError:
            raise ParameterError(f'faults: {quoted(part)}: expected KIND NAME=NUMBER '
                                 '...') from None
        faults.append(_fault({'kind': kind, **numbers}, 'faults'))
    return faults
