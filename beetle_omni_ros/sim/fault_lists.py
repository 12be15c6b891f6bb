"""Lists of faults: the named faults of the campaign, and the faults of one flight."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from math import inf
from pathlib import Path
from typing import NamedTuple

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter, ParameterError, quoted, shortened
from beetle_omni_ros.sim.faults import Fault, KINDS

# Signals without effect if the devices are emulated.
DEVICES = 'joints', 'rotors', 'battery', 'command'
OUTCOMES = ('flies_on', 'lands', 'stops', 'refused')


@dataclass(frozen=True, kw_only=True)
class OutcomeLimits:
    """Limits that define the outcome of a flight."""

    impact_speed: float = parameter(doc='largest impact speed of a landing', unit='m/s', low=0.01,
                                    high=100)
    inclination: float = parameter(doc='largest inclination at a landing', unit='rad', low=0,
                                   high=4)
    stop_time: float = parameter(doc='largest time from a crash until the motors are off',
                                 unit='s', low=0, high=10)
    fence_margin: float = parameter(doc='distance outside the fence that is a flyaway', unit='m',
                                    low=0, high=1000)
    distance: float = parameter(doc='distance from the take-off that is a flyaway', unit='m',
                                low=0, high=1e4)
    rise: float = parameter(doc='height above the floor that is a take-off, after the robot lay '
                            'on it', unit='m', low=0.01, high=10)
    rest_time: float = parameter(doc='time of contact after which the robot lies on the floor',
                                 unit='s', low=0.01, high=10)
    idle_thrust: float = parameter(doc='smallest sum of commanded thrusts with motors on',
                                   unit='N', low=0, high=10)
    landing_speed: float = parameter(doc='largest impact speed in the landing campaign',
                                     unit='m/s', low=0.01, high=100)
    landing_inclination: float = parameter(doc='largest inclination in the landing campaign',
                                           unit='rad', low=0, high=4)


@dataclass(frozen=True, kw_only=True)
class FlightPlan:
    """Flights of the campaign."""

    height: float = parameter(doc='height of hover and inverted hover', unit='m', low=0.5, high=15)
    spread: float = parameter(doc='largest |x| and |y| of the poses in motion', unit='m', low=0,
                              high=15)
    lowest: float = parameter(doc='smallest height of the poses in motion', unit='m', low=0.4,
                              high=15)
    highest: float = parameter(doc='largest height of the poses in motion', unit='m', low=0.4,
                               high=15)
    hover_time: float = parameter(doc='time until the fault in hover', unit='s', low=0, high=100)
    turn_time: float = parameter(doc='time until the fault in inverted hover', unit='s', low=0,
                                 high=100)
    move_time: float = parameter(doc='time of each pose in motion', unit='s', low=0.5, high=100)
    pose_time: float = parameter(doc='time of each pose in flights with a fault at a random time',
                                 unit='s', low=0.5, high=100)
    jitter: float = parameter(doc='range of the random time of the fault', unit='s', low=0,
                              high=100)
    watch_time: float = parameter(doc='time from the fault to the landing request', unit='s',
                                  low=0, high=1000)
    landing_time: float = parameter(doc='largest duration of a landing', unit='s', low=1,
                                    high=1000)
    end_time: float = parameter(doc='simulated time after the motors stopped or the robot broke',
                                unit='s', low=0, high=100)


@dataclass(frozen=True, kw_only=True)
class HealthyFlights:
    """Flights without a fault, in which none may be detected."""

    flight_time: float = parameter(doc='duration of one flight', unit='s', low=1, high=1e5)
    pose_time: float = parameter(doc='time of each pose', unit='s', low=0.5, high=1e4)
    effects: dict = parameter(doc='effects of the plant, as in a robot file')


class Case(NamedTuple):
    """One named fault of the campaign."""

    name: str
    expected: str                   # outcome, one of OUTCOMES
    what: str                       # description
    strike: tuple[Fault, ...]       # its faults; ``at`` counts from the onset


@dataclass(frozen=True, kw_only=True)
class FaultList:
    """Content of params/faults.yaml."""

    limits: OutcomeLimits = parameter(doc='limits of the outcomes')
    flight: FlightPlan = parameter(doc='flights of the campaign')
    healthy: HealthyFlights = parameter(doc='flights without a fault')
    faults: dict = parameter(doc='name -> expected, what, strike')

    def __post_init__(self):
        object.__setattr__(self, 'cases', {
            name: _case(name, entry, f"key 'faults.{shortened(str(name))}'")
            for name, entry in self.faults.items()})

    @classmethod
    def load(cls, path: str | Path | None = None) -> FaultList:
        """
        Read a file; without a path, the shipped one. Missing groups are those of the shipped one.

        Raises:
            ParameterError: unusable file; the message has file, key and the expected value.

        """
        shipped = share_path('params/faults.yaml')
        path = path or shipped
        given = schema.load_yaml(path)
        if not isinstance(given.get('faults'), dict):
            raise ParameterError(f"{path}: key 'faults': expected a mapping of names")
        defaults = schema.load_yaml(shipped)
        return schema.bind(cls, {**{key: defaults[key] for key in ('limits', 'flight', 'healthy')},
                                 **given}, str(path))

    def chosen(self, names: list[str] | None) -> list[Case]:
        """
        Cases by name, all by default.

        Raises:
            ParameterError: unknown name.

        """
        for name in names or ():
            if name not in self.cases:
                raise ParameterError(f'fault {quoted(name)} is unknown, a name of the list is '
                                     f'expected{_near(name, self.cases)}')
        return [self.cases[name] for name in names or self.cases]


def _case(name, entry, at):
    if not isinstance(entry, dict) or set(entry) != {'expected', 'what', 'strike'} \
            or not isinstance(entry['strike'], list) or not entry['strike']:
        raise ParameterError(f'{at}: expected the keys expected, what and strike, a list of '
                             'faults')
    if entry['expected'] not in OUTCOMES:
        raise ParameterError(f"{at}: expected: one of {', '.join(OUTCOMES)}, "
                             f"found {quoted(entry['expected'])}")
    return Case(str(name), entry['expected'], str(entry['what']), tuple(
        _fault(one, f'{at}: strike {k}') for k, one in enumerate(entry['strike'], 1)))


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

    ``what`` is a name of the shipped list, or a kind.

    Raises:
        ParameterError: unusable file; the message has file, key and the expected value.

    """
    given = schema.load_yaml(path)
    for key in given:
        if key != 'faults':
            raise ParameterError(f'{path}: key {quoted(key)}: unknown key; known: faults')
    if not isinstance(given.get('faults'), list):
        raise ParameterError(f"{path}: key 'faults': expected a list")
    named = FaultList.load().cases
    return [fault for k, entry in enumerate(given['faults'], 1)
            for fault in _placed(entry, f'{path}: fault {k}', named)]


def _placed(entry, at, named):
    what = entry.get('what') if isinstance(entry, dict) else None
    times = {key: value for key, value in entry.items() if key != 'what'} if what else {}
    if not isinstance(what, str) or what in KINDS and not (
            what in named and set(times) <= {'at', 'duration'}):
        return [_fault(entry, at, 'what')]
    if what not in named:
        raise ParameterError(f"{at}: key 'what': {quoted(what)} is unknown, a kind or a name of "
                             f'params/faults.yaml is expected{_near(what, [*KINDS, *named])}')
    for key in times:
        if key not in ('at', 'duration'):
            raise ParameterError(f'{at}: key {quoted(key)}: a fault of the list takes at and '
                                 'duration')
    return [_fault({'kind': fault.kind, **fault.numbers, 'duration': fault.duration, **times}, at)
            for fault in named[what].strike]


def _near(name, known):
    near = get_close_matches(name[:60], known, 8, 0.4)
    return f"; near: {', '.join(dict.fromkeys(near))}" if near else \
        f"; for example {', '.join([*known][:4])}"


def text(faults: list[Fault]) -> str:
    """Text of faults in the format of :func:`parse_faults`."""
    return '; '.join(' '.join([fault.kind, f'at={fault.at!r}', *(
        f'{key}={float(value)!r}' for key, value in (
            *(() if fault.duration == inf else (('duration', fault.duration),)),
            *fault.numbers.items()))]) for fault in faults)


def parse_faults(text: str) -> list[Fault]:
    """
    Parse a text such as 'rotor_stops rotor=2; mocap_lost duration=3'.

    Raises:
        ParameterError: unusable part of the text.

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
