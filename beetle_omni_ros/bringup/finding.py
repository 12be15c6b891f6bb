"""One thing looked at: how it is, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field

OK, WARN, FAIL = 'ok', 'warn', 'fail'
LEVELS = (OK, WARN, FAIL)


@dataclass(frozen=True, slots=True)
class Finding:
    """
    One row of the result.

    Attributes:
        item: what was looked at; stable, for scripts.
        level: 'ok', 'warn' (flies, but look at it) or 'fail'.
        found: in words and numbers with units.
        remedy: what to do; '' where all is well.
        values: numbers behind ``found``, the unit in the key's ending.

    """

    item: str
    level: str
    found: str
    remedy: str = ''
    values: Mapping[str, float | int | str | None] = field(default_factory=dict)

    def as_dict(self, part: str) -> dict:
        """Row of the JSON."""
        return {'part': part, **asdict(self), 'values': dict(self.values)}


def worst(levels: Iterable[str]) -> str:
    """Return the worst of some levels; 'ok' of none."""
    return max(levels, key=LEVELS.index, default=OK)


def graded(item: str, found: str, value: float, remedy: str, *, warn: float, fail: float,
           values: Mapping | None = None) -> Finding:
    """Judge a number that is better the smaller it is: above ``warn``, above ``fail``."""
    level = FAIL if not value <= fail else WARN if value > warn else OK
    return Finding(item, level, found, '' if level == OK else remedy, values or {})


def missing_library(item: str, error: ModuleNotFoundError, extra: str) -> Finding:
    """Say which extra of pip brings a library that is not installed."""
    module = (error.name or '').partition('.')[0]
    return Finding(item, FAIL, f"not looked at: the module '{module}' is not installed",
                   f"pip install 'beetle_omni_ros[{extra}]'")
