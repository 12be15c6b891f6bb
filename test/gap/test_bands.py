"""Closed-loop bias by gusts differs between slow and fast motion; a parameter does not."""

from itertools import product
from types import SimpleNamespace

from flights import P
import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

from beetle_omni_ros.identify.gap.bands import (
    differs_between_bands,
    gain_by_part,
)
from beetle_omni_ros.identify.gap.residual import THIN
from beetle_omni_ros.identify.inference.noise import autoregression

BODY, OTHERS = 6, 10        # channels of the body's equations come first
PERIOD = THIN * P.grid * P.body_every
LENGTH = 900
CHANNELS = BODY + OTHERS


def problem(flights=2):
    """Channel and flight of the samples of a fit."""
    where = np.repeat(np.arange(CHANNELS), LENGTH)
    return SimpleNamespace(p=P, priors={}, where=np.tile(where, flights),
                           flight=np.repeat(np.arange(flights), len(where)))


def flown(seed, gusts, wanted):
    """
    Angular acceleration of one axis and residual of a valid model, of a robot in gusts.

    As in flights without effects: below 1 Hz the commands compensate the gust, and the motion
    opposes it. Above, sensor noise moves the robot through its controller, without a gust.

    Args:
        seed: seed of all random numbers.
        gusts: RMS [rad/s^2].
        wanted: RMS of the planned motion [rad/s^2].

    """
    rng = np.random.default_rng(seed)
    slow = butter(3, 0.8, fs=1 / PERIOD, output='sos')
    quick = butter(3, 1.5, 'high', fs=1 / PERIOD, output='sos')
    gust = sosfilt(slow, rng.standard_normal(LENGTH))
    gust *= gusts / gust.std()
    jitter = 0.2 * sosfilt(quick, rng.standard_normal(LENGTH))
    planned = np.convolve(rng.standard_normal(LENGTH), np.hanning(9), 'same')
    planned *= wanted / planned.std()
    return planned + jitter - gust, gust + 0.2 * np.gradient(rng.standard_normal(LENGTH))


@pytest.mark.parametrize('gusts, wanted, true, passes', [
    (0.3, 0.0, 0.0, False),      # closed-loop bias: gusts look like an inertia
    (0.3, 0.2, 0.0, False),
    (0.0, 0.5, 0.3, True),       # a true change of inertia
    (0.1, 0.5, 0.3, True)])
def test_closed_loop_bias_is_separated_from_an_inertia(gusts, wanted, true, passes):
    p = problem(3)
    x, r = np.zeros((len(p.where), 1)), np.zeros(len(p.where))
    for flight, c in product(range(3), range(3, BODY)):
        rows = (p.flight == flight) & (p.where == c)
        acceleration, rest = flown(10 * flight + c, max(gusts, 1e-6), wanted)
        taps, sigma = autoregression([rest], P.body_order)
        x[rows, 0] = lfilter(taps, 1, acceleration) / sigma
        r[rows] = lfilter(taps, 1, rest - true * acceleration) / sigma
    assert gain_by_part(p, x, r)[0] > P.least_gain
    assert differs_between_bands(p, x, r) != passes
