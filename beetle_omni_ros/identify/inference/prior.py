"""Gaussian penalties of fitted parameters; without normaliser, so no densities for evidence."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Prior:
    """
    Gaussian prior about ``centre``, for one parameter or an array of them.

    It can have a flat range from ``below`` to ``above`` the centre with the deviation ``inner``.

    Attributes:
        deviation: standard deviation; inf: no prior.
        below: width of the flat range on the low side.
        above: width of the flat range on the high side.
        inner: standard deviation in the flat range, usually very large.
        centre: most likely value.

    """

    deviation: float | np.ndarray
    below: float = 0.0
    above: float = 0.0
    inner: float = np.inf
    centre: float | np.ndarray = 0.0

    def residual(self, x):
        """Deviation of ``x`` from the prior in standard deviations."""
        off = x - self.centre
        out = np.maximum(off - self.above, 0.0) + np.minimum(off + self.below, 0.0)
        return out / self.deviation + off / self.inner

    def slope(self, x):
        """Derivative of :meth:`residual`."""
        off = x - self.centre
        inside = (off > -self.below) & (off < self.above)
        return np.where(inside, 0.0, 1 / np.asarray(self.deviation)) + 1 / self.inner

    def within(self, x, deviations: float):
        """``x``, or the nearest value within so many standard deviations."""
        reach = deviations * self.deviation
        return np.clip(x, self.centre - self.below - reach, self.centre + self.above + reach)
