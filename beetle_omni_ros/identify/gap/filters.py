"""Zero-phase low-pass filters that keep every n-th sample."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.signal import firwin, upfirdn

from beetle_omni_ros.identify.gap.parameters import GapParameters

SHARPNESS = 5.0     # taps for each sampling rate over edge
THIN = 2            # grid points to each at which the body's equations are evaluated
EDGE = 1.0              # [s] at both ends that smoothing and history need
LEAST_SAMPLES = 20  # of each channel, from which the autoregression of its noise is estimated


@dataclass(frozen=True)
class LowPass:
    """
    A symmetric filter.

    Attributes:
        taps: (L,) of the filter.
        every: how many samples to each that is kept.
        period: between samples [s].

    """

    taps: np.ndarray
    every: int
    period: float

    @property
    def margin(self) -> int:
        """Samples lost at each end."""
        return (len(self.taps) - 1) // 2

    def __call__(self, x: np.ndarray, derivative: int = 0) -> np.ndarray:
        """
        Filter along the first axis.

        Args:
            x: (N, ...) samples.
            derivative: 0, 1 or 2, in time.

        Returns:
            (M, ...) samples at ``centres(N)``.

        """
        taps = _derived(tuple(self.taps), derivative) / self.period**derivative
        shape = x.shape
        y = upfirdn(taps, x.reshape(shape[0], -1), 1, self.every, axis=0)
        first = (len(taps) - 1) // self.every
        last = (shape[0] - 1) // self.every
        return y[first:last + 1].reshape(-1, *shape[1:])

    def centres(self, count: int) -> np.ndarray:
        """Indices of the samples that a series of this length keeps."""
        taps = len(self.taps) - 1
        last = (count - 1) // self.every
        return self.every * np.arange(taps // self.every, last + 1) - taps // 2


@cache
def _derived(taps, order):
    taps = np.array(taps)
    if order == 1:
        padded = np.pad(taps, 1)
        return ((padded[2:] - padded[:-2]) / 2)
    if order == 2:
        padded = np.pad(taps, 1)
        return padded[2:] - 2 * padded[1:-1] + padded[:-2]
    return taps


@cache
def low_pass(edge: float, every: int, period: float) -> LowPass:
    """Filter with the edge [Hz]; length and ``every`` are made to fit."""
    length = SHARPNESS / (edge * period)
    step = every * (1 if every % 2 == 0 else 2)
    count = step * max(1, round(length / step)) + 1
    # Hann: end taps are zero, so that derivatives of the taps are complete
    return LowPass(firwin(count, edge, window='hann', fs=1 / period), every, period)


def channel_filters(p: GapParameters) -> dict[str, LowPass]:
    """Group of channels -> its filter."""
    return {'B': low_pass(p.body_edge, p.body_every, THIN * p.grid),
            'A': low_pass(p.world_edge, p.world_every, p.grid),
            'W': low_pass(p.rate_edge, p.rate_every, p.grid),
            'J': low_pass(p.joint_edge, p.joint_every, p.grid)}


def shortest_flight(p: GapParameters) -> float:
    """Duration [s] below which some channel keeps fewer than ``LEAST_SAMPLES`` samples."""
    return 2 * EDGE + max(kernel.period * (len(kernel.taps) + LEAST_SAMPLES * kernel.every)
                          for kernel in channel_filters(p).values())
