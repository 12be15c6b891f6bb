"""Faults in time: which are on now."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

import numpy as np

from beetle_omni_ros.sim.faults.base import Effect, Fault, KINDS, ROUNDING


class Schedule:
    """
    A list of faults on a clock.

    The same faults, seed and calls give the same numbers. A fault that is in the list before and
    after a change goes on as it was.

    Attributes:
        active: effects that are on, in the order of the list.

    """

    def __init__(self, tick: float, seed: np.random.SeedSequence):
        """``tick`` between two updates [s]; ``seed`` of what is random in a fault."""
        self._tick, self._seed = tick, seed
        self._entries: list[list] = []      # fault, start time, effect or None, whether over
        self.active: list[Effect] = []

    def set(self, faults: Sequence[Fault], now: float, world=None) -> None:
        """Fly with these faults; their ``at`` counts from ``now`` [s]."""
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
        """Start and end what is due at ``now``."""
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
        """Whether there is nothing to switch on, now or later."""
        return not self._entries

    @property
    def names(self) -> list[str]:
        """Kinds that are on."""
        return [fault.kind for fault, _, effect, over in self._entries
                if effect is not None and not over]
