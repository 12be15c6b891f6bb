"""On-line estimate of additional delays, and what is noise."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control.latency import LatencyEstimator, NoiseFilter
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.flight.evaluate import fly
from beetle_omni_ros.model.effects import validated
from beetle_omni_ros.model.parameters import RobotParameters

STEP, FINE = 0.01, 10   # [s] of the estimator; samples of the signal within it
NOISE = np.repeat([0.3, 3.0], 3)


def estimate(delay, scale, seed, seconds=40.0, gain=1.0):
    """
    Estimate for a robot whose accelerations are ``delay`` later than those of the model.

    The model has the estimated delay. The errors are those of the mean over each step, with noise
    and a slow drift.
    """
    rng = np.random.default_rng(seed)
    count = round(seconds / STEP) * FINE
    # motion up to 2 Hz
    signal = lfilter(*butter(2, 2.0, fs=FINE / STEP), rng.normal(size=(count, 6)), axis=0)
    signal *= scale * NOISE / signal.std(0)
    time = np.arange(count) * STEP / FINE

    def mean(late):
        late = np.array([np.interp(time - late, time, column) for column in signal.T]).T
        return late.reshape(-1, FINE, 6).mean(1)

    true = gain * mean(delay) + NOISE * (0.3 * rng.normal(size=(count // FINE, 6)) + np.sin(
        0.3 * time[::FINE, None]))
    known = {round(ms): mean(ms / 1e3) for ms in range(61)}
    estimator = LatencyEstimator(0.05, 4.0, NOISE)
    slow = np.zeros(6)
    for k, row in enumerate(true):
        predicted = known[round(estimator.latency * 1e3)][k]
        error = row - predicted - slow
        slow += 4.0 * STEP * error      # as the disturbance estimate does
        estimator.observe(predicted, error, STEP)
    return estimator.latency


@pytest.mark.parametrize('delay', [0.0, 0.01, 0.025, 0.04])
def test_the_delay_of_a_moving_robot_is_found(delay):
    found = [estimate(delay, 3.0, seed) for seed in range(3)]
    assert np.allclose(found, delay, atol=0.004)


def test_a_wrong_thrust_is_no_delay():
    assert max(estimate(0.0, 3.0, seed, gain=1.3) for seed in range(3)) < 0.005


def test_without_motion_there_is_no_delay():
    assert max(estimate(0.03, 0.02, seed) for seed in range(3)) < 0.005


def test_one_outlier_does_not_move_the_estimate():
    estimator = LatencyEstimator(0.05, 4.0, NOISE)
    rng = np.random.default_rng(0)
    for k in range(3000):
        estimator.observe(NOISE * np.sin(6.0 * STEP * k), 0.1 * NOISE * rng.normal(size=6), STEP)
    before = estimator.latency
    estimator.observe(NOISE, 1000.0 * NOISE, STEP)
    for k in range(50):
        estimator.observe(NOISE * np.sin(6.0 * STEP * k), 0.1 * NOISE * rng.normal(size=6), STEP)
    assert abs(estimator.latency - before) < 0.002


@cache
def flown(name, task, robot=None, conditions='nominal', **effects):
    """Metrics of a flight; ``effects`` of delays [s] are those of the plant alone."""
    robot, task = RobotParameters.load(robot), make_task(task, 5)
    plant = replace(robot, effects=validated({
        effect: {'delay': delay} for effect, delay in effects.items()})) if effects else robot
    return metrics(fly(name, task, robot=robot, plant=plant, seed=5, conditions=conditions), task)


@pytest.mark.parametrize('name, task, effect', [
    ('nmpc', 'random2', 'command_latency'),     # it misses the second pose without the estimate
    ('rl', 'random1', 'command_latency'), ('rl', 'random1', 'joint_feedback_delay')])
def test_a_robot_with_unknown_delays_is_flown_as_the_known_one(name, task, effect):
    known, unknown = flown(name, task), flown(name, task, **{effect: 0.03})
    assert all(pose['reached'] for pose in unknown['poses'])
    assert unknown['mean']['U_orientation_deg'] < known['mean']['U_orientation_deg'] + 0.2
    assert unknown['hover_command_change_rms']['joint_rad'] < 0.01


@pytest.mark.parametrize('least', [0.0, 0.2])
def test_noise_is_removed_and_motion_stays(least):
    rng = np.random.default_rng(0)
    noise, time = rng.normal(size=(4000, 3)), STEP * np.arange(4000)[:, None]
    motion = 10.0 * np.sin(2.0 * time + np.arange(3.0))
    for added, expected in ((0.0, least * noise), (motion, motion + noise)):
        noise_filter = NoiseFilter(np.full(3, least))
        kept = np.array([noise_filter.without(each, STEP) for each in noise + added])
        assert (kept - expected)[1000:].std() < 0.3


def test_a_sudden_error_passes_but_for_the_size_of_the_noise():
    noise_filter, rng = NoiseFilter(np.zeros(3)), np.random.default_rng(1)
    for each in rng.normal(size=(2000, 3)):
        noise_filter.without(each, STEP)
    assert np.all(noise_filter.without(np.full(3, 50.0), STEP) > 30.0)


@pytest.mark.parametrize('name', ['nmpc', 'rl'])
def test_noise_of_the_sensors_does_not_reach_the_commands(name):
    noisy = flown(name, 'random1', 'measured', 'published')
    assert all(pose['reached'] for pose in noisy['poses'])
    # The noise of an encoder has 0.02 rad.
    assert noisy['hover_command_change_rms']['joint_rad'] < 0.02
