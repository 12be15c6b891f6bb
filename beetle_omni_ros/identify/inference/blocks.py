"""Blocks of the data: what a model gains on those it was not fitted to, and how they scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SCATTER = 2.0, 6.0      # range of a gradient's; below 2, slow drifts are covered too seldom


def block_masks(weight: np.ndarray, blocks: int) -> np.ndarray:
    """(blocks, N) 1 within each of the blocks of the samples that have a weight (N,)."""
    used = np.flatnonzero(weight)
    edges = np.linspace(used[0], used[-1] + 1, blocks + 1).astype(int)
    index = np.arange(len(weight))
    return np.array([(index >= a) & (index < b)
                     for a, b in zip(edges[:-1], edges[1:], strict=True)], dtype=float)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """
    Gains of chi2 on blocks that were left out.

    Attributes:
        gains: (blocks,).

    """

    gains: np.ndarray

    @property
    def total(self) -> float:
        """Gain of all blocks together."""
        return float(self.gains.sum())

    @property
    def error(self) -> float:
        """Standard error of :attr:`total`, from the scatter between blocks; inf of one block."""
        count = len(self.gains)
        return float(self.gains.std(ddof=1) * np.sqrt(count)) if count > 1 else np.inf

    @property
    def sigmas(self) -> float:
        """:attr:`total` in standard errors; 0 where there is no scatter."""
        return self.total / self.error if self.error > 0 else 0.0

    @property
    def positive(self) -> float:
        """Part of the blocks that gain."""
        return float((self.gains > 0).mean())

    @property
    def without_best(self) -> float:
        """Gain without the block that gains most: one event is no effect."""
        return float(self.gains.sum() - self.gains.max()) if len(self.gains) > 1 else 0.0


def ridge_held_out(x: np.ndarray, r: np.ndarray, block: np.ndarray, blocks: int,
                   ridge: float) -> tuple[HeldOut, np.ndarray]:
    """
    Ridge regression of r (n,) on x (n, P), judged on each block by a fit to the others.

    Args:
        x: features.
        r: whitened residual.
        block: (n,) number of each sample's block.
        blocks: how many.
        ridge: precision of every weight, about 0.

    Returns:
        gains of chi2, and the weights (P,) of a fit to all blocks.

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


def gradient_scatter(slopes: np.ndarray, residual: np.ndarray, covariance: np.ndarray,
                     blocks: np.ndarray) -> float:
    """
    Mean variance of the gradient over blocks, relative to what white residuals give.

    Chi2 over it counts as independent residuals would, which whitening alone does not ensure.

    Args:
        slopes: (n, N) derivatives of the whitened residuals.
        residual: (N,) whitened.
        covariance: (n, n) of the parameters, as white residuals would have it; 0 where not free.
        blocks: (blocks, N) 1 within each.

    """
    scores = np.array([(slopes * block) @ residual for block in blocks])
    free = np.diag(covariance) > 0
    ratio = np.trace(covariance @ (scores.T @ scores)) / free.sum()
    return float(np.clip(ratio, *SCATTER))
