"""
Faults by their times, and lists of them in a file or a text.

An example is ``Fault('rotor_weak', at=3.0, duration=1.0, rotor=2, share=0.5)``. Faults of robot
and devices go to ``Simulator.set_faults``, those of processes to the in-process loop.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass, replace
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import (
    bind,
    load_yaml,
    parameter,
    ParameterError,
    quoted,
    unknown,
)
from beetle_omni_ros.sim.fault_kinds import Kind, KINDS, number, ROUNDING

READINGS = 'imu', 'mocap', 'joints', 'rotors', 'battery'        # attributes of a Frame
OF_PROCESSES = {'estimate', 'request', 'clock', 'waits', 'target', 'bridges'}
DEVICES = 'joints', 'rotors', 'battery', 'command'      # without effect if devices are emulated
OUTCOMES = ('flies_on', 'lands', 'stops', 'refused')
WHOLE = 'rotor', 'servo', 'axis'    # numbers that are integers
TIMES = {'at': number(0.0, 's', low=0), 'duration': number(inf, 's', low=0)}


@dataclass(frozen=True, init=False)
class Fault:
    """One fault."""

    kind: str                       # a name in KINDS
    at: float                       # time from the start of the schedule to the onset [s]
    duration: float                 # [s]; inf: permanent
    numbers: Mapping[str, float]    # all numbers of the kind, by name

    def __init__(self, kind: str, /, at: float = 0.0, duration: float = inf, **numbers: float):
        """Check all arguments; a ParameterError has kind and key of an illegal one."""
        if kind not in KINDS:
            raise unknown('faults', f'fault {quoted(kind)}', kind, KINDS)
        entries = TIMES | KINDS[kind].numbers
        declared = make_dataclass(kind, [(key, int if key in WHOLE else float, entry)
                                         for key, entry in entries.items()], kw_only=True)
        limited = {} if duration == inf else {'duration': duration}
        values = vars(bind(declared, {**numbers, 'at': at, **limited}, f"fault '{kind}'"))
        vars(self).update(kind=kind, at=values.pop('at'), duration=values.pop('duration'),
                          numbers=values)

    @property
    def is_process(self) -> bool:
        """Whether it affects a process of the flight stack, not the robot or its devices."""
        return self.changes(*OF_PROCESSES)

    def changes(self, *signals: str) -> bool:
        """Whether its kind has a function of one of these signals."""
        return not KINDS[self.kind].functions.keys().isdisjoint(signals)

    def __str__(self) -> str:
        """Text for parse_faults: 'rotor_weak at=3 duration=1 rotor=2 share=0.5'."""
        times = {'at': self.at, **({} if self.duration == inf else {'duration': self.duration})}
        return ' '.join([self.kind, *(f'{key}={str(value).removesuffix(".0")}'
                                      for key, value in (times | self.numbers).items())])


class Schedule:
    """
    Starts and ends faults by their times, updated once in each ``tick`` [s].

    Equal faults, seeds and calls give equal results.
    """

    def __init__(self, tick: float, seed: np.random.SeedSequence):
        self._tick, self._seed = tick, seed
        # The state of a fault: its numbers, k (index of its rotor or servo), tick, now, memory
        # (for its functions, at first None), and from its onset random, truth and held.
        self._states: list[SimpleNamespace] = []
        self.empty = True
        # Kind and state of each active fault, in the order of the list.
        self.active: list[tuple[Kind, Any]] = []

    def set(self, faults: Sequence[Fault], now: float) -> None:
        """Replace the faults, ``at`` counts from ``now`` [s]; one that stays continues."""
        before, self._states, self.empty = self._states, [], not faults
        for fault in faults:
            state = next((state for state in before if state.fault == fault), None)
            if state is not None:
                before.remove(state)
            self._states.append(state or SimpleNamespace(
                **fault.numbers, fault=fault, begin=now + fault.at, active=False, over=False,
                k=int(fault.numbers.get('rotor', fault.numbers.get('servo', 1))) - 1,
                tick=self._tick, memory=None))
        self._list_active()

    def update(self, now: float, truth: Any = None, held: np.ndarray | None = None) -> None:
        """Start and end the faults due at ``now`` [s], with the true state and servo targets."""
        for state in self._states:
            if not (state.active or state.over) and now >= state.begin - ROUNDING:
                state.truth, state.held, state.active = truth, held, True
                state.random = np.random.default_rng(self._seed.spawn(1)[0])
            if state.active and now >= state.begin + state.fault.duration - ROUNDING:
                state.active, state.over = False, True
            state.now = now
        self._list_active()

    def _list_active(self):
        self.active = [(KINDS[state.fault.kind], state) for state in self._states if state.active]

    def through(self, signal: str, item: Any, now: float) -> list:
        """Items that arrive ``now`` [s] if ``item``, or None, is sent through the faults."""
        items = [] if item is None else [item]
        for kind, state in self.active:
            function = kind.functions.get(signal)
            if function is None:
                continue
            state.now = now
            if kind.late:
                items = [out for one in items or [None] for out in function(state, one)]
            else:
                items = [out for one in items if (out := function(state, one)) is not None]
        return items

    def each(self, signal: str, *arguments: Any) -> list:
        """Results of the functions of ``signal`` of the active faults."""
        return [kind.functions[signal](state, *arguments) for kind, state in self.active
                if signal in kind.functions]


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
                    f'faults.{name}.')
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
