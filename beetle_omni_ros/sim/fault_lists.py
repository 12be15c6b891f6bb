"""Lists of faults, of a file and of a text."""

from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path

from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import (
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
    """One named fault of a file."""

    name: str = parameter(doc='')
    strike: tuple = parameter(doc='')   # faults; ``at`` counts from the onset, or in one flight
                                        # from the start of its task
    expected: str = parameter('flies_on', doc='', choices=OUTCOMES)
    what: str = parameter('', doc='')   # description


def load_cases(path: str | Path | None = None) -> dict[str, Case]:
    """Read named faults, by default the shipped ones; a ParameterError has file and key."""
    path = path or share_path('params/faults.yaml')
    file = make_dataclass('File', [('faults', dict, parameter(doc=''))])
    cases = {}
    for name, entry in bind(file, load_yaml(path), str(path)).faults.items():
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


def _fault(entry, at):
    if not isinstance(entry, dict) or not isinstance(entry.get('kind'), str):
        raise ParameterError(f"{at}: expected a mapping with the key 'kind'")
    try:
        return Fault(entry['kind'], **{str(key): value for key, value in entry.items()
                                       if key != 'kind'})
    except ParameterError as error:
        raise ParameterError(f'{at}: {error}') from None


def load_faults(path: str | Path) -> list[Fault]:
    """Read all faults of a file, for one flight."""
    return [fault for case in load_cases(path).values() for fault in case.strike]


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
