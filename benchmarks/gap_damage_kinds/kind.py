"""What a kind of damage is, and the list of all."""

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
    One way to damage a recording.

    Attributes:
        name: in tables.
        description: one line.
        change: damages a recording that is its own; takes a random generator and a recording
            of another flight; returns the onset [s] by the undamaged stamps, or None.
        topics: where a right answer finds it; empty: anywhere.
        causes: alternatives; each a pattern, or several that must all stand in one statement.
        scope: ALL flights of a set (how something is built or set up), or only the FIRST
            fitted one (what happens once).
        harm: LIE (data are false: never no gap), REPAIRABLE (nothing false is left once some
            messages are sorted or left out: no gap is right if the damage is told), or HARMLESS
            (a control: not to be refused).

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
            recording: stays as it is.
            other: of another flight; stays as it is.
            seed: of what is random in the damage.

        Returns:
            the damaged recording; onset [s] by the undamaged stamps, None without a moment.

        """
        made = recording.copy()
        random = np.random.default_rng([seed, zlib.crc32(self.name.encode())])
        onset = self.change(made, random, other)
        return made, onset

    def key(self) -> str:
        """Changes with what the damage does, not with the words that are looked for."""
        code = self.change.__code__
        parts = [code.co_code, *(repr(c).encode() for c in code.co_consts[1:]
                                 if not isinstance(c, CodeType)), self.scope.encode()]
        return f'{zlib.crc32(b" ".join(parts)):08x}'

    def told_by(self, statement: str) -> bool:
        """Whether a statement holds the words of the cause."""
        return any(all(re.search(pattern, statement, re.IGNORECASE) for pattern in patterns)
                   for patterns in self.causes)


KINDS: dict[str, Kind] = {}


def damage(description: str, *topics: str, causes=(), scope: str = ALL, harm: str = LIE):
    """Enter a function under its own name; a cause may be one pattern or several."""
    causes = tuple((cause,) if isinstance(cause, str) else tuple(cause) for cause in causes)

    def enter(change):
        name = change.__name__
        if name in KINDS:
            raise ValueError(f'two kinds of damage are called {name}')
        KINDS[name] = Kind(name, description, change, topics, causes, scope, harm)
        return change
    return enter
