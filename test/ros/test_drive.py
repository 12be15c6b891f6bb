"""Driving by hand: inputs give shifts and goals, the target moves within its limits."""

import numpy as np
import pytest

from beetle_omni_ros.control.targets import TargetChecks
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.ros import drive
from beetle_omni_ros.ros.drive import DriveParameters, parse, Steering

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
START = np.array([0.0, 0.0, 1.0])
DT = 0.05


@pytest.fixture(scope='module')
def p():
    return DriveParameters.load()


def test_each_axis_has_two_opposite_keys(p):
    total = [np.zeros(3), np.zeros(3)]
    for key in drive.MOVES:
        for sum_, part in zip(total, drive.shift_of_key(key, p)):
            sum_ += part
    assert not np.any(total) and {axis for axis, _ in drive.MOVES.values()} == set(range(6))
    assert drive.shift_of_key('w', p)[0] == pytest.approx([p.step, 0, 0])
    assert drive.shift_of_key('j', p)[1] == pytest.approx([0, 0, p.turn])
    assert drive.shift_of_key('z', p) is None
    assert not set(drive.MOVES) & set(drive.KEY_WORDS)


def test_full_deflection_gives_the_speed_and_the_dead_zone_gives_zero(p):
    axes = np.zeros(8)
    for number, sign in zip(p.axes.astype(int), p.signs):
        axes[number] = sign
    way, turn = drive.shift_of_sticks(axes, 0.1, p)
    assert way == pytest.approx([0.1 * p.speed] * 3) and turn == pytest.approx([0.1 * p.rate] * 3)
    way, turn = drive.shift_of_sticks(axes * p.dead_zone * 0.99, 0.1, p)
    assert not way.any() and not turn.any()
    half = drive.shift_of_sticks(axes * (p.dead_zone + (1 - p.dead_zone) / 2), 0.1, p)[0]
    assert half == pytest.approx([0.05 * p.speed] * 3)


@pytest.mark.parametrize(('line', 'way', 'turn'), [
    ('up 0.3', [0, 0, 0.3], [0, 0, 0]), ('  DOWN 1 # slowly', [0, 0, -1], [0, 0, 0]),
    ('right 0.5', [0, -0.5, 0], [0, 0, 0]), ('roll 180', [0, 0, 0], [np.pi, 0, 0]),
    ('yaw -90', [0, 0, 0], [0, 0, -np.pi / 2])])
def test_commands_that_shift_the_target(p, line, way, turn):
    name, shift = parse(line, p.poses)
    assert name == 'shift'
    assert shift[0] == pytest.approx(way) and shift[1] == pytest.approx(turn)


def test_commands_that_go_to_poses_and_that_request_actions(p):
    name, over = parse('over', p.poses)
    assert name == 'goto' and rotations.matrix(over[1])[2, 2] == pytest.approx(-1)
    _, (position, quaternion) = parse('goto 1 0 1.5', p.poses)
    assert position == pytest.approx([1, 0, 1.5]) and quaternion is None
    _, (_, turned) = parse('goto 1 0 1.5 0 0 90', p.poses)
    assert turned == pytest.approx([0, 0, 0.5 ** 0.5, 0.5 ** 0.5])
    assert parse('arm', p.poses) == ('arm', ())
    assert parse('controller rl', p.poses) == ('controller', ('rl',))
    assert parse('wait 2', p.poses) == ('wait', (2.0,))
    assert parse('', p.poses) is None and parse('# nothing', p.poses) is None


@pytest.mark.parametrize(('line', 'fragment'), [
    ('up', 'expected up METRES'), ('up nan', 'METRES'), ('roll 200', 'at most 180'),
    ('goto 1 2', 'X Y Z'), ('jump 3', "'jump': expected"), ('jump', 'or a pose of home'),
    ('controller', 'NAME'), ('wait -1', 'SECONDS'), ('land now', 'nothing after')])
def test_an_unknown_command_is_refused_with_the_expected_ones(p, line, fragment):
    with pytest.raises(ParameterError) as raised:
        parse(line, p.poses)
    assert fragment in str(raised.value) and 'expected' in str(raised.value)
    assert '\n' not in str(raised.value)


# --- the target that moves -----------------------------------------------------------------------

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
