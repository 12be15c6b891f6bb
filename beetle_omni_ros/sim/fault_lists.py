"""Lists of faults: the named ones of the campaign, those of one flight, and those of a text."""

from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path

from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import (
    bind,
    load_yaml,
    parameter,
    ParameterError,
    quoted,
    unknown,
)
from beetle_omni_ros.sim.faults import Fault

OUTCOMES = ('flies_on', 'lands', 'stops', 'refused')


@dataclass(frozen=True)
class Case:
    """One named fault of the campaign."""

    name: str = parameter(doc='')
    expected: str = parameter(doc='', choices=OUTCOMES)
    what: str = parameter(doc='')       # description
    strike: tuple = parameter(doc='')   # its faults; ``at`` counts from the onset


def _content(path, kind):
    """Value of the key 'faults', the only one of a file."""
    kind = make_dataclass('File', [('faults', kind, parameter(doc=''))])
    return bind(kind, load_yaml(path), str(path)).faults


def load_cases(path: str | Path | None = None) -> dict[str, Case]:
    """Read named faults, by default the shipped ones; a ParameterError has file and key."""
    path = path or share_path('params/faults.yaml')
    cases = {}
    for name, entry in _content(path, dict).items():
        case = bind(Case, entry | {'name': name} if isinstance(entry, dict) else entry, str(path),
                    f'faults.{name}')
        cases[name] = replace(case, strike=tuple(
            _fault(one, f"{path}: key 'faults.{name}': strike {k}")
            for k, one in enumerate(case.strike, 1)))
    return cases


def chosen(cases: dict[str, Case], names: list[str]) -> list[Case]:
    """Cases by name; a ParameterError reports an unknown one."""
    for name in names:
        if name not in cases:
            raise unknown('faults', f'fault {quoted(name)}', name, cases)
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
    named, faults = load_cases(), []
    for k, entry in enumerate(_content(path, tuple), 1):
        at = f'{path}: fault {k}'
        what = entry.get('what') if isinstance(entry, dict) else None
        if isinstance(what, str) and what in named and set(entry) <= {'what', 'at', 'duration'}:
            times = {key: value for key, value in entry.items() if key != 'what'}
            faults += [_fault({'kind': fault.kind, **fault.numbers, 'duration': fault.duration,
                               **times}, at) for fault in named[what].strike]
        else:
            faults.append(_fault(entry, at, 'what'))
    return faults


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
