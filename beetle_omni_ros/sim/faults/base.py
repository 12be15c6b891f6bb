"""Faults: a kind with its numbers, start time and duration; base classes of all kinds."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Any, ClassVar

import numpy as np

from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.yaml_file import quoted

ROUNDING = 1e-9     # [s] bound of the rounding error of sums of ticks
LARGEST = 1e9       # bound of any number, against typing errors
KINDS: dict[str, type[Effect]] = {}
"""Name of a kind -> its class."""


@dataclass(frozen=True)
class Number:
    """
    Declaration of a number of a kind.

    Attributes:
        doc: meaning.
        unit: SI unit, '' for a pure number.
        default: default value; None: it must be given.
        low, high: smallest and largest legal value.
        whole: whether it must be a whole number.

    """

    doc: str
    unit: str = ''
    default: float | None = None
    low: float = -inf
    high: float = inf
    whole: bool = False

    def checked(self, value: Any, at: str) -> float:
        """Return a legal value as a float, else raise a ParameterError that starts with ``at``."""
        unit = f' {self.unit}' if self.unit else ''
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) \
                or not -inf < value < inf or (self.whole and value != int(value)):
            kind = 'a whole number' if self.whole else 'a number'
            raise ParameterError(f"{at}: expected {kind}{f' [{self.unit}]' if unit else ''}, "
                                 f'found {quoted(value)}')
        if not max(self.low, -LARGEST) <= value <= min(self.high, LARGEST):
            raise ParameterError(f'{at}: {quoted(value)} is outside {self.low:g} to '
                                 f'{self.high:g}{unit}')
        return float(value)


@dataclass(frozen=True, init=False)
class Fault:
    """
    One fault.

    Attributes:
        kind: a name in KINDS.
        at: time from the start of the schedule to the onset [s].
        duration: [s]; inf: permanent.
        numbers: all numbers of the kind, by name.

    """

    kind: str
    at: float
    duration: float
    numbers: Mapping[str, float]

    def __init__(self, kind: str, at: float = 0.0, duration: float = inf, **numbers: float):
        """
        Check all arguments; missing numbers have the defaults of the kind.

        Raises:
            ParameterError: illegal kind or number; the message has kind and key.

        """
        if kind not in KINDS:
            raise ParameterError(f'fault {quoted(kind)} is unknown; known: '
                                 f"{', '.join(sorted(KINDS))}")
        declared = KINDS[kind].numbers
        for key in numbers:
            if key not in declared:
                known = ', '.join(('at', 'duration', *declared))
                raise ParameterError(f"fault '{kind}': key {quoted(key)} is unknown; "
                                     f'known: {known}')
        values = {}
        for key, number in declared.items():
            value = numbers.get(key, number.default)
            if value is None:
                raise ParameterError(f"fault '{kind}': key '{key}' is missing ({number.doc})")
            values[key] = number.checked(value, f"fault '{kind}': key '{key}'")
        time = Number('', 's', low=0.0)
        object.__setattr__(self, 'kind', kind)
        object.__setattr__(self, 'at', time.checked(at, f"fault '{kind}': key 'at'"))
        object.__setattr__(self, 'duration', inf if duration == inf else time.checked(
            duration, f"fault '{kind}': key 'duration'"))
        object.__setattr__(self, 'numbers', values)

    @property
    def is_process(self) -> bool:
        """Whether it affects a process of the flight stack, not the robot or its devices."""
        return KINDS[self.kind].process

    def changes(self, *hooks: str) -> bool:
        """Whether its kind overrides one of these hooks of Effect."""
        own = KINDS[self.kind]
        return any(getattr(own, hook) is not getattr(Effect, hook) for hook in hooks)

    def __str__(self) -> str:
        """Kind, numbers and times: 'rotor_weak(rotor=2, share=0.5) at 3 s for 1 s'."""
        numbers = ', '.join(f'{key}={value:g}' for key, value in self.numbers.items())
        duration = '' if self.duration == inf else f' for {self.duration:g} s'
        return f"{self.kind}{f'({numbers})' if numbers else ''} at {self.at:g} s{duration}"


class Effect:
    """
    Effect of an active fault; its hooks are called once in each ``tick`` [s].

    A subclass with the argument ``kind`` overrides some of the hooks.

    Attributes:
        numbers: declarations of the kind's numbers, by name.
        process: whether it affects a process of the flight stack, see
            :class:`~beetle_omni_ros.sim.faults.processes.ProcessEffect`.

    """

    numbers: ClassVar[dict[str, Number]] = {}
    process: ClassVar[bool] = False

    def __init_subclass__(cls, kind: str | None = None):
        """Add a class with a ``kind`` to KINDS."""
        if kind:
            KINDS[kind] = cls

    def __init__(self, numbers: Mapping[str, float], tick: float, generator: np.random.Generator):
        self._numbers, self._tick, self._random = numbers, tick, generator

    def start(self, world) -> None:
        """Called once at the onset."""

    def end(self, world) -> None:
        """Called once at the end."""

    def drive(self, drive) -> None:
        """Change the actuation of this tick in place."""

    def imu(self, reading, now):
        """Return the changed IMU reading that arrives in this tick, or None."""
        return reading

    def mocap(self, reading, now):
        """As :meth:`imu`, for motion capture."""
        return reading

    def joints(self, reading, now):
        """As :meth:`imu`, for joint feedback."""
        return reading

    def rotors(self, reading, now):
        """As :meth:`imu`, for rotor speeds."""
        return reading

    def battery(self, reading, now):
        """As :meth:`imu`, for the battery."""
        return reading

    def command(self, command, now) -> list:
        """Return the commands that arrive now; also called with None once in each tick."""
        return [] if command is None else [command]

    @property
    def wrench(self) -> np.ndarray | None:
        """(6,) additional force in world [N] and torque in base_link [N m], or None."""
        return None

    @property
    def payload(self) -> float:
        """Additional mass below the body [kg]."""
        return 0.0


@dataclass
class World:
    """
    State that an effect can use and change at its onset and end.

    Attributes:
        truth: the present Truth.
        battery: the Battery.
        tilt: (4,) present targets of the servos [rad].

    """

    truth: Any
    battery: Any
    tilt: np.ndarray


@dataclass
class Actuation:
    """
    Inputs of the actuators in one tick; faults change them in place.

    Attributes:
        tilt: (4,) targets of the servos [rad].
        thrust: (4,) targets of the rotors [N].
        powered: (4,) whether a servo has torque.
        jammed: (4,) whether a joint is jammed at its target.
        wear: (4,) thrust relative to that of an intact propeller at the same speed.

    """

    tilt: np.ndarray
    thrust: np.ndarray
    powered: np.ndarray
    jammed: np.ndarray
    wear: np.ndarray


class Late(Effect):
    """Delays readings or commands."""

    numbers = {'delay': Number('additional delay', 's', low=0, high=5)}

    def start(self, world):
        self._queue: deque = deque()

    def _delayed(self, item: Any, now: float, limit: float = inf) -> list:
        """Queue ``item``, unless None; return at most ``limit`` items that are due at ``now``."""
        if item is not None:
            self._queue.append((now + self._numbers['delay'], item))
        due: list = []
        while len(due) < limit and self._queue and self._queue[0][0] <= now + ROUNDING:
            due.append(self._queue.popleft()[1])
        return due


class Lost:
    """Mixin: no item arrives."""

    def _change(self, item):
        return None


class Frozen:
    """Mixin: the first item is repeated with new stamps."""

    _first = None

    def _change(self, item):
        self._first = self._first or item
        return replace(self._first, stamp=item.stamp)


def vector(unit: str, what: str, **defaults: float) -> dict[str, Number]:
    """Declare components of a vector: name -> default."""
    return {key: Number(f'{key} {what}', unit, default) for key, default in defaults.items()}


def share(doc: str) -> Number:
    """Declare a number from 0 to 1."""
    return Number(doc, low=0.0, high=1.0)


def one_of_four(what: str) -> Number:
    """Declare the number of a rotor or servo, 1 to 4."""
    return Number(f'number of the {what}', '', None, 1, 4, whole=True)
