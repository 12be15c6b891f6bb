"""Slow and quick motion: a number of the robot is the same in both, an answer to a gust is not."""

from itertools import product
from types import SimpleNamespace

from flights import P
import numpy as np
import pytest
from scipy.signal import lfilter

from beetle_omni_ros.identify.gap.bands import aside, disagreement
from beetle_omni_ros.identify.gap.noise import _autoregression
from beetle_omni_ros.identify.gap.residual import THIN

BODY, OTHERS = 6, 10        # channels of the body's equations come first
PERIOD = THIN * P.grid * P.body_every
LENGTH = 900
CHANNELS = BODY + OTHERS


def problem(flights=2):
    """What a fit says of its samples, all flights' channels in a row."""
    where = np.repeat(np.arange(CHANNELS), LENGTH)
    return SimpleNamespace(p=P, beliefs={}, where=np.tile(where, flights),
                           flight=np.repeat(np.arange(flights), len(where)))


def noise(count, seed):
    return np.random.default_rng(seed).standard_normal(count)


def fitted(x, y):
    """What is left of ``y`` beside the best part of ``x``."""
    return y - x @ np.linalg.lstsq(x, y, rcond=None)[0]


def answered(seed, gusts, motion, gain=8.5, stiff=26.0, gyroscope=0.02):
    """
    One axis that is held against gusts, by a controller that believes its sensors.

    Args:
        gusts: rms of angular acceleration.
        motion: of the wanted one.

    Returns:
        true acceleration, gust, and what the gyroscope's noise makes of acceleration.

    """
    rng, slow = np.random.default_rng(seed), np.exp(-PERIOD / 0.5)
    push = gusts * np.sqrt(1 - slow**2) * lfilter([1], [1, -slow], rng.standard_normal(LENGTH))
    wanted = motion * np.convolve(rng.standard_normal(LENGTH), np.hanning(9) / 2, 'same')
    read = gyroscope * rng.standard_normal(LENGTH)
    off = rate = 0.0
    made = []
    for k in range(LENGTH):
        acceleration = push[k] - stiff * off - gain * (rate + read[k])
        made.append(acceleration)
        rate += PERIOD * acceleration
        off += PERIOD * rate
    return np.array(made) + wanted, push, np.gradient(read, PERIOD)


def test_the_same_number_everywhere_leaves_nothing_to_disagree_about():
    p = problem()
    x = noise(3 * len(p.where), 1).reshape(-1, 3)
    apart, count = disagreement(p, x, fitted(x, x @ [3.0, -1.0, 0.5] + noise(len(p.where), 2)))
    assert count == 12
    assert apart < 2.5 * count


def test_a_number_that_is_there_in_slow_motion_only_is_seen():
    p = problem()
    x = noise(len(p.where), 1)[:, None]
    slow = lfilter([0.05], [1, -0.95], x[:, 0])
    apart, count = disagreement(p, x, fitted(x, 2.0 * slow + noise(len(p.where), 2)))
    assert count == 4
    assert apart > 10 * count


def test_channels_of_sensors_and_joints_do_not_count():
    p = problem()
    x, r = noise(len(p.where), 1)[:, None], noise(len(p.where), 2)
    other = np.where(p.where < BODY, r, 100 * r)
    assert disagreement(p, x, r) == pytest.approx(disagreement(p, x, other))


def test_bands_together_hold_all_that_is_in_time():
    p = problem(1)
    x, r = noise(len(p.where), 1)[:, None], noise(len(p.where), 2)
    inside = p.where < BODY
    whole = (x[inside, 0] @ r[inside])**2 / (x[inside, 0] @ x[inside, 0])
    apart, _ = disagreement(p, x, r)
    rest = r - x[:, 0] * (x[inside, 0] @ r[inside]) / (x[inside, 0] @ x[inside, 0])
    assert apart == pytest.approx(whole + disagreement(p, x, rest)[0])


@pytest.mark.parametrize('gusts, motion, true, passes', [
    (0.4, 0.0, 0.0, False),      # gusts that are fought look like an inertia
    (0.4, 0.3, 0.0, False),
    (0.1, 1.0, 0.2, True),       # an inertia that is there
    (0.4, 1.0, 0.2, True)])
def test_answers_to_gusts_are_told_from_an_inertia(gusts, motion, true, passes):
    p = problem(3)
    x, r = np.zeros((len(p.where), 1)), np.zeros(len(p.where))
    for flight, c in product(range(3), range(3, BODY)):
        rows = (p.flight == flight) & (p.where == c)
        acceleration, push, read = answered(10 * flight + c, gusts, motion)
        taps, sigma = _autoregression([push + read], P.body_order)
        x[rows, 0] = lfilter(taps, 1, acceleration) / sigma
        r[rows] = lfilter(taps, 1, push - true * acceleration + read) / sigma
    rest = fitted(x, r)
    gain = r @ r - rest @ rest
    apart, count = disagreement(p, x, rest)
    assert gain > P.least_gain
    assert (apart < P.bands_free * count + P.bands_share * gain) == passes


def test_what_others_could_take_over_is_no_evidence():
    p = problem()
    known = noise(len(p.where), 1)
    own = noise(len(p.where), 2)
    state = SimpleNamespace(slopes=np.stack([known, own + 2 * known], axis=1), theta={},
                            r=own + 3 * known, index={'known': 0, 'own': 1})
    slopes, rest = aside(p, state, ['known'], state.slopes[:, 1:], frozenset())
    np.testing.assert_allclose(slopes.T @ known, 0, atol=1e-3)
    np.testing.assert_allclose(rest @ known, 0, atol=1e-3)
    np.testing.assert_allclose(rest, slopes[:, 0], atol=1e-6)
