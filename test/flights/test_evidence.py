"""Evidence and noise of the flight engine against dense algebra, quadrature and drawn numbers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.evidence import Judge, normal
from beetle_omni_ros.identify.flights.keys import Entry
from beetle_omni_ros.identify.flights.spectrum import EDGES, spectrum


def linear_flight(rng, theta, count=3200, period=0.01, keys=3):
    """Spectrum of white noise of deviation 0.1 and a linear model with known keys."""
    slopes = rng.normal(size=(count, 2, keys))
    residual = -slopes @ theta + 0.1 * rng.normal(size=(count, 2))
    found = spectrum(residual, slopes, np.ones((count, 2), dtype=bool), period,
                     np.full(2, 1e-6), np.inf, [np.arange(2)])
    found.noise[:] = 0.01 * np.eye(2)
    return found


def test_deviations_of_flights_are_eliminated_as_in_the_dense_problem():
    rng = np.random.default_rng(1)
    spectra = [linear_flight(rng, np.array([0.2, 0.0, -0.1]) + shift) for shift in (0.0, 0.05)]
    flight = np.array([0.0, 0.03, 0.1])
    found = normal(spectra, ['a', 'b', 'c'], flight)
    grams = [[part.sum(axis=(0, 1)) for part in s.grams()] for s in spectra]
    own = [1, 2]
    dense = np.zeros((7, 7))
    right = np.zeros(7)
    for k, (g, h) in enumerate(grams):
        at = [0, 1, 2, 3 + 2 * k, 4 + 2 * k]
        which = [0, 1, 2, *own]
        dense[np.ix_(at, at)] += g[np.ix_(which, which)]
        right[at] += h[which]
    dense[range(3, 7), range(3, 7)] += np.tile(flight[own]**-2, 2)
    assert np.allclose(np.linalg.solve(found.info, found.right), np.linalg.solve(dense, right)[:3])
    theta = np.linalg.solve(dense, right)
    assert np.allclose(found.of_flight(1, theta[:3])[own], theta[5:])
    # scores of the blocks vanish in sum at the solution
    assert np.allclose((found.scores - found.slopes @ theta[:3]).sum(axis=0), 0, atol=1e-6)


@pytest.mark.parametrize('positive', [False, True])
def test_evidence_of_one_key_agrees_with_quadrature(positive):
    rng = np.random.default_rng(2)
    found = normal([linear_flight(rng, np.array([0.004]), keys=1)], ['a'], np.zeros(1))
    narrow, typical = np.array([0.001]), np.array([0.02])
    bounds = np.array([[0.0 if positive else -np.inf, np.inf]])
    judge = Judge(found, narrow, typical, bounds, np.array([False]), np.zeros(1, dtype=int), 0.05,
                  np.array([False]), np.zeros(1))      # no mixture of widths
    info, estimate = found.info[0, 0], found.right[0] / found.info[0, 0]
    posterior = judge.posterior((0,))
    slab = np.hypot(narrow[0], typical[0])
    sigma = judge._profile((0,))[2][0, 0]**0.5       # widened by the blocks
    assert sigma >= info**-0.5 * (1 - 1e-9)
    low, factor = (0.0, 2.0) if positive else (-0.5, 1.0)

    def integral(width):
        return quad(lambda x: factor * norm.pdf(x, 0, width) * norm.pdf(estimate, x, sigma), low,
                    0.5, points=[0, estimate], limit=200)[0]
    assert posterior.gain == pytest.approx(
        np.log(integral(slab)) - np.log(integral(narrow[0])), abs=1e-3)


def test_a_tolerance_with_limits_agrees_with_quadrature():
    rng = np.random.default_rng(5)
    found = normal([linear_flight(rng, np.array([0.0016]), keys=1)], ['a'], np.zeros(1))
    narrow, low, high = 0.002, -0.002, 0.001
    judge = Judge(found, np.array([narrow]), np.array([0.02]), np.array([[low, high]]),
                  np.array([True]), np.zeros(1, dtype=int), 0.05, np.array([False]), np.zeros(1))
    estimate, sigma = judge._profile((0,))[1][0], judge._profile((0,))[2][0, 0]**0.5
    inside = quad(lambda x: norm.pdf(x, 0, narrow) * norm.pdf(estimate, x, sigma), low, high)[0] \
        / (norm.cdf(high, 0, narrow) - norm.cdf(low, 0, narrow))
    wide = np.hypot(narrow, 0.02)       # only the lower limit is physical
    free = quad(lambda x: norm.pdf(x, 0, wide) * norm.pdf(estimate, x, sigma), low, 0.2,
                points=[0, estimate], limit=200)[0] / norm.sf(low, 0, wide)
    assert judge.gain((0,), ()) == pytest.approx(np.log(free / inside), abs=1e-3)
    assert judge.posterior(()).theta[0] < high + 3 * sigma


def test_a_delay_far_beyond_its_tolerance_has_one_value_in_all_bands():
    engine, true = object.__new__(Engine), np.array([0.017])
    vars(engine).update(
        names=['delay'], entries=[Entry('delay', ('delay',))], index={'delay': 0}, known=1,
        narrow=np.array([0.0025]), typical=np.array([0.01]), flight=np.zeros(1), late={},
        bounds=np.array([[0.0, 0.004]]), kept=np.array([True]), owner=np.zeros(1, dtype=int),
        far=np.array([False]), acting=np.array([False]), curved=np.array([False]), alpha=0.05)
    found = SimpleNamespace(best=(0,), theta=true, unsteady={}, spectra=[
        linear_flight(np.random.default_rng(4), true, keys=1)])
    engine._constancy(found, {})
    assert found.unsteady[0] < 0        # one value in each group of bands explains no more


@pytest.mark.parametrize(('change', 'constant'), [(0.2, True), (-1.5, False)])
def test_the_value_of_a_start_that_acts_may_have_an_error_of_form(change, constant):
    engine, count, slopes = object.__new__(Engine), 16000, np.random.default_rng(5).normal(
        size=(16000, 2, 2))
    vars(engine).update(
        names=['start', 'tangent'], entries=[Entry('play', ('start', 'tangent'))],
        index={'start': 0, 'tangent': 1}, known=2, narrow=np.full(2, 1e-3), late={},
        typical=np.array([1.0, 0.3]), flight=np.zeros(2),
        bounds=np.full((2, 2), [-np.inf, np.inf]),
        kept=np.zeros(2, dtype=bool), owner=np.zeros(2, dtype=int), far=np.zeros(2, dtype=bool),
        acting=np.array([True, False]), curved=np.ones(2, dtype=bool), alpha=0.05)
    slow = np.fft.rfft(slopes[..., 1], axis=0)
    slow[np.fft.rfftfreq(count, 0.01) > 2.0] = 0.0
    # the value is another by this share above 2 Hz
    effect = slopes[..., 0] + change * (slopes[..., 1] - np.fft.irfft(slow, axis=0))
    noise = 0.3 * np.random.default_rng(6).normal(size=effect.shape)
    found = spectrum(noise - effect, slopes, np.ones(effect.shape, dtype=bool), 0.01,
                     np.full(2, 1e-6), np.inf, [np.arange(2)])
    found.noise[:] = 0.09 * np.eye(2)
    solution = SimpleNamespace(best=(0,), theta=np.array([1.0, 0.0]), unsteady={},
                               spectra=[found])
    engine._constancy(solution, {})
    assert (solution.unsteady[0] < 0) == constant


def test_bounds_of_keys_that_are_nearly_the_same_leave_a_finite_evidence():
    rng, own = np.random.default_rng(0), np.ones(3, dtype=bool)
    judge = Judge(normal([linear_flight(rng, np.zeros(3))], ['a', 'b', 'c'], np.zeros(3)),
                  np.full(3, 0.001), np.full(3, 0.02), np.tile([0.0, np.inf], (3, 1)), ~own,
                  np.zeros(3, dtype=int), 0.05, ~own, np.zeros(3))
    for _ in range(500):
        slope = rng.normal(size=(3, 1)) * 10**rng.uniform(-2, 2)
        wide = slope @ slope.T + np.eye(3) * 100**rng.uniform(-9, -3)
        prior, estimate = 10**rng.uniform(-1, 3, 3), slope[:, 0] - rng.uniform(0, 10)
        value, mean, covariance = judge._bounded(np.arange(3), estimate, wide, prior, own)
        assert np.isfinite([value, *mean, *covariance.ravel()]).all()


def test_noise_that_rounding_makes_negative_does_not_widen_what_is_known():
    found, never = normal([linear_flight(np.random.default_rng(6), np.zeros(2), keys=2)],
                          ['a', 'b'], np.zeros(2)), np.zeros(2, dtype=bool)
    found.noise[1] = found.noise[:, 1] = 0.0
    found.noise[1, 1] = -1e-14
    judge = Judge(found, np.full(2, 0.001), np.full(2, 0.02), np.full((2, 2), [-np.inf, np.inf]),
                  never, np.arange(2), 0.05, never, np.zeros(2))
    assert judge.posterior((0, 1)).covariance.diagonal() == pytest.approx([0.0, 0.0], abs=0.02**2)


@pytest.mark.parametrize('unit', [1e-6, 1e6])
def test_evidence_is_the_same_in_all_units(unit):
    rng, never = np.random.default_rng(6), np.zeros(2, dtype=bool)
    found, gains = normal([linear_flight(rng, np.array([0.003, 0.0]), keys=2)], ['a', 'b'],
                          np.zeros(2)), []
    for size in (np.ones(2), np.array([1.0, unit])):
        both = np.outer(size, size)
        scaled = replace(found, info=found.info * both, right=found.right * size,
                         scores=found.scores * size, slopes=found.slopes * both,
                         noise=found.noise * both)
        judge = Judge(scaled, 0.001 / size, 0.02 / size, np.full((2, 2), [-np.inf, np.inf]), never,
                      np.arange(2), 0.05, never, np.zeros(2))
        gains.append([judge.gain(*pair) for pair in (((0,), (1,)), ((0, 1), ()), ((1,), ()))])
    assert gains[0] == pytest.approx(gains[1], rel=1e-6)


def test_an_effect_of_the_least_size_has_the_needed_evidence_in_the_mean():
    rng = np.random.default_rng(4)
    found = normal([linear_flight(rng, np.zeros(1), keys=1)], ['a'], np.zeros(1))
    judge = Judge(found, np.array([0.001]), np.array([0.003]), np.array([[-np.inf, np.inf]]),
                  np.array([False]), np.zeros(1, dtype=int), 0.05, np.array([False]), np.zeros(1))
    size = 0.003 * judge.least([0], 3.0)
    sigma = judge._profile((0,))[2][0, 0]**0.5
    wide, null = np.hypot(sigma, np.hypot(0.001, 0.003)), np.hypot(sigma, 0.001)
    mean = quad(lambda x: norm.pdf(x, size, null) * (norm.logpdf(x, 0, wide)
                                                     - norm.logpdf(x, 0, null)), -0.1, 0.1)[0]
    assert mean == pytest.approx(3.0, rel=1e-4)


def test_noise_of_a_flexible_fit_is_not_too_small():
    rng = np.random.default_rng(3)
    variances = []
    for _ in range(5):
        flight = linear_flight(rng, np.zeros(40), count=1600, keys=40)
        flight.noise[:] = 1.0 * np.eye(2)
        prior = np.tile(0.01 * np.eye(2), (len(EDGES), 1, 1))
        for _ in range(30):
            g, h = (part.sum(axis=(0, 1)) for part in flight.grams())
            covariance = np.linalg.inv(g + 1e-4 * np.eye(40))
            flight.learn(covariance @ h, covariance, prior, weight=1e-3)
        variances.append(np.diagonal(flight.noise[1:], axis1=1, axis2=2).mean())
    assert np.mean(variances) == pytest.approx(0.01, rel=0.15)
