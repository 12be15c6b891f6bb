"""Gusts: a coloured wrench that the controller has to fight."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter


def draw_gust(settings: dict, duration: float, step: float,
              rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """
    Force in world and torque in base_link, (N, 3) each, one row a step.

    A second-order (Dryden-like) colouring: white noise through two equal lags.
    """
    count = int(round(duration / step)) + 1
    return (_coloured(count, step, rng.uniform(*settings['time']),
                      rng.uniform(*settings['force']), rng),
            _coloured(count, step, rng.uniform(*settings['time']),
                      rng.uniform(*settings['torque']), rng))


def _coloured(count, step, time, rms, rng):
    pole = np.exp(-step / (0.5 * time))
    white = rng.standard_normal((count + 4000, 3))
    wave = lfilter([1.0], [1.0, -2 * pole, pole * pole], white, axis=0)[4000:]
    # the filter's stationary deviation, not the sample's, so that seeds differ in strength
    gain = np.sqrt((1 + pole ** 2) / (1 - pole ** 2) ** 3)
    return rms / gain * wave
