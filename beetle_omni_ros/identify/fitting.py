"""
Many small least-squares problems at once: Levenberg-Marquardt on simulated servos.

Residuals of a servo model are far from white: what the model misses lasts for tenths of seconds.
They are whitened by an autoregressive filter (generalised least squares), so that chi2 counts
independent pieces of information, and clipped (Huber) so that a bad sample cannot pull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz

from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.servo_model import NAMES, simulate, TERMS

MEMORY = 0.12       # [s] of the whitening filter
ORDERS = 6, 40      # its range in samples
HUBER = 3.0         # standard deviations from which a sample counts less
DIFFERENCE = 0.05   # of a parameter's scale, for derivatives
LARGEST_MOVE = 12.0  # of a parameter in one iteration, in scales
TOLERANCE = 1e-4    # relative fall of chi2 below which a problem is done

_LOGARITHMIC = np.array([term.logarithmic for term in TERMS.values()])
_SCALE = np.array([term.scale for term in TERMS.values()])


def encode(sets: np.ndarray) -> np.ndarray:
    """Parameter sets in units of their scales, logarithms where fitted so."""
    return np.where(_LOGARITHMIC, np.log(np.where(_LOGARITHMIC, sets, 1.0)), sets) / _SCALE


def decode(points: np.ndarray) -> np.ndarray:
    """Inverse of :func:`encode`."""
    values = points * _SCALE
    return np.where(_LOGARITHMIC, np.exp(np.where(_LOGARITHMIC, values, 0.0)), values)


LOW = encode(np.array([term.low for term in TERMS.values()]))
HIGH = encode(np.array([term.high for term in TERMS.values()]))


@dataclass(frozen=True)
class Noise:
    """
    What is left over, for each joint of a log.

    Attributes:
        filter: (n, order) autoregressive coefficients; zeros: white.
        sigma: (n,) standard deviation of the whitened residual [rad].

    """

    filter: np.ndarray
    sigma: np.ndarray

    def whiten(self, residual: np.ndarray, joint: np.ndarray) -> np.ndarray:
        """(B, N) residuals to unit variance; the first samples, without a past, become 0."""
        white = residual.copy()
        for lag in range(1, self.filter.shape[1] + 1):
            white[:, lag:] -= self.filter[joint, lag - 1, None] * residual[:, :-lag]
        white[:, :self.filter.shape[1]] = 0
        return white / self.sigma[joint, None]

    @classmethod
    def white(cls, joints: int, sigma: float = 1.0):
        """No memory."""
        return cls(np.zeros((joints, 1)), np.full(joints, sigma))

    @classmethod
    def of(cls, residual: np.ndarray, floor: float, period: float):
        """
        Estimate the noise.

        Args:
            residual: (n, N), one for each joint [rad].
            floor: below which no whitened residual of a quantised reading can be [rad].
            period: between samples [s].

        """
        order = int(np.clip(round(MEMORY / period), *ORDERS))
        filters, sigmas = [], []
        for row in residual:
            row = np.clip(row, *(np.median(row) + 6 * 1.4826 * np.median(
                np.abs(row - np.median(row))) * np.array([-1, 1]) + [-1e-9, 1e-9]))
            count = len(row)
            covariance = np.array([row[lag:] @ row[:count - lag]
                                   for lag in range(order + 1)]) / count
            covariance[0] = covariance[0] * (1 + 1e-6) + 1e-14
            filters.append(solve_toeplitz(covariance[:-1], covariance[1:]))
            sigmas.append(np.sqrt(max(covariance[0] - filters[-1] @ covariance[1:], floor**2)))
        return cls(np.array(filters), np.array(sigmas))


@dataclass(frozen=True)
class Problems:
    """
    Fits that run side by side.

    Attributes:
        joint: (B,) index of the log's joint.
        sets: (B, n) parameter sets to start from.
        free: (B, n) which numbers are fitted.
        weight: (B, N) weight of each sample, 0 where it is held out.

    """

    joint: np.ndarray
    sets: np.ndarray
    free: np.ndarray
    weight: np.ndarray

    def pick(self, rows) -> Problems:
        """Some of them."""
        return Problems(self.joint[rows], self.sets[rows], self.free[rows], self.weight[rows])

    @staticmethod
    def join(parts: list[Problems]) -> Problems:
        """All of them."""
        return Problems(*(np.concatenate([getattr(part, name) for part in parts])
                          for name in ('joint', 'sets', 'free', 'weight')))


@dataclass(frozen=True)
class Prior:
    """Gaussian belief in encoded parameters: centre (n,) and precision (n,), 0 where none."""

    centre: np.ndarray
    precision: np.ndarray

    @classmethod
    def none(cls):
        """No belief."""
        return cls(np.zeros(len(NAMES)), np.zeros(len(NAMES)))

    def cost(self, points: np.ndarray) -> np.ndarray:
        """(B,) part of chi2."""
        return ((points - self.centre)**2 * self.precision).sum(axis=1)


@dataclass(frozen=True)
class Fits:
    """
    Answers to :class:`Problems`.

    Attributes:
        sets: (B, n) fitted parameter sets.
        chi2: (B,) robust, whitened, with the prior's part.

    """

    sets: np.ndarray
    chi2: np.ndarray


class Fitter:
    """
    Solves :class:`Problems` on one log.

    Args:
        log: the measured data.
        noise: how residuals are whitened.
        prior: belief beside the data.

    """

    def __init__(self, log: JointLog, noise: Noise, prior: Prior):
        """Keep the three; see the class."""
        self.log, self.noise, self.prior = log, noise, prior

    def innovations(self, points: np.ndarray, joint: np.ndarray) -> np.ndarray:
        """(B, N) whitened residuals of encoded sets."""
        error = simulate(self.log, joint, decode(points)) - self.log.measured[joint]
        return self.noise.whiten(error, joint)

    def residuals(self, points, joint, weight) -> np.ndarray:
        """(B, N) weighted, whitened and clipped: their squares sum to Huber's cost."""
        white = self.innovations(points, joint)
        size = np.abs(white)
        clipped = np.sqrt(np.maximum(2 * HUBER * size - HUBER**2, 0)) * np.sign(white)
        return np.where(size > HUBER, clipped, white) * np.sqrt(weight)

    def jacobian(self, points, problems, base):
        """(B, n, N) derivatives of the residuals by differences; 0 where not free."""
        rows, columns = np.nonzero(problems.free)
        moved = points[rows].copy()
        step = np.where(moved[np.arange(len(rows)), columns] + DIFFERENCE > HIGH[columns],
                        -DIFFERENCE, DIFFERENCE)
        moved[np.arange(len(rows)), columns] += step
        slopes = np.zeros((*points.shape, base.shape[1]))
        slopes[rows, columns] = (self.residuals(moved, problems.joint[rows],
                                                problems.weight[rows])
                                 - base[rows]) / step[:, None]
        return slopes

    def solve(self, problems: Problems, iterations: int = 20) -> Fits:
        """Minimise the chi2 of each problem from its start, within the terms' bounds."""
        points = encode(problems.sets)
        points = np.where(problems.free, np.clip(points, LOW, HIGH), points)
        base = self.residuals(points, problems.joint, problems.weight)
        chi2 = (base**2).sum(axis=1) + self.prior.cost(points)
        damping, busy = np.full(len(chi2), 0.01), np.ones(len(chi2), dtype=bool)
        for _ in range(iterations):
            rows = np.flatnonzero(busy)
            if not rows.size:
                break
            some, here = problems.pick(rows), points[rows]
            normal, slope = self._normal(here, some, base[rows])
            tried = [_move(here, normal, slope, some.free, damping[rows] * factor)
                     for factor in (0.2, 5.0)]
            many = Problems.join([some, some])
            new = self.residuals(np.concatenate(tried), many.joint, many.weight)
            cost = (new**2).sum(axis=1) + self.prior.cost(np.concatenate(tried))
            second = cost[len(rows):] < cost[:len(rows)]
            choice = np.arange(len(rows)) + np.where(second, len(rows), 0)
            better = cost[choice] < chi2[rows]
            fall = (chi2[rows] - cost[choice]) / np.maximum(chi2[rows], 1e-12)
            accepted, source = rows[better], choice[better]
            points[accepted] = np.concatenate(tried)[source]
            base[accepted], chi2[accepted] = new[source], cost[source]
            damping[rows] = np.clip(np.where(
                better, damping[rows] * np.where(second, 3.0, 0.2), damping[rows] * 30), 1e-6, 1e6)
            busy[rows] = np.where(better, fall > TOLERANCE, damping[rows] < 1e4)
        return Fits(decode(points), chi2)

    def cost(self, problems: Problems) -> np.ndarray:
        """(B,) chi2 of parameter sets as they are, without the prior."""
        return (self.residuals(encode(problems.sets), problems.joint,
                               problems.weight)**2).sum(axis=1)

    def _normal(self, points, problems, base):
        slopes = self.jacobian(points, problems, base)
        normal = slopes @ slopes.transpose(0, 2, 1)
        diagonal = np.arange(len(NAMES))
        normal[:, diagonal, diagonal] += self.prior.precision
        slope = (slopes @ base[..., None])[..., 0] + self.prior.precision * (
            points - self.prior.centre)
        return normal, slope

    def information(self, problems: Problems) -> np.ndarray:
        """(B, n, n) Gauss-Newton information of encoded sets, without the prior."""
        points = encode(problems.sets)
        slopes = self.jacobian(points, problems, self.residuals(points, problems.joint,
                                                                problems.weight))
        return slopes @ slopes.transpose(0, 2, 1)


def _move(points, normal, slope, free, damping):
    """Damped Newton step inside the bounds; parameters that push outwards stay."""
    stuck = ((points <= LOW + 1e-9) & (slope > 0)) | ((points >= HIGH - 1e-9) & (slope < 0))
    move = free & ~stuck
    diagonal = np.arange(points.shape[1])
    matrix = normal.copy()
    scale = np.maximum(matrix[:, diagonal, diagonal], 1e-6)
    matrix[:, diagonal, diagonal] = scale * (1 + damping[:, None])
    matrix = np.where(move[:, :, None] & move[:, None, :], matrix, np.eye(points.shape[1]))
    step = -np.linalg.solve(matrix, np.where(move, slope, 0.0)[..., None])[..., 0]
    wanted = points + np.clip(step, -LARGEST_MOVE, LARGEST_MOVE)
    return np.where(free, np.clip(wanted, LOW, HIGH), points)

