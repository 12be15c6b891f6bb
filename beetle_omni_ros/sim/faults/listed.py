"""Lists of faults in files: the campaign's named ones, and those of one flight."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from math import inf
from pathlib import Path
from typing import Any

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter, ParameterError
from beetle_omni_ros.robot.yaml_file import quoted, shortened
from beetle_omni_ros.sim.faults.base import Fault, KINDS

# Hooks of what emulated devices see to themselves.
DEVICES = 'joints', 'rotors', 'battery', 'command'
GROUPS = ('limits', 'flight', 'healthy')
OUTCOMES = ('flies_on', 'lands', 'stops', 'refused')


@dataclass(frozen=True, kw_only=True)
class OutcomeLimits:
    """What counts as what."""

    impact_speed: float = parameter(doc='of a landing, at most', unit='m/s', low=0.01, high=100)
    inclination: float = parameter(doc='at a landing, at most', unit='rad', low=0, high=4)
    stop_time: float = parameter(doc='from a crash until the motors are off', unit='s', low=0,
                                 high=10)
    fence_margin: float = parameter(doc='outside the fence that is a flyaway', unit='m', low=0,
                                    high=1000)
    distance: float = parameter(doc='from the take-off that is a flyaway', unit='m', low=0,
                                high=1e4)
    rise: float = parameter(doc='above the floor after it has lain there: a take-off', unit='m',
                            low=0.01, high=10)
    rest_time: float = parameter(doc='on the floor without pause: it lies there', unit='s',
                                 low=0.01, high=10)
    idle_thrust: float = parameter(doc='commanded to all rotors: less is off', unit='N', low=0,
                                   high=10)
    landing_speed: float = parameter(doc='at touchdown in the landing campaign', unit='m/s',
                                     low=0.01, high=100)
    landing_inclination: float = parameter(doc='likewise', unit='rad', low=0, high=4)


@dataclass(frozen=True, kw_only=True)
class FlightPlan:
    """How the campaign flies."""

    height: float = parameter(doc='in hover and upside down', unit='m', low=0.5, high=15)
    spread: float = parameter(doc='|x| and |y| of poses on the move', unit='m', low=0, high=15)
    lowest: float = parameter(doc='of poses on the move', unit='m', low=0.4, high=15)
    highest: float = parameter(doc='of poses on the move', unit='m', low=0.4, high=15)
    hover_time: float = parameter(doc='until the fault, in hover', unit='s', low=0, high=100)
    turn_time: float = parameter(doc='likewise upside down', unit='s', low=0, high=100)
    move_time: float = parameter(doc='of each pose on the move', unit='s', low=0.5, high=100)
    pose_time: float = parameter(doc='of each pose, where it strikes at a random moment',
                               unit='s', low=0.5, high=100)
    jitter: float = parameter(doc='of the time of the fault', unit='s', low=0, high=100)
    watch_time: float = parameter(doc='from the fault to the landing request', unit='s', low=0,
                                  high=1000)
    landing_time: float = parameter(doc='longer, it does not land', unit='s', low=1, high=1000)
    end_time: float = parameter(doc='watched after the motors stopped or the robot broke',
                                unit='s', low=0, high=100)


@dataclass(frozen=True, kw_only=True)
class HealthyFlights:
    """Flights in which no fault may be named."""

    flight_time: float = parameter(doc='of poses in one flight', unit='s', low=1, high=1e5)
    pose_time: float = parameter(doc='of each pose', unit='s', low=0.5, high=1e4)
    effects: dict = parameter(doc="of the plant, as a robot file's")


@dataclass(frozen=True)
class Case:
    """
    One named fault of the campaign.

    Attributes:
        name: as in the file.
        expected: one of OUTCOMES.
        what: happens, in words.
        strike: the faults that make it up, ``at`` counted from its onset.

    """

    name: str
    expected: str
    what: str
    strike: tuple[Fault, ...]


@dataclass(frozen=True, kw_only=True)
class FaultList:
    """Everything in params/faults.yaml."""

    limits: OutcomeLimits = parameter(doc='what counts as what')
    flight: FlightPlan = parameter(doc='how the campaign flies')
    healthy: HealthyFlights = parameter(doc='flights without a fault')
    faults: dict = parameter(doc='name -> expected, what, strike')

    def __post_init__(self):
        """Refuse faults that are none."""
        object.__setattr__(self, 'cases', _cases(self.faults))

    @classmethod
    def load(cls, path: str | Path | None = None) -> FaultList:
        """
        Read a list; without a path, the shipped one. Groups that it lacks are the shipped ones.

        Raises:
            ParameterError: naming file, key and what was expected.

        """
        shipped = share_path('params/faults.yaml')
        path = path or shipped
        given = schema.load_yaml(path)
        if not isinstance(given.get('faults'), dict):
            raise ParameterError(f"{path}: key 'faults': expected a mapping of names, "
                                 f"found {type(given.get('faults')).__name__}")
        defaults = schema.load_yaml(shipped)
        return schema.bind(cls, {**{key: defaults[key] for key in GROUPS}, **given},
                           str(path))

    def chosen(self, names: list[str] | None) -> list[Case]:
        """
        Cases by name, all by default.

        Raises:
            ParameterError: an unknown name, with those that are known.

        """
        for name in names or ():
            if name not in self.cases:
                raise ParameterError(f"fault '{name}' is unknown; known: {', '.join(self.cases)}")
        return [self.cases[name] for name in names or self.cases]


def _cases(faults) -> dict[str, Case]:
    cases = {}
    for name, entry in faults.items():
        at = f"key 'faults.{shortened(name) if isinstance(name, str) else quoted(name)}'"
        if not isinstance(name, str) or not isinstance(entry, dict) \
                or set(entry) != {'expected', 'what', 'strike'}:
            raise ParameterError(f'{at}: expected the keys expected, what and strike')
        if entry['expected'] not in OUTCOMES:
            raise ParameterError(f"{at}: expected: one of {', '.join(OUTCOMES)}, "
                                 f"found {quoted(entry['expected'])}")
        if not isinstance(entry['what'], str):
            raise ParameterError(f'{at}: what: expected text')
        if not isinstance(entry['strike'], list) or not entry['strike']:
            raise ParameterError(f'{at}: strike: expected a list of faults')
        cases[name] = Case(name, entry['expected'], entry['what'], tuple(
            _fault(strike, f'{at}: strike {k}') for k, strike in enumerate(entry['strike'], 1)))
    return cases


def _fault(entry: Any, at: str) -> Fault:
    if not isinstance(entry, dict) or not isinstance(entry.get('kind'), str) \
            or not all(isinstance(key, str) for key in entry):
        raise ParameterError(f"{at}: expected a mapping with the key 'kind'")
    try:
        return Fault(entry['kind'], **{key: value for key, value in entry.items()
                                       if key not in ('kind', 'self')})
    except ParameterError as error:
        raise ParameterError(f'{at}: {error}') from None


def load_faults(path: str | Path) -> list[Fault]:
    """
    Read the faults of one flight: a list of what, at [s], duration [s] and numbers.

    ``what`` is a name of the shipped list, or a kind with its numbers.

    Raises:
        ParameterError: naming file, key and what was expected.

    """
    given = schema.load_yaml(path)
    unknown = set(map(str, given)) - {'faults'}
    if unknown:
        raise ParameterError(f'{path}: key {quoted(min(unknown))}: unknown key; known: faults')
    if not isinstance(given.get('faults'), list):
        raise ParameterError(f"{path}: key 'faults': expected a list")
    named = FaultList.load().cases
    return [fault for k, entry in enumerate(given['faults'], 1)
            for fault in _placed(entry, f'{path}: fault {k}', named)]


def _placed(entry, at, named):
    if not isinstance(entry, dict) or not isinstance(entry.get('what'), str):
        raise ParameterError(f"{at}: expected a mapping with the key 'what'")
    numbers = dict(entry)
    what = numbers.pop('what')
    if what in KINDS and not (what in named and set(numbers) <= {'at', 'duration'}):
        if 'kind' in numbers:
            raise ParameterError(f"{at}: key 'kind': give the kind as 'what'")
        return [_fault({'kind': what, **numbers}, at)]
    if what not in named:
        near = get_close_matches(what[:60], [*KINDS, *named], 8, 0.4)
        raise ParameterError(f"{at}: key 'what': {quoted(what)} is unknown, a kind or a name of "
                             'params/faults.yaml is expected' + (
                                 f"; near: {', '.join(dict.fromkeys(near))}" if near else ''))
    for key in numbers:
        if key not in ('at', 'duration'):
            raise ParameterError(f'{at}: key {quoted(key)}: a fault of the list takes at and '
                                 'duration')
    return [_fault({'kind': fault.kind, **fault.numbers, 'duration': fault.duration, **numbers},
                   at) for fault in named[what].strike]


def text(faults: list[Fault]) -> str:
    """Write faults as :func:`parse_faults` reads them."""
    return '; '.join(' '.join([fault.kind, f'at={fault.at!r}', *(
        f'{key}={float(value)!r}' for key, value in (
            *(() if fault.duration == inf else (('duration', fault.duration),)),
            *fault.numbers.items()))]) for fault in faults)


def parse_faults(text: str) -> list[Fault]:
    """
    Faults of a short text: 'rotor_stops rotor=2; mocap_lost duration=3'.

    Raises:
        ParameterError: naming the part that cannot be used.

    """
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
