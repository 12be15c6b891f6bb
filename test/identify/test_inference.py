"""Inference against independent references; it does not depend on the robot."""

import numpy as np
import pytest

from beetle_omni_ros.identify.inference.prior import Prior


@pytest.mark.parametrize('prior', [Prior(0.5), Prior(0.5, centre=2.0), Prior(0.1, 0.3, 0.7, 5.0)])
def test_the_derivative_of_a_prior_is_that_of_its_residual(prior):
    x = np.linspace(-3.03, 3.02, 80)
    numeric = (prior.residual(x + 1e-6) - prior.residual(x - 1e-6)) / 2e-6
    assert prior.slope(x) == pytest.approx(numeric, rel=1e-5)
    assert np.abs(prior.residual(prior.within(x, 2.0))).max() <= 2.0 + 1.0 / prior.inner * 4
