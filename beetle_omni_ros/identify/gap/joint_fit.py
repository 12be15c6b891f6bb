"""Levenberg-Marquardt for servos that share numbers, many models at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.fitting import encode, Fitter, Noise, Prior
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.joint_servos import Servos

STEP = 0.05         # of a number's scale, for derivatives
LONGEST = 8.0       # scales that a number moves in one iteration
TOLERANCE = 2e-4    # relative fall of chi2 below which a model is done


@dataclass(frozen=True)
class Solved:
    """
    Fitted models.

    Attributes:
        points: (M, P).
        chi2: (M,) whitened and clipped.

    """

    points: np.ndarray
    chi2: np.ndarray


class StackFitter:
    """
    Fits points of :class:`Servos` to one log.

    Args:
        log: measured data.
        noise: how residuals are whitened.
        servos: the layout of a point.

    """

    def __init__(self, log: JointLog, noise: Noise, servos: Servos):
        """Keep the three; see the class."""
        self.log, self.servos = log, servos
        self._fitter = Fitter(log, noise, Prior.none())

    def residuals(self, points: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(M, J, N) weighted, whitened, clipped; ``weight``: (M, N)."""
        sets = self.servos.sets(points)
        models, count = sets.shape[:2]
        flat = encode(sets.reshape(models * count, -1))
        made = self._fitter.residuals(flat, np.tile(np.arange(count), models),
                                      np.repeat(weight, count, axis=0))
        return made.reshape(models, count, -1)

    def jacobian(self, points, free, weight, base) -> np.ndarray:
        """(M, P, J, N) derivatives of the residuals by differences; 0 where not free."""
        rows, columns = np.nonzero(free)
        moved = points[rows].copy()
        at = np.arange(len(rows)), columns
        step = np.where(moved[at] + STEP > self.servos.high[columns], -STEP, STEP)
        moved[at] += step
        owner = np.array([-1 if n.joint is None else n.joint for n in self.servos.numbers])
        sets = self.servos.sets(moved)
        # a number of one joint moves that joint alone: one simulation instead of four
        pairs = [(i, j) for i, c in enumerate(columns) for j in range(sets.shape[1])
                 if owner[c] in (-1, j)]
        index, joint = (np.array(part, dtype=int) for part in zip(*pairs, strict=True))
        found = self._fitter.residuals(encode(sets[index, joint]), joint, weight[rows[index]])
        slopes = np.zeros((*points.shape, *base.shape[1:]))
        slopes[rows[index], columns[index], joint] = (found - base[rows[index], joint]) / \
            step[index, None]
        return slopes

    def solve(self, points, free, weight, iterations: int = 8) -> Solved:
        """
        Minimise each model's chi2.

        Args:
            points: (M, P) to start from.
            free: (M, P) which numbers are fitted.
            weight: (M, N) of the samples.
            iterations: at most.

        """
        points = np.clip(points, self.servos.low, self.servos.high)
        base = self.residuals(points, weight)
        chi2 = (base**2).sum(axis=(1, 2))
        damping, busy = np.full(len(points), 0.01), free.any(axis=1)
        for _ in range(iterations):
            rows = np.flatnonzero(busy)
            if not rows.size:
                break
            slopes = self.jacobian(points[rows], free[rows], weight[rows], base[rows])
            normal, slope = _normal(slopes, base[rows])
            tried = np.concatenate([self._move(points[rows], normal, slope, free[rows],
                                               damping[rows] * factor) for factor in (0.2, 20.0)])
            new = self.residuals(tried, np.tile(weight[rows], (2, 1)))
            cost = (new**2).sum(axis=(1, 2))
            second = cost[len(rows):] < cost[:len(rows)]
            choice = np.arange(len(rows)) + np.where(second, len(rows), 0)
            better = cost[choice] < chi2[rows]
            fall = (chi2[rows] - cost[choice]) / chi2[rows]
            taken, source = rows[better], choice[better]
            points[taken], base[taken], chi2[taken] = tried[source], new[source], cost[source]
            damping[rows] = np.clip(np.where(
                better, damping[rows] * np.where(second, 5.0, 0.2), damping[rows] * 50), 1e-6, 1e6)
            busy[rows] = np.where(better, fall > TOLERANCE, damping[rows] < 1e4)
        return Solved(points, chi2)

    def _move(self, points, normal, slope, free, damping):
        low, high = self.servos.low, self.servos.high
        stuck = ((points <= low + 1e-9) & (slope > 0)) | ((points >= high - 1e-9) & (slope < 0))
        move = free & ~stuck
        diagonal = np.arange(points.shape[1])
        matrix = normal.copy()
        size = np.maximum(matrix[:, diagonal, diagonal], 1e-6)
        matrix[:, diagonal, diagonal] = size * (1 + damping[:, None])
        matrix = np.where(move[:, :, None] & move[:, None, :], matrix, np.eye(points.shape[1]))
        step = -np.linalg.solve(matrix, np.where(move, slope, 0.0)[..., None])[..., 0]
        return np.clip(points + np.clip(step, -LONGEST, LONGEST), low, high)

    def information(self, point, free, weight) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Information (P, P) of one point, its slopes (P, J, N) and residuals (J, N)."""
        base = self.residuals(point[None], weight[None])
        slopes = self.jacobian(point[None], free[None], weight[None], base)
        return _normal(slopes, base)[0][0], slopes[0], base[0]


def _normal(slopes, base):
    flat = slopes.reshape(*slopes.shape[:2], -1)
    return flat @ flat.transpose(0, 2, 1), (flat @ base.reshape(len(base), -1, 1))[..., 0]
