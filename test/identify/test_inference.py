"""Inference against independent references; it does not depend on the robot."""


import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter

from beetle_omni_ros.identify.inference.blocks import ridge_held_out
from beetle_omni_ros.identify.inference.least_squares import minimise, solved, Steps
from beetle_omni_ros.identify.inference.noise import autoregression, gain, whitened
from beetle_omni_ros.identify.inference.prior import Prior, UNKNOWN

T = np.linspace(0, 2, 60)
LOW, HIGH = np.array([-5.0, 0.0]), np.array([5.0, 3.0])


def curve(points):
    return points[:, :1] * np.exp(-points[:, 1:] * T)


def problems(count, seed=0):
    """Decays with noise: (measured, residual, jacobian)."""
    rng = np.random.default_rng(seed)
    truth = np.stack([rng.uniform(1, 3, count), rng.uniform(0.3, 2.5, count)], axis=1)
    measured = curve(truth) + 0.05 * rng.standard_normal((count, len(T)))

    def residual(points, rows):
        return (curve(points) - measured[rows]) / 0.05

    def jacobian(points, rows, base):
        one = np.exp(-points[:, 1:] * T) / 0.05
        return np.stack([one, -T * points[:, :1] * one], axis=1)

    return measured, residual, jacobian


def test_batched_problems_converge_to_the_single_solutions():
    measured, residual, jacobian = problems(12)
    start = np.tile([2.0, 1.0], (12, 1))
    fits = minimise(start, np.full((12, 2), True), LOW, HIGH, residual, jacobian, UNKNOWN, 60,
                    Steps(1e-12))
    for k in range(12):
        alone = least_squares(lambda x, k=k: residual(x[None], [k])[0], start[k],
                              bounds=(LOW, HIGH), xtol=1e-12, ftol=1e-12)
        assert fits.points[k] == pytest.approx(alone.x, abs=1e-4)
        assert fits.chi2[k] == pytest.approx(2 * alone.cost, rel=1e-8)


def test_a_prior_has_the_weight_of_equal_data():
    """A straight line through data of deviation 1 and a prior: the precision-weighted mean."""
    value = np.array([3.0, -1.0])

    def residual(points, rows):
        return np.repeat(points - value[rows, None], 4, axis=1)

    def jacobian(points, rows, base):
        return np.ones((len(points), 1, 4))

    fits = minimise(np.zeros((2, 1)), np.full((2, 1), True), np.array([-9.0]), np.array([9.0]),
                    residual, jacobian, Prior(np.array([0.5]), centre=np.array([1.0])), 30,
                    Steps(1e-14))
    assert fits.points[:, 0] == pytest.approx((4 * value + 4 * 1.0) / 8, abs=1e-6)


@pytest.mark.parametrize('prior', [Prior(0.5), Prior(0.5, centre=2.0), Prior(0.1, 0.3, 0.7, 5.0)])
def test_the_derivative_of_a_prior_is_that_of_its_residual(prior):
    x = np.linspace(-3.03, 3.02, 80)
    numeric = (prior.residual(x + 1e-6) - prior.residual(x - 1e-6)) / 2e-6
    assert prior.slope(x) == pytest.approx(numeric, rel=1e-5)
    assert np.abs(prior.residual(prior.within(x, 2.0))).max() <= 2.0 + 1.0 / prior.inner * 4
    assert prior.cost(x) == pytest.approx((prior.residual(x)**2).sum())


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
