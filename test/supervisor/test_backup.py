"""The estimator of the descent against motions in closed form."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import State
from beetle_omni_ros.model import rotations
from beetle_omni_ros.supervisor.backup import BackupEstimator

GRAVITY = 9.80665
RATE = np.array([0.3, -0.2, 0.5])


def truth(t):
    """A swinging, turning body: position, velocity, acceleration, attitude."""
    phase = np.array([0.9, 1.1, 0.7]) * t
    amplitude = np.array([0.5, -0.4, 0.3])
    w = np.array([0.9, 1.1, 0.7])
    return (amplitude * np.sin(phase), amplitude * w * np.cos(phase),
            -amplitude * w ** 2 * np.sin(phase), rotations.exp(RATE * t))


def state(t):
    position, velocity, _, attitude = truth(t)
    return State(t, position, velocity, attitude, RATE, np.zeros(4), np.zeros(4), t)


def sample(t):
    """An IMU sample with constant biases."""
    _, _, acceleration, attitude = truth(t)
    force = (acceleration + [0, 0, GRAVITY]) @ rotations.matrix(attitude)
    return t, force + 0.1, RATE + 0.01


@pytest.mark.parametrize('imu, most', [(True, (0.01, 0.06, 0.01)), (False, (0.03, 0.15, 0.02))])
def test_follows_a_motion_with_late_noisy_mocap_and_a_biased_imu_or_none(imu, most):
    estimator, random, end = BackupEstimator(GRAVITY), np.random.default_rng(0), 6.0
    estimator.start(state(0.0))
    estimator.imu_alive = imu
    for t in np.arange(1, round(200 * end) + 1) / 200:
        if imu:
            estimator.add(*sample(t))
        if round(200 * t) % 2 == 0:
            position, _, _, attitude = truth(t - 0.01)
            estimator.correct(t - 0.01, position + 0.001 * random.normal(size=3),
                              rotations.multiply(attitude, rotations.exp(
                                  0.002 * random.normal(size=3))))
        if not imu:
            hover = [0, 0, GRAVITY] @ rotations.matrix(truth(t)[3])     # without acceleration
            estimator.predict(t, hover, np.zeros(3))
    got, (position, velocity, _, attitude) = estimator.state(end, state(end)), truth(end)
    assert np.linalg.norm(got.position - position) < most[0]
    assert np.linalg.norm(got.velocity - velocity) < most[1]
    assert rotations.geodesic_angle(got.quaternion, attitude) < most[2]
