"""Tasks: the properties in INTERFACES."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.schema import ParameterError
from beetle_omni_ros.runs import lemniscate
from beetle_omni_ros.runs.tasks import (
    control_lost,
    make_task,
    NAMES,
    pose_target,
    TaskPlayer,
)


@pytest.mark.parametrize('name', NAMES)
def test_every_named_task_plays_to_its_end(name):
    task = make_task(name, seed=3)
    player = TaskPlayer(task, start=10.0)
    published, t = [], 10.0
    while not (moment := player.update(t)).finished:
        if moment.target is not None:
            published.append(moment.target)
        t += 0.005
    assert t - 10.0 == pytest.approx(task.duration, abs=0.01)
    assert [p.stamp for p in published] == pytest.approx([p.stamp for p in task.targets(10.0)])


def test_waypoints_are_the_five_published_poses_three_times():
    poses = make_task('waypoints').poses
    assert poses.shape == (15, 6)
    assert np.array_equal(poses[:5], poses[5:10])
    assert poses[1].tolist() == [1, 0, 1, 45, 0, 0]


def test_random_poses_fill_the_stated_ranges_and_follow_the_seed():
    poses = make_task('random1000', seed=1).poses
    low, high = poses.min(axis=0), poses.max(axis=0)
    assert np.all(low >= [-2, -2, 0.6, -180, -180, -180])
    assert np.all(high <= [2, 2, 2, 180, 180, 180])
    assert np.all(high - low > 0.98 * np.array([4, 4, 1.4, 360, 360, 360]))
    assert np.array_equal(poses, make_task('random1000', seed=1).poses)
    assert not np.array_equal(poses, make_task('random1000', seed=2).poses)
    assert np.array_equal(make_task('random100', seed=1).poses, poses[:100])


def test_a_pose_target_has_the_attitude_of_its_angles():
    target = pose_target(np.array([1, 2, 3, 30, -40, 170.0]))
    assert np.degrees(rotations.to_rpy(target.quaternion)) == pytest.approx([30, -40, 170])


def test_lemniscate_derivatives_agree_with_finite_differences():
    step = 1e-5
    for t in np.linspace(0.01, lemniscate.DURATION - 0.01, 301):
        before, now, after = (lemniscate.sample(t + dt) for dt in (-step, 0, step))
        velocity = (after.position - before.position) / (2 * step)
        turn = rotations.log(rotations.multiply(rotations.conjugate(before.quaternion),
                                                after.quaternion))
        assert now.velocity == pytest.approx(velocity, abs=1e-6)
        assert now.angular_velocity == pytest.approx(turn / (2 * step), abs=1e-6)


def test_lemniscate_starts_and_ends_at_rest_without_a_jump_in_acceleration():
    step = 1e-3
    for edge, inward in ((0.0, 1), (lemniscate.DURATION, -1)):
        sample = lemniscate.sample(edge)
        near = lemniscate.sample(edge + inward * step)
        assert np.linalg.norm(sample.velocity) < 1e-9
        assert np.linalg.norm(sample.angular_velocity) < 1e-9
        assert np.linalg.norm(near.velocity) / step < 1e-3


def test_each_round_of_the_lemniscate_is_the_curve_of_the_authors():
    period = 20.0
    for begin, end in make_task('lemniscate').rounds:
        assert end - begin == pytest.approx(period)
        for t in np.linspace(0, period, 101):
            w, shifted = 2 * np.pi / period, t + period / 4
            given = lemniscate.sample(begin - 8.0 + t)
            assert given.position == pytest.approx(
                [np.cos(w * shifted), np.sin(2 * w * shifted) / 2,
                 1.0 + 0.3 * np.sin(2 * w * shifted + np.pi / 2)], abs=1e-9)
            assert rotations.to_rpy(given.quaternion) == pytest.approx(
                [-0.5 * np.sin(2 * w * shifted), 0.5 * np.cos(w * shifted),
                 np.pi / 2 * np.sin(w * shifted + np.pi) + np.pi / 2], abs=1e-9)


def test_the_published_trajectory_follows_the_lemniscate_between_its_samples():
    target = lemniscate.target(100.0)
    for t in np.random.default_rng(0).uniform(0, lemniscate.DURATION, 200):
        exact, given = lemniscate.sample(t), target.at(100.0 + t)
        assert given.position == pytest.approx(exact.position, abs=1e-4)
        assert rotations.geodesic_angle(given.quaternion, exact.quaternion) < 1e-4


def test_the_trajectory_begins_where_the_hover_before_it_ends():
    hover, track = make_task('lemniscate').targets(0.0)
    assert isinstance(hover, PoseTarget)
    assert isinstance(track, TrajectoryTarget)
    assert hover.position == pytest.approx(track.positions[0])
    assert rotations.geodesic_angle(hover.quaternion, track.quaternions[0]) < 1e-6


def _impulse(task, tick=0.005):
    """Integral of force and torque over the flight, by level."""
    player, t, total = TaskPlayer(task, 0.0), 0.0, {}
    while not (moment := player.update(t)).finished:
        size = float(np.abs(moment.force_world).sum() + np.abs(moment.torque_body).sum())
        if size:
            total[size] = total.get(size, 0.0) + size * tick
        t += tick
    return total


def test_force_steps_last_two_seconds_each_and_rise_to_100_newton():
    impulses = _impulse(make_task('force'))
    assert max(impulses) == 100
    for level, impulse in impulses.items():
        assert impulse == pytest.approx(2 * level, rel=0.01)


def test_torque_impulses_last_50_ms_and_rise_in_steps_of_two_and_a_half():
    impulses = _impulse(make_task('torque'))
    assert list(impulses) == pytest.approx(np.arange(2.5, 30.1, 2.5))
    for level, impulse in impulses.items():
        assert impulse == pytest.approx(0.05 * level, rel=1e-6)


def test_a_force_task_ends_when_control_is_lost_and_reports_the_level():
    task = make_task('force')
    held = pose_target(task.poses[0])
    player = TaskPlayer(task, 0.0)
    for t in np.arange(0, 11.0, 0.005):  # up to the second level
        assert not player.update(t, held.position, held.quaternion).finished
    moment = player.update(11.0, held.position + [0, 0, 1.6], held.quaternion)
    assert moment.finished
    assert moment.lost
    assert not moment.force_world.any()
    assert player.lost_level == 20


def test_a_robot_turned_over_may_recover_until_the_next_level():
    task = make_task('torque')
    held = pose_target(task.poses[0])
    over = rotations.multiply(held.quaternion, rotations.exp(np.array([2.0, 0, 0])))
    for recovers in (True, False):
        player = TaskPlayer(task, 0.0)
        for t in np.arange(0, 10.5, 0.005):
            turned = 8.2 < t < (9.5 if recovers else 20)
            player.update(t, held.position, over if turned else held.quaternion)
        assert player.lost_level == (None if recovers else 2.5)


def test_ground_contact_is_loss_of_control():
    target = pose_target(np.array([0, 0, 1.5, 25, 0, 0]))
    assert control_lost(target, np.array([0, 0, 0.16]))
    assert not control_lost(target, np.array([0, 0, 0.6]))


def test_payloads_come_one_after_the_other():
    player, t, masses = TaskPlayer(make_task('payload'), 0.0), 0.0, []
    while not (moment := player.update(t)).finished:
        if moment.changed:
            masses.append(moment.payload)
        t += 0.1
    assert masses == [0, 0.25, 0.5, 0.75, 1.0]


HEADER = 'x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n'


def test_a_pose_file_is_read_with_blank_lines_spaces_and_columns_in_any_order(tmp_path):
    file = tmp_path / 'poses.csv'
    file.write_text('yaw_deg,x_m, y_m,z_m,roll_deg,pitch_deg\n\n90, 1 ,2,0.8,-5,6.5\n')
    assert make_task(file).poses.tolist() == [[1, 2, 0.8, -5, 6.5, 90]]


@pytest.mark.parametrize(('content', 'expected'), [
    ('', 'empty'),
    ('1,2,3,4,5,6\n', 'row 1: the header is missing'),
    (HEADER, 'no pose below the header'),
    (HEADER + '1,2,3,4,5\n', 'row 2: expected 6 values, found 5'),
    (HEADER + '1,2,3,4,5,6\n1,2,3,4,5,6,7\n', 'row 3: expected 6 values, found 7'),
    (HEADER + '0,0,1,0,0,0\n\n0,0,1,zero,0,0\n', "row 4, column roll_deg: expected a finite "
                                                 "number, found 'zero'"),
    (HEADER + '0,0,1,0,nan,0\n', 'row 2, column pitch_deg'),
    (HEADER + '0,0,1,0,0,inf\n', 'row 2, column yaw_deg'),
    (HEADER + '0,0,-1,0,0,0\n', 'row 2, column z_m: expected a height above the floor'),
    ('x_m,y_m,z_m,roll_rad,pitch_deg,yaw_deg\n', "row 1: unknown column 'roll_rad'"),
    ('x_m,y_m,z_m,roll_deg,pitch_deg\n', "row 1: column 'yaw_deg' is missing"),
    (HEADER.replace('y_m', 'x_m,y_m'), "column 'x_m' occurs twice"),
])
def test_a_bad_pose_file_is_refused_with_file_and_row(tmp_path, content, expected):
    file = tmp_path / 'poses.csv'
    file.write_text(content)
    with pytest.raises(ParameterError) as error:
        make_task(file)
    assert str(error.value).startswith(f'{file}: ')
    assert expected in str(error.value)


def test_a_binary_file_a_folder_and_a_missing_file_are_refused(tmp_path):
    binary = tmp_path / 'image.csv'
    binary.write_bytes(bytes(range(256)))
    for path in (binary, tmp_path, tmp_path / 'none.csv'):
        with pytest.raises(ParameterError, match=str(path)):
            make_task(path)


def test_an_unknown_task_is_refused_with_the_known_names():
    with pytest.raises(ParameterError, match='waypoints, random100'):
        make_task('random')
