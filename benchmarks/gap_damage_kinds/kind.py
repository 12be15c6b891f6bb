"""Class of a kind of damage, and the list of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import re
from types import CodeType
import zlib

import numpy as np

from gap_damage_kinds.recording import Recording

LIE, REPAIRABLE, HARMLESS = 'lie', 'repairable', 'harmless'
ALL, FIRST = 'all', 'first'


@dataclass(frozen=True)
class Kind:
    """
    One kind of damage.

    Attributes:
        name: name in tables.
        description: one line.
        change: function that damages its own recording; it takes a random generator and a
            recording of another flight, and returns the onset [s] by the undamaged stamps, or
            None.
        topics: right topics; empty: any.
        causes: alternatives; each a pattern, or several that must all be in one statement.
        scope: ALL flights of a set (set-up), or only the FIRST fitted one (single events).
        harm: LIE (data are false: never no gap), REPAIRABLE (no false data after messages are
            sorted or dropped: no gap is right if the damage is stated), or HARMLESS (a control
            that must not be refused).

    """

    name: str
    description: str
    change: Callable[[Recording, np.random.Generator, Recording], float | None]
    topics: tuple[str, ...] = ()
    causes: tuple[tuple[str, ...], ...] = ()
    scope: str = ALL
    harm: str = LIE

    def apply(self, recording: Recording, other: Recording,
              seed: int = 0) -> tuple[Recording, float | None]:
        """
        Damage a copy.

        Args:
            recording: original, not modified.
            other: recording of another flight, not modified.
            seed: seed of the damage.

        Returns:
            the damaged recording; onset [s] by the undamaged stamps, or None.

        """
        made = recording.copy()
        random = np.random.default_rng([seed, zlib.crc32(self.name.encode())])
        onset = self.change(made, random, other)
        return made, onset

    def key(self) -> str:
        """Hash of the code of the damage, without the expected words."""
        code = self.change.__code__
        parts = [code.co_code, *(repr(c).encode() for c in code.co_consts[1:]
                                 if not isinstance(c, CodeType)), self.scope.encode()]
        return f'{zlib.crc32(b" ".join(parts)):08x}'

    def is_stated_in(self, statement: str) -> bool:
        """Whether a statement contains the words of the cause."""
        return any(all(re.search(pattern, statement, re.IGNORECASE) for pattern in patterns)
                   for patterns in self.causes)


KINDS: dict[str, Kind] = {}


def damage(description: str, *topics: str, causes=(), scope: str = ALL, harm: str = LIE):
    """Register a function under its name; a cause is one pattern or several."""
    causes = tuple((cause,) if isinstance(cause, str) else tuple(cause) for cause in causes)

    def enter(change):
        name = change.__name__
        if name in KINDS:
            raise ValueError(f'two kinds of damage are called {name}')
        KINDS[name] = Kind(name, description, change, topics, causes, scope, harm)
        return change
    return enter
