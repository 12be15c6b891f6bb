"""What is known of a parameter beside the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Prior:
    """
    Gaussian about ``centre``, for one parameter or for an array of them.

    Within -below to above of the centre nothing is said but ``inner``, a very wide deviation.

    Attributes:
        deviation: standard deviation; inf: nothing is known.
        centre: most likely value.
        below: width of the free range on the low side.
        above: on the high side.
        inner: standard deviation within the free range.

    """

    deviation: float | np.ndarray
    centre: float | np.ndarray = 0.0
    below: float = 0.0
    above: float = 0.0
    inner: float = np.inf

    def residual(self, x):
        """How many standard deviations ``x`` lies off, and within the free range little."""
        off = x - self.centre
        out = np.maximum(off - self.above, 0.0) + np.minimum(off + self.below, 0.0)
        return out / self.deviation + off / self.inner

    def slope(self, x):
        """Derivative of :meth:`residual`."""
        off = x - self.centre
        inside = (off > -self.below) & (off < self.above)
        return np.where(inside, 0.0, 1 / np.asarray(self.deviation)) + 1 / self.inner

    def cost(self, x):
        """Sum of the squares of :meth:`residual` along the last axis."""
        return (self.residual(x)**2).sum(axis=-1)

    def within(self, x, deviations: float):
        """``x``, or the nearest value that is no more than so many deviations off."""
        reach = deviations * self.deviation
        return np.clip(x, self.centre - self.below - reach, self.centre + self.above + reach)
