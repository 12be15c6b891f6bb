"""Coloured noise: autoregressions of residuals, and whitening filters."""

from itertools import product

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

JITTER = 1e-6       # relative increase of the variance, for series without noise
LEVELS = 10.0 ** np.arange(0, 5)    # tried variances of a drift
CORNERS = (0.5, 2.0, 8.0)           # tried


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
