"""
Nonlinear least squares with priors for many small problems at once.

The chi2 of a problem is the sum of squared whitened residuals and of its prior's residuals. The
method is Levenberg-Marquardt within bounds. A robust loss is applied to the residual
(:func:`robust.huber`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.prior import Prior


@dataclass(frozen=True)
class Steps:
    """
    Parameters of the Levenberg-Marquardt iteration.

    Attributes:
        tolerance: relative decrease of chi2 below which a problem is solved.
        longest: largest change of a coordinate in one step.
        factors: factors of the damping; both are tried in each step.
        more: factor of the damping if the second one was better.
        failed: factor of the damping if none was better.

    """

    tolerance: float = 1e-4
    longest: float = 12.0
    factors: tuple[float, float] = (0.2, 5.0)
    more: float = 3.0
    failed: float = 30.0


@dataclass(frozen=True)
class Fits:
    """
    Solutions of several problems.

    Attributes:
        points: (B, P) fitted points.
        chi2: (B,) chi2 with the prior.

    """

    points: np.ndarray
    chi2: np.ndarray


def minimise(points: np.ndarray, free: np.ndarray, low: np.ndarray, high: np.ndarray,
             residual: Callable[[np.ndarray, np.ndarray], np.ndarray],
             jacobian: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
             prior: Prior, iterations: int, steps: Steps = Steps()) -> Fits:
    """
    Minimise the chi2 of each problem.

    Args:
        points: (B, P) starts.
        free: (B, P) mask of fitted coordinates.
        low: (P,) lower bounds.
        high: (P,) upper bounds.
        residual: (points (M, P), problems (M,)) -> (M, n).
        jacobian: (points (M, P), problems (M,), residuals (M, n)) -> (M, P, n); 0 if not free.
        prior: prior of all problems.
        iterations: largest number of iterations.
        steps: parameters of the iteration.

    """
    points = np.where(free, np.clip(points, low, high), points)
    base = residual(points, np.arange(len(points)))
    chi2 = (base**2).sum(axis=1) + prior.cost(points)
    damping = np.full(len(chi2), 0.01)
    busy = np.asarray(free.any(axis=1))
    for _ in range(iterations):
        rows = np.flatnonzero(busy)
        if not rows.size:
            break
        here, slopes = points[rows], jacobian(points[rows], rows, base[rows])
        normal = slopes @ slopes.transpose(0, 2, 1)
        slope = (slopes @ base[rows][..., None])[..., 0] \
            + prior.slope(here) * prior.residual(here)
        diagonal = np.arange(points.shape[1])
        normal[:, diagonal, diagonal] += prior.slope(here)**2
        moves = [_step(here, normal, slope, free[rows], low, high, damping[rows] * factor)
                 for factor in steps.factors]
        tried = np.concatenate([np.where(free[rows], np.clip(
            here + np.clip(move, -steps.longest, steps.longest), low, high), here)
            for move in moves])
        new = residual(tried, np.tile(rows, 2))
        cost = (new**2).sum(axis=1) + prior.cost(tried)
        second = cost[len(rows):] < cost[:len(rows)]
        choice = np.arange(len(rows)) + np.where(second, len(rows), 0)
        better = cost[choice] < chi2[rows]
        fall = (chi2[rows] - cost[choice]) / np.maximum(chi2[rows], 1e-12)
        taken, source = rows[better], choice[better]
        points[taken], base[taken], chi2[taken] = tried[source], new[source], cost[source]
        damping[rows] = np.clip(np.where(
            better, damping[rows] * np.where(second, steps.more, 0.2),
            damping[rows] * steps.failed), 1e-6, 1e6)
        busy[rows] = np.where(better, fall > steps.tolerance, damping[rows] < 1e4)
    return Fits(points, chi2)


def _step(points, normal, slope, free, low, high, damping):
    """Damped steps (B, P); coordinates at a bound with an outward gradient stay."""
    stuck = ((points <= low + 1e-9) & (slope > 0)) | ((points >= high - 1e-9) & (slope < 0))
    move = free & ~stuck
    diagonal = np.arange(points.shape[1])
    matrix = normal.copy()
    matrix[:, diagonal, diagonal] = np.maximum(matrix[:, diagonal, diagonal], 1e-6) * (
        1 + damping[:, None])
    matrix = np.where(move[:, :, None] & move[:, None, :], matrix, np.eye(points.shape[1]))
    return -np.linalg.solve(matrix, np.where(move, slope, 0.0)[..., None])[..., 0]


def solved(h: np.ndarray, right: np.ndarray, ridge: float = 1e-9) -> np.ndarray:
    """
    Solution of normal equations ``h x = right`` with coordinates of different scale.

    ``ridge`` is a relative increase of each diagonal element.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(h), 1e-12))
    inner = h * scale[:, None] * scale + ridge * np.eye(len(h))
    return (scale * np.linalg.solve(inner, (scale * right.T).T).T).T
