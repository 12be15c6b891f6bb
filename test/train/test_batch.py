"""Batched rotations against scipy, and distributions of random numbers."""

import learning  # noqa: F401
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
import torch

from beetle_omni_ros.train import batch


def rotations(count, seed):
    return Rotation.random(count, np.random.default_rng(seed))


def single(values):
    return torch.tensor(np.asarray(values), dtype=torch.float32)


@pytest.mark.parametrize('angle', [0.0, 1e-3, 1.0, np.pi])
def test_the_geodesic_is_exact_at_all_angles(angle):
    a = rotations(100, 6)
    axis = np.random.default_rng(7).normal(size=(100, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    b = a * Rotation.from_rotvec(angle * axis)
    found = batch.geodesic(single(a.as_matrix()), single(b.as_matrix()))
    # An arc cosine would lose half the digits: 1e-3 rad.
    np.testing.assert_allclose(found, angle, atol=1e-6)


def test_drawn_attitudes_are_half_uniform_and_half_axis_and_angle():
    numbers = torch.rand(100_000, 8, generator=torch.Generator().manual_seed(0))
    quaternion = batch.Draw(numbers).attitude().double()
    np.testing.assert_allclose(quaternion.norm(dim=-1), 1, atol=1e-5)
    found = Rotation.from_quat(quaternion.numpy())
    axes = found.as_matrix()
    # No direction is preferred by either half: means of one body axis' image...
    angle = found.magnitude()
    turned = found.as_rotvec() / angle[:, None]
    assert np.abs(turned.mean(0)).max() < 0.01
    np.testing.assert_allclose(turned.T @ turned / len(turned), np.eye(3) / 3, atol=0.01)

    # ... and angles: uniform on SO(3) has density (1 - cos a) / pi, the other half 1 / pi.
    def share(a):
        return (0.5 * (a - np.sin(a)) + 0.5 * a) / np.pi
    assert kstest(angle, share).statistic < 0.01
    # The uniform half alone would leave no mean, the other one leaves E[(1 + 2 cos a) / 3] = 1/3.
    np.testing.assert_allclose(axes.mean(0), np.eye(3) / 6, atol=0.01)
