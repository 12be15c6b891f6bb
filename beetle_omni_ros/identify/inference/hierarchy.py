"""
Fits of common values and of deviations of each group, with evidence and left-out blocks.

A *unit* is one measured channel of one recording. Its parameters are ``theta = base + S x``: the
columns of ``S`` are the prior standard deviations of a common value and of the deviations of the
groups to which the unit belongs. So the prior of ``x`` is standard normal, between the bounds of
theta. The evidence is Laplace's approximation (MacKay 2003, chapter 28): a parameter that the data
do not need lowers it. Prior and evidence are normalised over the half spaces of the bounds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.least_squares import (
    bounded_step,
    levenberg_marquardt,
    log_integral,
)
from beetle_omni_ros.identify.inference.noise import huber

WIDTH = 1.96        # standard deviations of a 95 % interval
STRETCHES = 8       # of time, whose scores scatter


@dataclass(frozen=True)
class Spread:
    """
    Prior standard deviations of one parameter about its base value, in its coordinate.

    Attributes:
        common: of the value that all units share; 0: it has none.
        groups: name of a grouping -> standard deviation of the deviations of its groups.

    """

    common: float
    groups: dict[str, float]


def design(spreads: Sequence[Spread], labels: dict[str, Sequence], active: np.ndarray
           ) -> np.ndarray:
    """
    The matrices S (U, P, X) of all units.

    Deviations of the same units are one column: of a single group, also the common value.

    Args:
        spreads: P parameters.
        labels: name of a grouping -> the group of each of the U units.
        active: (P,) parameters that may change.

    """
    count = len(next(iter(labels.values())))
    columns = []
    for p in np.flatnonzero(active):
        spread = spreads[int(p)]
        variance = {(True,) * count: spread.common**2}
        for name, deviation in spread.groups.items():
            for group in sorted(set(labels[name])):
                member = tuple(label == group for label in labels[name])
                variance[member] = variance.get(member, 0.0) + deviation**2
        for member, size in variance.items():
            if size:
                column = np.zeros((count, len(spreads)))
                column[:, p] = np.sqrt(size) * np.array(member)
                columns.append(column)
    return np.stack(columns, axis=-1) if columns else np.zeros((count, len(spreads), 0))


@dataclass(frozen=True, eq=False)
class Fit:
    """
    Solution of a hierarchical problem.

    Attributes:
        x: (X,) standardised values.
        s: (U, P, X) design.
        theta: (U, P) parameters of each unit.
        chi2: sum of squared whitened residuals, with Huber's loss.
        information: (X, X) of data and prior.
        evidence: logarithm [nat], without the constants of the noise.
        held: (folds,) logarithms of the density of each fold, predicted from the others [nat],
            without the constants of the noise.
        deviations: (blocks, X) change of x without each block.
        inflation: variance of the scores of blocks, or of stretches of time, over that of
            independent residuals, at least 1.
        converged: whether the minimum is nearer than 0.01 nat.

    """

    x: np.ndarray
    s: np.ndarray
    theta: np.ndarray
    chi2: float
    information: np.ndarray
    evidence: float
    held: np.ndarray
    deviations: np.ndarray
    inflation: float
    converged: bool

    def covariance(self) -> np.ndarray:
        """(X, X) covariance of x."""
        return np.linalg.inv(self.information)

    def spread(self) -> np.ndarray:
        """(U, P, P) covariance of theta of each unit."""
        return self.s @ self.covariance() @ self.s.transpose(0, 2, 1)


Model = Callable[[np.ndarray, np.ndarray], tuple[list[np.ndarray], list[np.ndarray]]]


def solve(model: Model, base: np.ndarray, s: np.ndarray, x: np.ndarray,
          blocks: Sequence[np.ndarray], low: np.ndarray, high: np.ndarray,
          folds: np.ndarray | None = None) -> Fit:
    """
    Fit the standardised values.

    Args:
        model: (theta (U, P), active (P,)) -> whitened residuals of each unit (n_u,), and their
            derivatives (P, n_u); rows of inactive parameters are ignored.
        base: (U, P) values at x = 0.
        s: (U, P, X) design.
        x: (X,) start.
        blocks: (n_u,) number of the block of each sample, from 0, for each unit.
        low: (P,) lower bounds of theta.
        high: (P,) upper bounds.
        folds: (blocks,) number of the fold of each block, from 0; default: each its own.

    """
    active, size = (s != 0).any(axis=(0, 2)), s.shape[2]
    count = 1 + max(int(block.max(initial=0)) for block in blocks)
    folds = np.arange(count) if folds is None else folds
    rows, limits = _bounds(base, s, low, high)

    def parts(x):
        """Theta; chi2, scores of each unit, information of each block; scores of stretches."""
        theta = np.clip(base + s @ x, low, high)    # to rounding
        chi2, scores, matrices = (np.zeros(shape) for shape in (
            count, (len(s), count, size), (count, size, size)))
        stretches = []
        for u, (part, block, r, j) in enumerate(zip(s, blocks, *model(theta, active),
                                                    strict=True)):
            loss, ratio = huber(r)
            own = part[active].T @ (j[active] * ratio)
            chi2 += np.bincount(block, loss**2, count)
            for b in np.unique(block):
                mine = own[:, block == b]
                scores[u, b] = mine @ loss[block == b]
                matrices[b] += mine @ mine.T
            stretches += [each.sum(axis=1)
                          for each in np.array_split(own * loss, STRETCHES, axis=1)]
        return theta, chi2, scores, matrices, np.array(stretches)

    def local(x):
        _, chi2, scores, matrices, _ = parts(x)
        return ((chi2.sum() + x @ x) / 2, scores.sum(axis=(0, 1)) + x,
                matrices.sum(axis=0) + np.eye(size))

    converged = True
    if size:
        x, converged = levenberg_marquardt(local, x, rows, limits)
    theta, chi2, scores, matrices, stretches = parts(x)
    h, room = matrices.sum(axis=0) + np.eye(size), rows @ x + limits
    g = scores.sum(axis=(0, 1)) + x
    inside = log_integral(h, g, rows, room)
    prior = log_integral(np.eye(size), np.zeros(size), rows, limits)

    def without(part) -> tuple[np.ndarray, np.ndarray]:
        return h - matrices[part].sum(axis=0), g - scores[:, part].sum(axis=(0, 1))

    held = [-chi2[part].sum() / 2 + inside - log_integral(*without(part), rows, room)
            for part in (folds == fold for fold in range(folds.max() + 1))]
    return Fit(x, s, theta, float(chi2.sum()), h,
               float(-(chi2.sum() + x @ x) / 2 + inside - prior), np.array(held),
               np.array([bounded_step(*without([b]), rows, room) for b in range(count)]),
               max(_inflation(h, each) for each in (
                   scores.reshape(len(s) * count, size), stretches)), converged)


def _inflation(h, scores):
    """Mean variance of the estimates by the scatter of scores (K, X), over that by curvature."""
    inverse = np.linalg.inv(h)
    known = np.trace(inverse @ (h - np.eye(len(h))))
    if known <= 0 or len(scores) < 2:
        return 1.0
    scatter = np.einsum('kx,xy,ky->', scores, inverse, scores) * len(scores) / (len(scores) - 1)
    return float(max(scatter / known, 1.0))


def _bounds(base, s, low, high):
    """Rows (K, X) and limits (K,) of the bounds of theta, ``rows x + limits >= 0``."""
    moved = (s != 0).any(axis=2)
    rows = np.concatenate([s[moved], -s[moved]])
    limits = np.concatenate([(base - low)[moved], (high - base)[moved]])
    both = np.unique(np.column_stack([rows, limits]), axis=0)
    return both[:, :-1], both[:, -1]
