"""Refused targets, with the reason, and accepted ones."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.targets import COLUMNS, read_poses, TargetChecks
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

CHECKS = TargetChecks(RobotParameters.load())
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
UPSIDE_DOWN = rotations.from_rpy(np.pi, 0, 0)


def why(position, quaternion=LEVEL, stamp=0.0, now=None):
    return CHECKS.why_not(PoseTarget(np.array(position, dtype=float), quaternion, stamp), now)


@pytest.mark.parametrize('position, quaternion, text', [
    ((0, 0, -5), LEVEL, 'the floor'), ((0, 0, 0.05), UPSIDE_DOWN, 'the floor'),
    ((0, -19, 1), LEVEL, 'the fence'), ((0, 0, 30), LEVEL, 'the fence'),
    ((np.nan, 0, 1), LEVEL, 'finite'),
    ((0, 0, 0.3), LEVEL, ''), ((2, -2, 0.6), UPSIDE_DOWN, ''), ((0, 0, 1), -LEVEL, '')])
def test_invalid_targets_are_refused_in_one_line(position, quaternion, text):
    reason = why(position, quaternion)
    assert bool(reason) == bool(text) and text in reason and '\n' not in reason


def test_stamps_of_another_time_are_refused_and_zero_is_now():
    for stamp, age in ((1.0, '1e+09 s old'), (1e9 + 100.0, '-100 s old')):
        assert age in why((0, 0, 1), stamp=stamp, now=1e9)
    for stamp in (0.0, 1e9 - 1, 1e9 + 0.5):
        assert why((0, 0, 1), stamp=stamp, now=1e9) == ''


def test_points_that_lie_too_far_apart_for_their_times_are_refused():
    def path(x, turn=0.0):
        return TrajectoryTarget(
            np.array([0.0, 0.1]), np.array([[0, 0, 1.0], [x, 0, 1.0]]),
            np.array([LEVEL, rotations.from_rpy(0, 0, turn)]), np.zeros((2, 3)), np.zeros((2, 3)))

    assert CHECKS.why_not(path(1.0, 1.9)) == ''
    assert 'point 2: 8 m from the one before within 0.1 s' in CHECKS.why_not(path(8.0))
    assert CHECKS.why_not(path(0.0, 3.1)) == ''     # 34.6 rad/s about a diagonal


@pytest.mark.parametrize('reach, row', [(6.5, 4), (2.0, 3)])
def test_a_row_beyond_the_reach_of_the_controller_is_named(tmp_path, reach, row):
    file = tmp_path / 'far.csv'
    file.write_text(f'{",".join(COLUMNS)}\n0.5,0,1,0,0,0\n3,0,1,0,0,0\n17.9,0,1,0,0,0\n')
    assert len(read_poses(file)) == 3
    with pytest.raises(ParameterError, match=rf'row {row}: .* m from .* at most {reach:g} m'):
        read_poses(file, reach)
