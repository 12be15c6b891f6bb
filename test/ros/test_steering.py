"""The target moves within its limits and only to permitted poses."""

import numpy as np
import pytest

from beetle_omni_ros.control.targets import TargetChecks
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.ros.drive import DriveParameters, Steering

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
START = np.array([0.0, 0.0, 1.0])
DT = 0.05


@pytest.fixture(scope='module')
def p():
    return DriveParameters.load()


def steering(p, why_not=lambda position, quaternion: ''):
    return Steering(p, why_not, START, LEVEL)


def test_the_goal_is_reached_within_the_speed_limits(p):
    driven, steps = steering(p), 0
    assert driven.go([1.0, -2.0, 1.5], rotations.from_rpy(3.0, 0.2, -1.0)) == ''
    while not driven.arrived:
        before = driven.position, driven.quaternion
        assert driven.update(DT) == ''
        assert np.linalg.norm(driven.position - before[0]) <= p.speed * DT + 1e-9
        assert rotations.geodesic_angle(driven.quaternion, before[1]) <= p.rate * DT + 1e-6
        steps += 1
    assert driven.position == pytest.approx([1.0, -2.0, 1.5])
    assert steps * DT == pytest.approx(np.linalg.norm([1, -2, 0.5]) / p.speed, abs=2 * DT)


def test_shifts_move_along_world_and_turn_about_the_body(p):
    driven = steering(p)
    driven.go(START, rotations.from_rpy(0, 0, np.pi / 2))
    assert driven.shift(np.array([0.1, 0, 0]), np.array([0.3, 0, 0])) == ''
    position, quaternion = driven.goal
    assert position == pytest.approx([0.1, 0, 1])
    assert rotations.to_rpy(quaternion) == pytest.approx([0.3, 0, np.pi / 2])
    driven.shift(np.zeros(3), np.array([0, 0, -np.pi / 2]))
    assert rotations.to_rpy(driven.goal[1]) == pytest.approx([0.3, 0, 0])


def test_a_goal_beyond_the_fence_or_in_the_floor_is_refused_and_the_old_one_stays(p):
    driven = steering(p, TargetChecks(RobotParameters.load()).why_not_pose)
    assert 'the fence' in driven.go([30.0, 0, 1], LEVEL)
    assert 'the floor' in driven.shift(np.array([0, 0, -0.95]), np.zeros(3))
    assert driven.arrived


def test_a_path_through_the_floor_ends_above_it(p):
    driven = steering(p, TargetChecks(RobotParameters.load()).why_not_pose)
    driven.position = np.array([0.0, 0.0, 0.2])     # the feet are just above the floor
    driven.goal = driven.position, driven.quaternion
    assert driven.go([0.0, 0.0, 0.3], rotations.from_rpy(np.pi, 0, 0)) == '', 'itself it is good'
    texts = [driven.update(DT) for _ in range(200)]
    assert any('the floor' in text for text in texts) and driven.arrived
    assert rotations.geodesic_angle(driven.quaternion, LEVEL) < 1.5


def test_the_target_waits_for_a_robot_that_lags(p):
    driven = steering(p)
    driven.go([5.0, 0.0, 1.0], LEVEL)
    for _ in range(400):
        driven.update(DT, START)
    assert np.linalg.norm(driven.position - START) <= p.leash and not driven.arrived
    driven.update(DT, np.array([3.0, 0.0, 1.0]))
    assert driven.position[0] > p.leash - 2 * p.speed * DT
