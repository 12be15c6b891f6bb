"""Cross-validation by blocks of the data."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class HeldOut:
    """
    Gains in chi2 on held-out blocks.

    Attributes:
        gains: (blocks,) gains.

    """

    gains: np.ndarray

    @property
    def total(self) -> float:
        """Sum of the gains."""
        return float(self.gains.sum())

    @property
    def error(self) -> float:
        """Standard error of :attr:`total` by the scatter between blocks; inf for one block."""
        count = len(self.gains)
        return float(self.gains.std(ddof=1) * np.sqrt(count)) if count > 1 else np.inf

    @property
    def sigmas(self) -> float:
        """:attr:`total` in standard errors; 0 without scatter."""
        return self.total / self.error if self.error > 0 else 0.0

    @property
    def positive(self) -> float:
        """Share of the blocks that gain."""
        return float((self.gains > 0).mean())

    @property
    def without_best(self) -> float:
        """Gain without the block of the largest gain, against effects of one event."""
        return float(self.gains.sum() - self.gains.max()) if len(self.gains) > 1 else 0.0


def ridge_held_out(x: np.ndarray, r: np.ndarray, block: np.ndarray, blocks: int,
                   ridge: float) -> tuple[HeldOut, np.ndarray]:
    """
    Cross-validated ridge regression of r (n,) on x (n, P).

    ``block`` (n,) is the block of each sample, ``ridge`` the precision of the weights about 0.
    Returns the gains in chi2 on each block by a fit to the others, and weights (P,) of all blocks.
    """
    parts = [(x[block == b].T @ x[block == b], x[block == b].T @ r[block == b])
             for b in range(blocks)]
    h, g = (sum(part[k] for part in parts) for k in (0, 1))
    h = h + ridge * np.eye(x.shape[1])
    held = np.zeros(blocks)
    for b, (own, score) in enumerate(parts):
        w = np.linalg.solve(h - own, g - score)
        held[b] = 2 * score @ w - w @ own @ w
    return HeldOut(held), np.linalg.solve(h, g)
