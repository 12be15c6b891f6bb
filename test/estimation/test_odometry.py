"""The covariances of an odometry message against Monte Carlo."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.estimation.state import Estimate

DRAWS, GYROSCOPE_NOISE = 200_000, 2e-3


@pytest.fixture(scope='module')
def drawn():
    """An estimate at a general attitude, and draws of the truth from its covariance."""
    rng = np.random.default_rng(2)
    mix = rng.standard_normal((15, 15)) * 1e-3
    estimate = Estimate(0.0, np.array([1.0, 2.0, 3.0]), np.array([2.0, -1.0, 0.5]),
                        Rotation.from_rotvec([2.0, -1.0, 1.5]).as_quat(),
                        np.array([1.0, -2.0, 0.5]), np.zeros(3), np.zeros(3), lambda: mix @ mix.T,
                        GYROSCOPE_NOISE)
    return estimate, rng.standard_normal((DRAWS, 15)) @ mix.T, rng


def assert_covariance(samples, expected):
    """Compare in units of the expected standard deviations."""
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.cov(samples.T) / np.outer(scale, scale),
                               expected / np.outer(scale, scale), atol=0.02)


def test_pose_covariance_is_about_world_axes(drawn):
    estimate, errors, _ = drawn
    attitude = Rotation.from_quat(estimate.quaternion)
    true_attitude = attitude * Rotation.from_rotvec(errors[:, 6:9])
    about_world = (true_attitude * attitude.inv()).as_rotvec()
    assert_covariance(np.hstack([errors[:, :3], about_world]), estimate.pose_covariance())


def test_twist_covariance_is_in_base_link(drawn):
    estimate, errors, rng = drawn
    attitude = Rotation.from_quat(estimate.quaternion)
    true_attitude = attitude * Rotation.from_rotvec(errors[:, 6:9])
    linear = true_attitude.inv().apply(estimate.velocity + errors[:, 3:6])
    # measured = true + bias + noise, and the estimate takes the measured rate less its bias
    angular = estimate.angular_velocity - errors[:, 12:15] \
        - GYROSCOPE_NOISE * rng.standard_normal((DRAWS, 3))
    assert_covariance(np.hstack([linear, angular]), estimate.twist_covariance())
