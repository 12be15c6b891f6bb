"""Parameters in units in which a fit moves alike in all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Coordinates:
    """
    Points (..., P): values in units of their scales, logarithms where fitted so.

    Attributes:
        each: the P parameters, each with ``low`` and ``high`` (of a fit), ``scale`` (a change that
            matters; of the logarithm where ``logarithmic``) and ``logarithmic``.
        scale, logarithmic: (P,) of each.
        low, high: (P,) bounds of points.

    """

    each: Sequence[Any]
    scale: np.ndarray = field(init=False)
    logarithmic: np.ndarray = field(init=False)
    low: np.ndarray = field(init=False)
    high: np.ndarray = field(init=False)

    def __post_init__(self):
        """Collect scales and bounds."""
        for name in ('scale', 'logarithmic'):
            object.__setattr__(self, name, np.array([getattr(one, name) for one in self.each]))
        for side in ('low', 'high'):
            object.__setattr__(self, side, self.encode(
                np.array([getattr(one, side) for one in self.each])))

    def encode(self, values: np.ndarray) -> np.ndarray:
        """Points of values (..., P)."""
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, values, 1.0)),
                        values) / self.scale

    def decode(self, points: np.ndarray) -> np.ndarray:
        """Inverse of :meth:`encode`."""
        values = points * self.scale
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, values, 0.0)),
                        values)
