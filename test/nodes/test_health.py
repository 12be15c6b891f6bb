"""Diagnostics: quantiles in constant memory, rates, refusals, silence."""

import numpy as np
import pytest

from beetle_omni_ros.nodes.health import Distribution


@pytest.mark.parametrize('spread', [0.01, 0.5, 2.0])
def test_quantiles_agree_with_sorting_within_two_percent(spread):
    samples = 1e-3 * np.exp(np.random.default_rng(1).normal(0, spread, 5000))
    distribution = Distribution()
    for sample in samples:
        distribution.add(float(sample))
    for fraction in (0.5, 0.9, 0.99):
        assert distribution.quantile(fraction) == pytest.approx(
            np.quantile(samples, fraction), rel=0.02)
    assert distribution.max == samples.max() and distribution.count == 5000


def test_an_empty_distribution_gives_nan_and_extremes_are_counted():
    distribution = Distribution()
    assert np.isnan(distribution.quantile(0.5))
    for sample in (0.0, 1e-9, 1e4):
        distribution.add(sample)
    assert distribution.max == 1e4 and distribution.quantile(0.01) < 2e-6
