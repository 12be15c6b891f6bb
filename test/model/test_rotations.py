"""Rotations agree with scipy and obey the group's axioms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.model import rotations


@pytest.fixture(params=range(3))
def pair(request):
    """Two random unit quaternions."""
    return Rotation.random(2, random_state=request.param).as_quat()


def test_matrix_and_product_agree_with_scipy(pair):
    a, b = pair
    product = Rotation.from_quat(a) * Rotation.from_quat(b)
    assert np.allclose(rotations.matrix(rotations.multiply(a, b)), product.as_matrix(), atol=1e-14)


def test_logarithm_inverts_exponential(pair):
    a, _ = pair
    assert rotations.geodesic_angle(rotations.exp(rotations.log(a)), a) < 1e-12
    assert np.allclose(rotations.log(a), Rotation.from_quat(a).as_rotvec(), atol=1e-12)


def test_exponential_of_tiny_vectors_is_first_order_exact():
    for size in (0.0, 1e-12, 1e-7, 1e-5):
        vector = size * np.array([0.3, -0.5, 0.8])
        assert np.allclose(rotations.exp(vector)[:3], vector / 2, rtol=1e-9, atol=1e-20)
        assert np.allclose(rotations.log(rotations.exp(vector)), vector, rtol=1e-9, atol=1e-20)


def test_geodesic_angle_is_symmetric_and_independent_of_quaternion_sign(pair):
    a, b = pair
    angle = rotations.geodesic_angle(a, b)
    relative = Rotation.from_quat(b).inv() * Rotation.from_quat(a)
    assert angle == pytest.approx(relative.magnitude())
    assert angle == pytest.approx(rotations.geodesic_angle(-b, a))
    assert rotations.geodesic_angle(a, -a) < 1e-7


def test_roll_pitch_yaw_is_the_zyx_convention(pair):
    rpy = Rotation.from_quat(pair[0]).as_euler('ZYX')[::-1]
    assert rotations.geodesic_angle(rotations.from_rpy(*rpy), pair[0]) < 1e-7
    assert np.allclose(rotations.to_rpy(pair[0]), rpy, atol=1e-9)


def test_skew_is_the_cross_product():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 3))
    assert np.allclose(rotations.skew(a) @ b, np.cross(a, b))
    assert np.array_equal(rotations.cross(a, b), np.cross(a, b))
