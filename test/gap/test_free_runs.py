"""Free runs: simulation from measured states."""

from flights import model, Motion
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.rollouts import _servo_runs

GAP = 0.04


@pytest.fixture(scope='module')
def made():
    return model(Motion().flight())


def test_rotors_follow_their_servos_through_backlash(made):
    starts, steps = np.arange(0, 1200, 50), 100
    _, shaft, tight = _servo_runs(made, {}, starts, steps)
    _, same, loose = _servo_runs(made, {'joint_backlash.gap': GAP}, starts, steps)
    seen = made.signals.joints({'joint_backlash.gap': GAP})[0]
    np.testing.assert_array_equal(shaft, tight)     # rotors follow their servos
    np.testing.assert_array_equal(same, tight)      # which it does not move
    np.testing.assert_allclose(loose[:, 0], seen[starts], atol=1e-3)
    np.testing.assert_allclose(loose, seen[starts[:, None] + np.arange(steps + 1)], atol=4e-3)
    assert np.abs(loose - tight).max() <= GAP / 2 + 1e-3
    one_way = np.abs(np.sign(np.diff(tight, axis=1)).sum(axis=1)) == steps
    turning = one_way & (np.abs(tight[:, -1] - tight[:, 0]) > GAP)  # touches a side
    assert turning.sum() > 20
    np.testing.assert_allclose(np.abs(loose - tight)[:, -1][turning], GAP / 2, atol=2e-3)
