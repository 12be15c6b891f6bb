"""Linear fits with robust weights, and intervals from the scatter between blocks."""

from collections.abc import Callable

import numpy as np
from scipy.stats import t as student

HUBER = 3.0                 # standard deviations from which the loss is linear
SIGMA_OF_MEDIAN = 1.4826    # standard deviation over the median of the size, normal distribution


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
    half = student.ppf(0.975, count - 1) * np.sqrt((count - 1) * every[1:].var())
    return every[0] + half * np.array([-1, 1])
