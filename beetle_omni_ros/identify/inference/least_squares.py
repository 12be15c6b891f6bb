"""Minimisation under linear bounds, and Gaussian integrals over half spaces."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls
from scipy.special import log_ndtr

TOLERANCE = 1e-6    # [nat] of the minimum of a negative log density, where it is smooth
KINK = 1e-3         # [nat] of a step that does not lower it, where it is not
NEAR = 0.1          # [nat] of the minimum of a converged fit
LONGEST = 2.0       # largest change of a coordinate in one iteration
FAR = 6.0           # standard deviations from which a bound has no effect
SWEEPS = 20         # of expectation propagation
# cost, gradient (X,) and positive definite information (X, X) at coordinates (X,)
Local = Callable[[np.ndarray], tuple[float, np.ndarray, np.ndarray]]


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


def levenberg_marquardt(local: Local, x: np.ndarray, rows: np.ndarray, limits: np.ndarray,
                        iterations: int = 40) -> tuple[np.ndarray, bool]:
    """
    Minimise a negative log density [nat] from ``x`` (X,), with ``rows x + limits >= 0``.

    Returns:
        coordinates, and whether a quadratic model there promises less than NEAR.

    """
    x = x + bounded_step(np.eye(len(x)), np.zeros(len(x)), rows, rows @ x + limits)
    cost, g, h = local(x)
    damping = 1e-4
    for _ in range(iterations):
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
