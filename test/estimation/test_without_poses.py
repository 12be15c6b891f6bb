"""Dead reckoning after poses whose markers are tilted, or with a biased accelerometer."""

from ekf_flights import GRAVITY, new_ekf
import numpy as np
import pytest

from beetle_omni_ros.estimation import model
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.readings import ImuReading, PoseReading

TICK, HOVER, TURN, END = 0.005, 8.0, 2.0, 12.0      # [s]


def half_turn(time):
    """Angle [rad] and rate [rad/s] of a smooth half turn that begins at 0."""
    phase = np.pi * np.clip(time / TURN, 0.0, 1.0)
    return np.pi * (1 - np.cos(phase)) / 2, np.pi * np.sin(phase) * np.pi / (2 * TURN)


def rolled_over(marker_std, markers=(0.0, 0.0, 0.0), bias=(0.0, 0.0, 0.0), return_at=np.inf):
    """Filter after a hover, half a turn about x without poses, and a hover upside down."""
    ekf = new_ekf()
    random, tilted = np.random.default_rng(3), rotations.exp(np.array(markers))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, 'MARKER_STD', marker_std)
        for k in range(round(END / TICK)):
            time = TICK * k
            angle, rate = half_turn(time - HOVER)
            quaternion, rate = rotations.exp(np.array([angle, 0, 0])), np.array([rate, 0, 0])
            force = rotations.matrix(quaternion).T @ [0.0, 0.0, GRAVITY] + bias
            ekf.imu(ImuReading(time, force + random.normal(0, 0.05, 3),
                               rate + random.normal(0, 0.005, 3)))
            if k % 2 == 0 and (time < HOVER or time >= return_at):
                ekf.pose(PoseReading(
                    time, random.normal(0, 0.001, 3), rotations.multiply(
                        rotations.multiply(quaternion, tilted),
                        rotations.exp(random.normal(0, 0.0017, 3)))))
    return ekf


def speed(*arguments, **numbers):
    """Horizontal speed of the estimate, which is an error [m/s]."""
    return np.linalg.norm(rolled_over(*arguments, **numbers).estimate.velocity[:2])


def test_tilted_markers_cost_less_than_half_of_the_drift_after_a_turn():
    tilted = 0.01, 0.0, 0.0
    assert speed(0.0, markers=tilted) > 0.4
    assert speed(0.006, markers=tilted) < 0.5 * speed(0.0, markers=tilted)


def test_a_bias_that_markers_cannot_explain_remains_a_bias():
    bias = 0.0, 0.8, 0.0
    assert speed(0.006, bias=bias) == pytest.approx(speed(0.0, bias=bias), abs=1e-9)


def test_poses_that_return_are_used_soon():
    ekf = rolled_over(0.006, markers=(0.01, 0.0, 0.0), return_at=HOVER + 1.5)
    assert ekf.status == 'tracking' and np.linalg.norm(ekf.estimate.velocity) < 0.05
    assert ekf.rejected['outlier'] < 10
