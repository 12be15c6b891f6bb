"""
On-line estimates of the additional delay with which commands act, and of what is noise.

If commands act tau later than a model assumes, it predicts the acceleration a(t) where the robot
has a(t - tau). To first order its error is e = -tau da/dt. Weighted least squares of e on -da/dt,
with forgetting and a zero-mean prior, gives tau: a Gauss-Newton step, because the model then has
the estimated delay. A sensor that is late by tau, or a lag that is longer, gives the same error
and needs the same prediction.
"""

from math import exp

import numpy as np

from beetle_omni_ros.model.allocation import clipped

MEMORY = 10.0       # [s] time constant of the forgetting
NOISE_MEMORY = 2.0  # [s] of the variance of the errors
PRIOR = 0.01        # [s] standard deviation of the delay before any motion
CORRELATED = 0.5    # [s] within which errors are not independent: half a period of the loop
RATE = 0.02         # [s/s] largest change of the estimate: slow against the loop
TINY = 1e-12        # of a variance before any error
OUTLIER = 3.0       # [1] standard deviations to which an error is clipped, as at a contact


class LatencyEstimator:
    """
    Estimates the delay from what a model predicts, and its errors.

    Args:
        largest: bound of the estimate [s]; the smallest is 0.
        bandwidth: below which other estimates remove the errors of the model [rad/s].
        noise: (n,) initial standard deviation of the errors.

    Attributes:
        latency: estimate [s].

    """

    def __init__(self, largest: float, bandwidth: float, noise: np.ndarray):
        self._largest, self._bandwidth, self._noise = largest, bandwidth, noise
        self.reset()

    def reset(self) -> None:
        """Forget the flight."""
        self.latency = 0.0
        self._information = self._sum = 0.0
        self._variance, self._slow = self._noise ** 2, np.zeros_like(self._noise)
        self.pause()

    def pause(self) -> None:
        """Keep the estimate over a gap between two steps."""
        self._before: np.ndarray | None = None

    def observe(self, predicted: np.ndarray, error: np.ndarray, step: float) -> None:
        """
        Update with one step.

        Args:
            predicted: (n,) what a late command or sensor delays.
            error: (n,) measured less predicted.
            step: its duration [s].

        """
        before, self._before = self._before, predicted
        if before is None:
            return
        slope = (before - predicted) / step
        self._slow += min(self._bandwidth * step, 1.0) * (slope - self._slow)
        slope -= self._slow
        limit = OUTLIER * np.sqrt(self._variance)
        error = clipped(error, -limit, limit)
        weighted = slope / self._variance
        self._variance += min(step / NOISE_MEMORY, 1.0) * (error * error - self._variance)
        kept, information = exp(-step / MEMORY), float(weighted @ slope)
        self._information = kept * self._information + information
        self._sum = kept * self._sum + float(weighted @ error) + self.latency * information
        goal = self._sum / (self._information + CORRELATED / step / PRIOR ** 2)
        change = min(max(goal, 0.0), self._largest) - self.latency
        self.latency += min(max(change, -RATE * step), RATE * step)


class NoiseFilter:
    """
    Removes the noise from the errors of a prediction.

    Noise is what an error has not in common with the next one. The share that is kept is the
    correlation of both, as all innovations of a Kalman filter with the right gain are white
    (Mehra, On the identification of variances and adaptive Kalman filtering, 1970).

    Args:
        least: (n,) smallest share that is kept.

    """

    def __init__(self, least: np.ndarray):
        self._least = least
        self.reset()

    def reset(self) -> None:
        """Forget the flight: an error has no noise."""
        self._before = np.zeros_like(self._least)
        self._variance = self._common = np.full_like(self._least, TINY)

    def without(self, error: np.ndarray, step: float) -> np.ndarray:
        """(n,) error without the noise, of which no more than OUTLIER deviations is removed."""
        share = min(step / NOISE_MEMORY, 1.0)
        self._variance = self._variance + share * (error * error - self._variance)
        self._common = self._common + share * (error * self._before - self._common)
        self._before = error
        limit = OUTLIER * np.sqrt(np.maximum(self._variance - self._common, 0.0))
        kept = clipped(self._common / self._variance, self._least, 1.0)
        return error - clipped((1.0 - kept) * error, -limit, limit)
