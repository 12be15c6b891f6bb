"""Starts and ends faults by their times."""

from collections.abc import Sequence
from math import inf

import numpy as np

from beetle_omni_ros.sim.faults.base import Effect, Fault, KINDS, ROUNDING


class Schedule:
    """
    A list of faults and their effects, updated once in each ``tick`` [s].

    Equal faults, seeds and calls give equal results. A fault that is in the list before and after
    a change continues unchanged.

    Attributes:
        active: active effects in the order of the list.

    """

    def __init__(self, tick: float, seed: np.random.SeedSequence):
        self._tick, self._seed = tick, seed
        self._entries: list[list] = []      # fault, start time, effect or None, whether over
        self.active: list[Effect] = []

    def set(self, faults: Sequence[Fault], now: float, world=None) -> None:
        """Replace the faults; their ``at`` counts from ``now`` [s]."""
        before = list(self._entries)
        entries = []
        for fault in faults:
            same = next((entry for entry in before if entry[0] == fault), None)
            if same is not None:
                before.remove(same)
            entries.append(same or [fault, now, None, False])
        for _, _, effect, over in before:
            if effect is not None and not over:
                effect.end(world)
        self._entries = entries
        self._collect()

    def update(self, now: float, world=None) -> None:
        """Start and end the effects that are due at ``now`` [s]."""
        changed = False
        for entry in self._entries:
            fault, start, effect, over = entry
            begin = start + fault.at
            if effect is None and now >= begin - ROUNDING:
                effect = entry[2] = KINDS[fault.kind](
                    fault.numbers, self._tick, np.random.default_rng(self._seed.spawn(1)[0]))
                effect.start(world)
                changed = True
            if effect is not None and not over and fault.duration < inf \
                    and now >= begin + fault.duration - ROUNDING:
                effect.end(world)
                entry[3] = changed = True
        if changed:
            self._collect()

    def _collect(self):
        self.active = [effect for _, _, effect, over in self._entries
                       if effect is not None and not over]

    @property
    def empty(self) -> bool:
        """Whether the list is empty."""
        return not self._entries

    @property
    def names(self) -> list[str]:
        """Kinds of the active faults."""
        return [fault.kind for fault, _, effect, over in self._entries
                if effect is not None and not over]
