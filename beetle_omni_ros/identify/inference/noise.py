"""Coloured noise: autoregressions of residuals, and whitening filters."""


import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

JITTER = 1e-6       # relative increase of the variance, for series without noise


def autoregression(series: list[np.ndarray], order: int,
                   quantum: float = 0.0) -> tuple[np.ndarray, float]:
    """
    Fit one autoregression to several series (Yule-Walker equations).

    Args:
        series: series (N,) of the same process.
        order: number of coefficients.
        quantum: standard deviation of rounding, added to the series.

    Returns:
        prediction-error filter (order + 1,), first entry 1; standard deviation of its error.

    """
    count = sum(len(x) for x in series)
    correlation = np.array([sum(x[lag:] @ x[:len(x) - lag] for x in series)
                            for lag in range(order + 1)]) / max(count, 1)
    correlation[0] = correlation[0] * (1.0 + JITTER) + quantum**2
    if correlation[0] < 1e-20:
        return np.eye(1, order + 1)[0], 1e-10
    taps = np.concatenate([[1.0], -solve_toeplitz(correlation[:-1], correlation[1:])])
    return taps, float(np.sqrt(max(float(taps @ correlation), 1e-20)))


def whitened(series: np.ndarray, taps: np.ndarray, sigma: float) -> np.ndarray:
    """Series filtered to unit variance along the first axis, without the first samples."""
    return lfilter(taps, 1.0, series, axis=0)[len(taps) - 1:] / sigma


def gain(taps: np.ndarray) -> float:
    """Variance of the coloured series for an innovation of unit variance."""
    # Mean over the whole circle; over a half circle, the zero frequency would count twice.
    response = np.fft.fft(taps, 4096)
    return float(np.mean(1 / np.maximum(np.abs(response)**2, 1e-9)))
