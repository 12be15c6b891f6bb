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
from scipy.optimize import nnls
from scipy.special import log_ndtr

from beetle_omni_ros.identify.inference.noise import huber

WIDTH = 1.96        # standard deviations of a 95 % interval
STRETCHES = 8       # of time, whose scores scatter
TOLERANCE = 1e-6    # [nat] of the minimum of a negative log density, where it is smooth
KINK = 1e-3         # [nat] of a step that does not lower it, where it is not
NEAR = 0.1          # [nat] of the minimum of a converged fit
LONGEST = 2.0       # largest change of a coordinate in one iteration
ITERATIONS = 40         # most of a minimisation
FAR = 6.0           # standard deviations from which a bound has no effect
SWEEPS = 20         # of expectation propagation
# cost, gradient (X,) and positive definite information (X, X) at coordinates (X,)
Local = Callable[[np.ndarray], tuple[float, np.ndarray, np.ndarray]]


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


# --- minimisation under linear bounds, and Gaussian integrals over half spaces -------------------

def bounded_step(h: np.ndarray, g: np.ndarray, rows: np.ndarray, room: np.ndarray) -> np.ndarray:
    """
    The step d that minimises ``d h d / 2 + g d`` with ``rows d + room >= 0``.

    Lawson and Hanson (1974), chapter 23: a least distance problem, solved by its dual.
    """
    root = np.linalg.cholesky(h)
    centre = -np.linalg.solve(h, g)
    near = np.zeros(len(rows), dtype=bool)
    step = centre
    while (out := (rows @ step + room < -1e-9 * (1 + np.abs(room))) & ~near).any():
        near |= out
        # z = root' (d - centre) of least norm with given z >= least
        given = np.linalg.solve(root, rows[near].T).T
        least = -(room[near] + rows[near] @ centre)
        target = np.append(np.zeros(len(g)), 1.0)
        multipliers, _ = nnls(np.vstack([given.T, least]), target, maxiter=30 * len(least) + 100)
        rest = np.vstack([given.T, least]) @ multipliers - target
        step = centre - np.linalg.solve(root.T, rest[:-1] / rest[-1])
    return step


def levenberg_marquardt(local: Local, x: np.ndarray, rows: np.ndarray, limits: np.ndarray
                        ) -> tuple[np.ndarray, bool]:
    """
    Minimise a negative log density [nat] from ``x`` (X,), with ``rows x + limits >= 0``.

    Returns:
        coordinates, and whether a quadratic model there promises less than NEAR.

    """
    x = x + bounded_step(np.eye(len(x)), np.zeros(len(x)), rows, rows @ x + limits)
    cost, g, h = local(x)
    damping = 1e-4
    for _ in range(ITERATIONS):
        room = rows @ x + limits
        left = _promised(h, g, bounded_step(h, g, rows, room))
        if left < TOLERANCE:
            break
        step = bounded_step(h + damping * np.diag(np.diag(h)), g, rows, room)
        step *= min(1.0, LONGEST / np.abs(step).max())
        after, *slopes = local(x + step)
        if after < cost:
            x, cost, (g, h) = x + step, after, slopes
            damping = max(damping / 5, 1e-6)
        elif _promised(h, g, step) < KINK:
            break
        else:
            damping *= 8
    return x, left < NEAR


def _promised(h, g, step):
    return -(g @ step + step @ h @ step / 2)


def log_orthant(mean: np.ndarray, covariance: np.ndarray) -> float:
    """
    Logarithm of the probability that all of some Gaussian variables are positive.

    Expectation propagation, exact for independent variables (Cunningham, Hennig and
    Lacoste-Julien 2011).
    """
    if len(mean) < 2:       # exact
        return float(np.sum(log_ndtr(mean / np.sqrt(np.diag(covariance)))))
    precision, shift = np.zeros((2, len(mean)))     # of the Gaussian factors of the half spaces
    for _ in range(SWEEPS):
        wide = np.eye(len(mean)) + covariance * precision
        inner = np.linalg.solve(wide, covariance)
        centre = mean + inner @ (shift - precision * mean)
        variance = 1 / (1 / np.diag(inner) - precision)
        own = variance * (centre / np.diag(inner) - shift)
        size = own / np.sqrt(variance)
        ratio = np.exp(-size**2 / 2 - log_ndtr(size)) / np.sqrt(2 * np.pi)
        left = variance * np.maximum(1 - ratio * (ratio + size), 1e-12)
        precision = (precision + 1 / left - 1 / variance) / 2       # half way, for convergence
        shift = (shift + (own + np.sqrt(variance) * ratio) / left - own / variance) / 2
    wide, moved = np.eye(len(mean)) + covariance * precision, shift - precision * mean
    total = (moved @ np.linalg.solve(wide, covariance) @ moved - np.linalg.slogdet(wide)[1]) / 2 \
        + np.sum(shift * mean - precision * mean**2 / 2)
    wide = 1 + precision * variance
    return float(total + np.sum(log_ndtr(size) + np.log(wide) / 2 - (
        variance * shift**2 / 2 + own * shift - own**2 * precision / 2) / wide))


def log_integral(h: np.ndarray, g: np.ndarray, rows: np.ndarray, room: np.ndarray) -> float:
    """Logarithm of the integral of ``exp(-d h d / 2 - g d)`` over ``rows d + room >= 0`` [nat]."""
    inverse = np.linalg.inv(h)
    centre = -inverse @ g
    between = np.einsum('ki,ij,kj->k', rows, inverse, rows)
    near = rows @ centre + room < FAR * np.sqrt(between)
    inside = log_orthant(rows[near] @ centre + room[near], rows[near] @ inverse @ rows[near].T)
    return float(-g @ centre / 2 + len(g) / 2 * np.log(2 * np.pi)
                 - np.linalg.slogdet(h)[1] / 2 + inside)
