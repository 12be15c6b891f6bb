"""The estimator of the descent against motions in closed form."""

import numpy as np

from beetle_omni_ros.control.base import State
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.safety.backup import BackupEstimator

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


def sample(t, force_bias=0.0, rate_bias=0.0):
    _, _, acceleration, attitude = truth(t)
    force = (acceleration + [0, 0, GRAVITY]) @ rotations.matrix(attitude)
    return t, force + force_bias, RATE + rate_bias


def follow(estimator, begin, end, imu=True, mocap=True, force_bias=0.0, rate_bias=0.0,
           noise=None):
    """Feed 200 Hz of IMU and 100 Hz of MoCap, 10 ms late."""
    for k in range(round(begin * 200) + 1, round(end * 200) + 1):
        t = k / 200
        if imu:
            estimator.add(*sample(t, force_bias, rate_bias))
        if mocap and k % 2 == 0:
            position, _, _, attitude = truth(t - 0.01)
            if noise is not None:
                position = position + 0.001 * noise.normal(size=3)
                attitude = rotations.multiply(attitude, rotations.exp(
                    0.002 * noise.normal(size=3)))
            estimator.correct(t - 0.01, position, attitude)
        if not imu:
            hover = [0, 0, GRAVITY] @ rotations.matrix(truth(t)[3])     # without acceleration
            estimator.predict(t, hover, np.zeros(3))


def errors(estimator, t):
    got = estimator.state(t, state(t))
    position, velocity, _, attitude = truth(t)
    return (np.linalg.norm(got.position - position), np.linalg.norm(got.velocity - velocity),
            rotations.geodesic_angle(got.quaternion, attitude))


def test_follows_a_motion_with_late_noisy_mocap_and_a_biased_imu():
    estimator = BackupEstimator(GRAVITY)
    estimator.start(state(0.0))
    follow(estimator, 0.0, 6.0, force_bias=0.1, rate_bias=0.01, noise=np.random.default_rng(0))
    position, velocity, attitude = errors(estimator, 6.0)
    assert position < 0.01 and velocity < 0.06 and attitude < 0.01


def test_follows_mocap_alone_without_imu():
    estimator = BackupEstimator(GRAVITY)
    estimator.start(state(0.0))
    estimator.imu_alive = False
    follow(estimator, 0.0, 5.0, imu=False)
    position, velocity, attitude = errors(estimator, 5.0)
    assert position < 0.03 and velocity < 0.15 and attitude < 0.02
