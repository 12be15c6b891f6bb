"""Sensors as noisy as in the publication: their noise causes no effect."""

from dataclasses import replace

from flights import model, Motion, solved
import numpy as np
import pytest

MOTION = Motion(7)
DELAY = 'joint_feedback_delay.delay'


def noisy(tilt=0.0, position=0.0, **late):
    rng, flight = np.random.default_rng(3), MOTION.flight(**late)
    pose = flight.pose.copy()
    pose[:, :3] += position * rng.standard_normal((len(pose), 3))
    return replace(flight, pose=pose,
                   joint=flight.joint + tilt * rng.standard_normal(flight.joint.shape))


def at(made, series):
    """Series (N, n) at 200 Hz at the times of a model's grid."""
    return np.stack([np.interp(made.signals.t, MOTION.t, x) for x in series.T], axis=1)


def rms(x):
    return float(np.sqrt((x**2).mean()))


@pytest.mark.parametrize('name', [DELAY, 'imu_filter_lag.delay'])
def test_derivatives_by_a_delay_contain_no_encoder_noise(name):
    slopes = [model(noisy(tilt)).slopes({}, [name])['J'] for tilt in (0.0, 0.02)]
    clean = model(noisy()).slopes({}, [DELAY])['J']
    assert rms(slopes[1] - slopes[0]) < 0.02 * rms(clean)


def test_the_delay_of_noisy_encoders_is_recovered():
    found = solved(model(noisy(0.02, joint_delay=0.012)), [DELAY], 'J')
    assert found[DELAY] == pytest.approx(0.012, abs=1e-3)


def test_tilts_follow_the_servo_model_if_encoders_are_noisy():
    made = model(noisy(0.02))
    inside = slice(100, -150)
    truth = at(made, MOTION.tilt), at(made, MOTION.tilt_acceleration)
    before = [made.signals.joints({})[k] - truth[j] for j, k in enumerate((0, 2))]
    made.smooth_tilts({})
    after = [made.signals.joints({})[k] - truth[j] for j, k in enumerate((0, 2))]
    assert rms(after[0][inside]) < 0.35 * rms(before[0][inside])
    assert rms(after[1][inside]) < 0.05 * rms(before[1][inside])


@pytest.mark.parametrize('gain', ['kp', 'kd'])
def test_derivatives_by_the_gain_of_a_servo_agree_with_its_joint(gain):
    made, own = model(MOTION.flight()), [f'servo.{gain}[{k}]' for k in range(4)]
    slopes, h = made.slopes({}, [f'joint_bandwidth.{gain}', *own])['J'], 0.01
    for k, name in enumerate(own):
        moved = (made.residual({name: h}, 'J')['J'] - made.residual({}, 'J')['J']) / h
        assert np.abs(moved[:, k]).max() > 1e-3
        assert slopes[:, :, k + 1] == pytest.approx(moved, abs=1e-9)
    assert slopes[:, :, 1:].sum(axis=2) == pytest.approx(slopes[:, :, 0], abs=1e-12)
