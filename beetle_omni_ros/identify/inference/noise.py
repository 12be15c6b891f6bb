"""Robust linear fits, intervals from the scatter of blocks, and drift beside a fit."""

from collections.abc import Callable
from functools import lru_cache
from itertools import product
from math import exp, inf, log, log1p, pi

import numpy as np
from scipy.special import log_ndtr, ndtri, stdtrit

HUBER = 3.0                 # standard deviations from which the loss is linear
SIGMA_OF_MEDIAN = 1.4826    # standard deviation over the median of the size, normal distribution
LEVELS = 10.0 ** np.arange(0, 5)    # tried variances of a drift
CORNERS = (0.5, 2.0, 8.0)           # tried
ROUNDED = 1e-9              # share of the largest eigenvalue below which one is rounding


def huber(white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals whose sum of squares is Huber's loss, and their derivative."""
    size = np.abs(white)
    far = size > HUBER
    root = np.sqrt(np.maximum(2 * HUBER * size - HUBER**2, HUBER**2))
    return np.where(far, root * np.sign(white), white), np.where(far, HUBER / root, 1.0)


def scale_of(residual: np.ndarray) -> float:
    """Standard deviation of residuals without their outliers."""
    return float(SIGMA_OF_MEDIAN * np.median(np.abs(residual)) + 1e-12)


def linear(x: np.ndarray, y: np.ndarray, passes: int = 8) -> np.ndarray:
    """(K,) coefficients of y (n,) on x (n, K) with Huber's loss; the noise is the residuals'."""
    root = np.ones(len(y))
    for _ in range(passes):
        fitted = np.linalg.lstsq(x * root[:, None], y * root, rcond=None)[0]
        residual = y - x @ fitted
        white = residual / scale_of(residual)
        own, ratio = huber(white)
        root = np.sqrt(np.divide(own * ratio, white, out=np.ones(len(y)), where=white != 0))
    return fitted


def consecutive(changes: np.ndarray, most: int) -> np.ndarray:
    """Block of each row (n,): stretches between changes, joined to at most ``most`` blocks."""
    stretch = np.cumsum(changes) - changes[0]
    count = stretch[-1] + 1
    return stretch * min(count, most) // count


def jackknife(fit: Callable[[np.ndarray], np.ndarray], blocks: np.ndarray) -> np.ndarray:
    """(1 + B, ...) results of ``fit`` for a mask of all rows, then without each of B blocks."""
    return np.array([fit(np.ones(len(blocks), dtype=bool)),
                     *(fit(blocks != block) for block in np.unique(blocks))])


def interval(every: np.ndarray) -> np.ndarray:
    """95 % interval (2,) of a value from the results (1 + B,) of :func:`jackknife`."""
    count = len(every) - 1
    half = stdtrit(count - 1, 0.975) * np.sqrt((count - 1) * every[1:].var())
    return every[0] + half * np.array([-1, 1])


class Drifting:
    """
    White noise of unit variance with a drift, in the slowest cosines of a recording.

    The drift is slower than the motion, so that a zero has its noise and a gain has not.

    Args:
        count: samples of the recording.
        slowest: cosines of the drift, beside the constant.
        level: variance of the drift at frequency 0, over that of the white noise.
        corner: half periods in the recording from which the variance falls, as of a process of
            first order.

    """

    def __init__(self, count: int, slowest: int = 0, level: float = 0.0, corner: float = 1.0):
        order = np.arange(slowest + 1)
        variance = 1 + level / (1 + (order / corner)**2)
        self._waves = np.cos(np.pi * order * (np.arange(count) + 0.5)[:, None] / count)
        self._waves /= np.linalg.norm(self._waves, axis=0)
        self._less = 1 - 1 / np.sqrt(variance)
        self.log_determinant = float(np.log(variance).sum())

    def whitened(self, series: np.ndarray) -> np.ndarray:
        """Independent samples of unit variance from series (n, ...)."""
        flat = series.reshape(len(series), -1)
        return (flat - self._waves @ (self._less[:, None] * (self._waves.T @ flat))
                ).reshape(series.shape)


def drifting(residuals: list[np.ndarray], signals: list[np.ndarray], slowest: int
             ) -> tuple[Drifting, np.ndarray]:
    """
    Noise with the most likely drift for the channels of a recording, besides fitted parameters.

    A fit absorbs drift, as a zero does the mean. The likelihood is therefore that of data with
    the prior variance of the fitted parameters (Harville 1977).

    Args:
        residuals: U residuals (n,) at the prior mean of the parameters.
        signals: U derivatives (n, X) by parameters with standard normal priors.
        slowest: cosines that are slower than the motion; 0: a drift is not observable.

    Returns:
        noise of all channels, and (U,) standard deviations of their white noise.

    """
    best: tuple = (-np.inf,)
    for level, corner in [(0.0, 1.0), *product(LEVELS, CORNERS)][:None if slowest else 1]:
        noise, value, scales = Drifting(len(residuals[0]), slowest, level, corner), 0.0, []
        for residual, signal in zip(residuals, signals, strict=True):
            white = noise.whitened(np.column_stack([residual, signal]))
            r, a = white[:, 0], white[:, 1:]
            own, score = a.T @ a, a.T @ r
            variance = r @ r / len(r)
            for _ in range(3):      # fixed point of the variance
                h = own / variance + np.eye(a.shape[1])
                solution = np.linalg.solve(h, score / variance)
                rest = r - a @ solution
                variance = rest @ rest / (len(r) - a.shape[1] + np.trace(np.linalg.inv(h)))
            value -= (len(r) * np.log(variance) + noise.log_determinant
                      + np.linalg.slogdet(h)[1] + (r @ r - score @ solution) / variance) / 2
            scales.append(np.sqrt(variance))
        if value > best[0]:
            best = value, noise, np.array(scales)
    return best[1], best[2]


def few_blocks(level: float, blocks: int) -> float:
    """Factor of a variance because the scatter of few blocks is uncertain: Student's t."""
    return float((stdtrit(max(blocks - 1, 1), level / 2) / ndtri(level / 2))**2)


@lru_cache(100_000)      # the same priors end at the same bounds in most sets
def within_limits(low: float, high: float) -> tuple[float, float, float]:
    """Ln of the probability that a standard normal is between limits; its mean, variance there."""
    if low + high > 0:
        chance, mean, variance = within_limits(-high, -low)
        return chance, -mean, variance
    upper = float(log_ndtr(high))
    less = float(log_ndtr(low)) - upper if low > -inf else -inf
    chance = upper + log1p(-exp(min(less, -1e-12)))
    mean = edge = 0.0
    for sign, x in ((1, low), (-1, high)):
        if abs(x) < inf:
            density = sign * exp(-0.5 * x * x - 0.5 * log(2 * pi) - chance)
            mean += density
            edge += x * density
    return chance, mean, min(max(1 + edge - mean * mean, 1e-6), 1.0)


def positive(matrix: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, ...]:
    """
    Root R, its inverse, and R R' of a symmetric matrix (d, d), without directions of no size.

    ``size`` (d,) makes the units equal: eigenvalues of size matrix size are at least ROUNDED.
    """
    values, vectors = np.linalg.eigh(0.5 * size[:, None] * (matrix + matrix.T) * size)
    values = np.maximum(values, ROUNDED * max(values.max(), 1.0))
    root = vectors * values**0.5 / size[:, None]
    return root, (vectors * values**-0.5).T * size, root @ root.T
