"""What a fault is: a kind with its numbers, when it starts and how long it lasts."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar

import numpy as np

from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.robot.yaml_file import quoted

ROUNDING = 1e-9     # [s] sums of ticks differ from their product by less
LARGEST = 1e9       # of any number; what is beyond is a slip of the pen
KINDS: dict[str, type[Effect]] = {}
"""Name of a kind -> what it does."""


@dataclass(frozen=True)
class Number:
    """
    A number of a kind.

    Attributes:
        doc: what it is.
        unit: SI unit, '' for a pure number.
        default: taken where nobody gives it; None: it must be given.
        low, high: smallest and largest legal value.
        whole: whether it is a whole number.

    """

    doc: str
    unit: str = ''
    default: float | None = None
    low: float = -inf
    high: float = inf
    whole: bool = False

    def checked(self, value: Any, at: str) -> float:
        """``value`` as a float; a ParameterError that begins with ``at`` where it is not legal."""
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
    One fault, switched on at a time for a time.

    Attributes:
        kind: a name in KINDS.
        at: since the schedule's start [s].
        duration: [s]; inf: it stays.
        numbers: all numbers of the kind, by name.

    """

    kind: str
    at: float
    duration: float
    numbers: Mapping[str, float]

    def __init__(self, kind: str, at: float = 0.0, duration: float = inf, **numbers: float):
        """
        Check everything; numbers that are not given take the kind's defaults.

        Raises:
            ParameterError: naming the kind or the key, in one line.

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
        """Whether it strikes a process of the flight stack, not the robot or its devices."""
        return KINDS[self.kind].process

    def changes(self, *hooks: str) -> bool:
        """Whether it acts through one of these hooks of Effect."""
        own = KINDS[self.kind]
        return any(getattr(own, hook) is not getattr(Effect, hook) for hook in hooks)

    def __str__(self) -> str:
        """Kind, numbers and times, as in 'rotor_weak(rotor=2, share=0.5) at 3 s for 1 s'."""
        numbers = ', '.join(f'{key}={value:g}' for key, value in self.numbers.items())
        lasts = '' if self.duration == inf else f' for {self.duration:g} s'
        return f"{self.kind}{f'({numbers})' if numbers else ''} at {self.at:g} s{lasts}"


class Effect:
    """
    What a fault does while it is on. A kind overrides the hooks it needs.

    Attributes:
        numbers: of the kind, by name.
        process: whether a process of the flight stack is struck, see
            :class:`~beetle_omni_ros.sim.faults.processes.ProcessEffect`.

    """

    numbers: ClassVar[dict[str, Number]] = {}
    process: ClassVar[bool] = False

    def __init__(self, numbers: Mapping[str, float], tick: float, generator: np.random.Generator):
        """
        Start with nothing done yet.

        Args:
            numbers: complete and checked.
            tick: between two calls of a hook [s].
            generator: for what is random in it.

        """
        self._numbers, self._tick, self._random = numbers, tick, generator

    def start(self, world) -> None:
        """It begins now; ``world`` is what it may look at and change."""

    def end(self, world) -> None:
        """It ends now."""

    def drive(self, drive) -> None:
        """Change what the actuators do in this tick, see Actuation."""

    def imu(self, reading, now):
        """The IMU's reading of this tick, as it arrives; None: nothing does."""
        return reading

    def mocap(self, reading, now):
        """Likewise for motion capture."""
        return reading

    def joints(self, reading, now):
        """Likewise for joint feedback."""
        return reading

    def rotors(self, reading, now):
        """Likewise for the rotor speeds."""
        return reading

    def battery(self, reading, now):
        """Likewise for the pack."""
        return reading

    def command(self, command, now) -> list:
        """Pass on, delay or lose a command; called once with None in every tick."""
        return [] if command is None else [command]

    @property
    def wrench(self) -> np.ndarray | None:
        """(6,) force in world [N] and torque in base_link [N m] that it adds, or None."""
        return None

    @property
    def payload(self) -> float:
        """Mass that it attaches below the body [kg]."""
        return 0.0


@dataclass
class World:
    """
    What an effect may look at and change when it starts.

    Attributes:
        truth: the present Truth.
        battery: the Battery.
        tilt: (4,) targets of the servos in force [rad].

    """

    truth: Any
    battery: Any
    tilt: np.ndarray


@dataclass
class Actuation:
    """
    What the actuators do in one tick; faults change it in place.

    Attributes:
        tilt: (4,) targets of the servos [rad].
        thrust: (4,) targets of the rotors [N].
        powered: (4,) whether a servo has torque.
        jammed: (4,) whether a joint is held by force at its target.
        wear: (4,) thrust for each newton that the rotor's speed should give.

    """

    tilt: np.ndarray
    thrust: np.ndarray
    powered: np.ndarray
    jammed: np.ndarray
    wear: np.ndarray


class Late(Effect):
    """Holds what passes for a while."""

    numbers = {'delay': Number('in addition', 's', low=0, high=5)}

    def start(self, world):
        self._way: deque = deque()

    def _arrived(self, item: Any, now: float, most: float = inf) -> list:
        """What has arrived by ``now`` [s], at most so many, where ``item`` (or None) sets out."""
        if item is not None:
            self._way.append((now + self._numbers['delay'], item))
        arrived: list = []
        while len(arrived) < most and self._way and self._way[0][0] <= now + ROUNDING:
            arrived.append(self._way.popleft()[1])
        return arrived


def kind(name: str):
    """Enter a class into KINDS."""
    def enter(cls):
        KINDS[name] = cls
        return cls
    return enter


def vector(unit: str, what: str, **defaults: float) -> dict[str, Number]:
    """Numbers x, y, z (or other names), zero by default."""
    return {key: Number(f'{key} {what}', unit, default) for key, default in defaults.items()}


def share(what: str, default: float | None = None) -> Number:
    """A number from 0 to 1."""
    return Number(what, '', default, 0.0, 1.0)


def one_of_four(what: str) -> Number:
    """Number of a rotor or servo, 1 to 4."""
    return Number(f'number of the {what}', '', None, 1, 4, whole=True)
