"""Errors of accelerometer and markers from poses in several attitudes at rest."""

from dataclasses import replace

from ekf_flights import GRAVITY
import numpy as np
import pytest
from scipy.stats import chi2

from beetle_omni_ros.estimation.alignment import MarkerAlignment, POSES
from beetle_omni_ros.estimation.parameters import EkfParameters
from beetle_omni_ros.estimation.state import Node
from beetle_omni_ros.robot import rotations

PERIOD, NOISE, DOWN = 0.01, 0.01, np.array([0.0, 0.0, -GRAVITY])
SHIPPED = EkfParameters.load()
PRIORS = SHIPPED.dead_reckoning
BIAS_WALK = SHIPPED.imu.accelerometer_bias_walk


def rest(alignment, random, attitude, bias, turn, start, seconds=4.0):
    """Poses and readings of a robot at rest in an attitude (4,); the bias (3,) walks."""
    seen = rotations.multiply(attitude, rotations.exp(turn))
    rotation, gravity = rotations.matrix(seen), rotations.matrix(attitude).T @ -DOWN
    velocity = np.zeros(3)      # of the integrated readings less that of the robot

    def node(stamp, force, velocity, position):
        return Node(stamp, force, np.zeros(3), position, velocity, seen, rotation, np.zeros(3),
                    np.zeros(3), 0.0)

    for k in range(round(seconds / PERIOD)):
        stamp, force = start + k * PERIOD, gravity + bias
        gain = PERIOD * (rotation @ force + DOWN) \
            + random.normal(0, PRIORS.velocity_walk * PERIOD ** 0.5, 3)
        alignment.add(node(stamp, force, velocity, np.zeros(3)),
                      node(stamp + PERIOD, force, velocity + gain,
                           PERIOD * (velocity + 0.5 * gain)),
                      random.normal(0, NOISE, 3), NOISE ** 2)
        bias += random.normal(0, BIAS_WALK * PERIOD ** 0.5, 3)
    return start + seconds + 1.0


def learnt(seed, attitudes):
    """Errors (6,) of the estimates, in the order of the covariance, and the alignment."""
    random = np.random.default_rng(seed)
    bias = random.normal(0, PRIORS.accelerometer_bias_std, 3)
    turn = random.normal(0, PRIORS.marker_attitude_std, 3)
    alignment, stamp = MarkerAlignment(SHIPPED, GRAVITY), 0.0
    for rpy in attitudes:
        stamp = rest(alignment, random, rotations.from_rpy(*rpy), bias, turn, stamp)
    return np.concatenate([alignment.bias - bias, alignment.turn - turn]), alignment


LEVEL, SIDE, NOSE, INVERTED = (0, 0, 0), (1.6, 0, 0), (0, 1.5, 0), (np.pi, 0, 0)


@pytest.mark.parametrize('attitudes', [(LEVEL,), (LEVEL, INVERTED), (LEVEL, SIDE, NOSE)])
def test_the_errors_agree_with_their_covariance(attitudes):
    squares = []
    for seed in range(40):
        errors, alignment = learnt(seed, attitudes)
        squares.append(errors @ np.linalg.solve(alignment.covariance, errors))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(squares))
    assert low < sum(squares) < high


def test_after_a_step_of_the_bias_the_new_one_is_learnt():
    random, turn = np.random.default_rng(2), np.zeros(3)
    alignment, stamp = MarkerAlignment(SHIPPED, GRAVITY), 0.0
    for bias in (np.zeros(3), np.array([0.0, 0.0, 0.08])):      # vertical, so that it is known
        stamp = rest(alignment, random, rotations.from_rpy(*LEVEL), bias, turn, stamp, 6.0) - 1.0
    assert alignment.bias[2] == pytest.approx(0.08, abs=0.02)


def test_after_many_contradictions_it_is_not_more_uncertain_than_by_its_priors():
    """Poses that jump by 1 m every second contradict every reading of the IMU."""
    alignment, zero = MarkerAlignment(SHIPPED, GRAVITY), np.zeros(3)
    for k in range(2000):
        node = Node(k * PERIOD, -DOWN, zero, zero, zero, np.array([0.0, 0, 0, 1]), np.eye(3),
                    zero, zero, 0.0)
        alignment.add(node, replace(node, stamp=(k + 1) * PERIOD),
                      np.full(3, float(k // 100 % 2)), NOISE ** 2)
    limits = [PRIORS.accelerometer_bias_std] * 3 + [PRIORS.marker_attitude_std] * 3
    assert np.all(np.diag(alignment.covariance) <= 1.05 * np.square(limits))


def test_poses_after_a_pause_do_not_count_as_motion():
    """The next pose is 3 m away, because nobody integrated the way."""
    random, zero = np.random.default_rng(2), np.zeros(3)
    alignment = MarkerAlignment(SHIPPED, GRAVITY)
    stamp = rest(alignment, random, rotations.from_rpy(*LEVEL), zero, zero, 0.0)
    before = alignment.covariance.copy()
    still = Node(stamp, -DOWN, zero, zero, zero, np.array([0.0, 0, 0, 1]), np.eye(3), zero, zero,
                 0.0)
    for k in range(POSES + 1):
        alignment.add(replace(still, stamp=stamp + k * PERIOD),
                      replace(still, stamp=stamp + (k + 1) * PERIOD), np.full(3, 3.0), NOISE ** 2)
    # Without a gate that was missed, only the walk of the bias is added.
    assert np.allclose(alignment.covariance, before, atol=2 * POSES * PERIOD
                       * BIAS_WALK ** 2)
    assert np.all(np.abs(alignment.bias) < 0.02)
