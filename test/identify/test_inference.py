"""Inference against independent references; it does not depend on the robot."""

import numpy as np
import pytest
from scipy.signal import lfilter

from beetle_omni_ros.identify.inference.blocks import ridge_held_out
from beetle_omni_ros.identify.inference.least_squares import solved
from beetle_omni_ros.identify.inference.noise import autoregression, gain, whitened
from beetle_omni_ros.identify.inference.prior import Prior


@pytest.mark.parametrize('prior', [Prior(0.5), Prior(0.5, centre=2.0), Prior(0.1, 0.3, 0.7, 5.0)])
def test_the_derivative_of_a_prior_is_that_of_its_residual(prior):
    x = np.linspace(-3.03, 3.02, 80)
    numeric = (prior.residual(x + 1e-6) - prior.residual(x - 1e-6)) / 2e-6
    assert prior.slope(x) == pytest.approx(numeric, rel=1e-5)
    assert np.abs(prior.residual(prior.within(x, 2.0))).max() <= 2.0 + 1.0 / prior.inner * 4


def coloured(seed, count=20000):
    return lfilter([0.3], [1.0, -1.2, 0.5], np.random.default_rng(seed).standard_normal(count))


def test_an_autoregression_is_fitted_and_whitens():
    series = [coloured(1), coloured(2)]
    taps, level = autoregression(series, 2)
    assert taps == pytest.approx([1.0, -1.2, 0.5], abs=0.02)
    assert level == pytest.approx(0.3, rel=0.02)
    white = whitened(series[0], taps, level)
    assert white.std() == pytest.approx(1, abs=0.03)
    assert abs(white[1:] @ white[:-1]) / len(white) < 0.03
    assert level**2 * gain(taps) == pytest.approx(series[0].var(), rel=0.1)


def test_a_regression_is_cross_validated_by_blocks():
    rng = np.random.default_rng(0)
    x, block = rng.standard_normal((400, 3)), np.arange(400) // 80
    r = x @ [1.0, -0.5, 0.0] + rng.standard_normal(400)
    held, weights = ridge_held_out(x, r, block, 5, 2.0)
    assert weights == pytest.approx(np.linalg.solve(x.T @ x + 2 * np.eye(3), x.T @ r))
    for b, gain_of_block in enumerate(held.gains):
        out = block == b
        w = np.linalg.solve(x[~out].T @ x[~out] + 2 * np.eye(3), x[~out].T @ r[~out])
        assert gain_of_block == pytest.approx((r[out]**2).sum() - ((r[out] - x[out] @ w)**2).sum())
    noise, _ = ridge_held_out(x, rng.standard_normal(400), block, 5, 2.0)
    assert noise.total < 10.0 and held.total > 300.0


def test_normal_equations_of_any_scale_are_solved():
    rng = np.random.default_rng(0)
    root, scale = rng.standard_normal((4, 9)), np.array([1e-5, 1.0, 1e4, 30.0])
    h = (scale[:, None] * root) @ (scale[:, None] * root).T
    truth = rng.standard_normal((4, 2)) / scale[:, None]
    assert solved(h, h @ truth) * scale[:, None] == pytest.approx(truth * scale[:, None], rel=1e-6)
    assert solved(h, h @ truth[:, 0]) * scale == pytest.approx(truth[:, 0] * scale, rel=1e-6)
