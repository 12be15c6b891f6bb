"""Tasks: the properties in INTERFACES."""

import numpy as np
import pytest

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.tasks import (
    DURATION,
    lemniscate,
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


def test_random_poses_fill_the_stated_ranges_and_follow_the_seed():
    poses = make_task('random1000', seed=1).poses
    low, high = poses.min(axis=0), poses.max(axis=0)
    assert np.all(low >= [-2, -2, 0.6, -180, -180, -180])
    assert np.all(high <= [2, 2, 2, 180, 180, 180])
    assert np.all(high - low > 0.98 * np.array([4, 4, 1.4, 360, 360, 360]))
    assert np.array_equal(poses, make_task('random1000', seed=1).poses)
    assert not np.array_equal(poses, make_task('random1000', seed=2).poses)
    assert np.array_equal(make_task('random100', seed=1).poses, poses[:100])


def test_lemniscate_derivatives_agree_with_finite_differences():
    step = 1e-5
    for t in np.linspace(0.01, DURATION - 0.01, 301):
        before, now, after = (lemniscate(t + dt) for dt in (-step, 0, step))
        velocity = (after.position - before.position) / (2 * step)
        turn = rotations.log(rotations.multiply(rotations.conjugate(before.quaternion),
                                                after.quaternion))
        assert now.velocity == pytest.approx(velocity, abs=1e-6)
        assert now.angular_velocity == pytest.approx(turn / (2 * step), abs=1e-6)


def test_each_round_of_the_lemniscate_is_the_curve_of_the_authors():
    period = 20.0
    for begin, end in make_task('lemniscate').rounds:
        assert end - begin == pytest.approx(period)
        for t in np.linspace(0, period, 101):
            w, shifted = 2 * np.pi / period, t + period / 4
            given = lemniscate(begin - 8.0 + t)
            assert given.position == pytest.approx(
                [np.cos(w * shifted), np.sin(2 * w * shifted) / 2,
                 1.0 + 0.3 * np.sin(2 * w * shifted + np.pi / 2)], abs=1e-9)
            assert rotations.to_rpy(given.quaternion) == pytest.approx(
                [-0.5 * np.sin(2 * w * shifted), 0.5 * np.cos(w * shifted),
                 np.pi / 2 * np.sin(w * shifted + np.pi) + np.pi / 2], abs=1e-9)


def _impulse(task, tick=0.005):
    """Integral of force and torque over the flight, by level."""
    player, t, total = TaskPlayer(task, 0.0), 0.0, {}
    while not (moment := player.update(t)).finished:
        size = float(np.abs(moment.force_world).sum() + np.abs(moment.torque_body).sum())
        if size:
            total[size] = total.get(size, 0.0) + size * tick
        t += tick
    return total


@pytest.mark.parametrize(('name', 'levels', 'seconds'), [
    ('force', np.arange(10.0, 101, 10), 2.0), ('torque', np.arange(2.5, 30.1, 2.5), 0.05)])
def test_pushes_rise_in_equal_steps_and_last_their_time(name, levels, seconds):
    impulses = _impulse(make_task(name))
    assert list(impulses) == pytest.approx(levels)
    for level, impulse in impulses.items():
        assert impulse == pytest.approx(seconds * level, rel=0.01)


@pytest.mark.parametrize(('recovers_at', 'lost'), [(9.5, None), (20.0, 2.5)])
def test_a_robot_turned_over_may_recover_until_the_next_level(recovers_at, lost):
    task = make_task('torque')
    held = pose_target(task.poses[0])
    over = rotations.multiply(held.quaternion, rotations.exp(np.array([2.0, 0, 0])))
    player = TaskPlayer(task, 0.0)
    for t in np.arange(0, 10.5, 0.005):
        player.update(t, held.position, over if 8.2 < t < recovers_at else held.quaternion)
    assert player.lost_level == lost


def test_a_pose_file_is_read_with_blank_lines_spaces_and_columns_in_any_order(tmp_path):
    file = tmp_path / 'poses.csv'
    file.write_text('yaw_deg,x_m, y_m,z_m,roll_deg,pitch_deg\n\n90, 1 ,2,0.8,-5,6.5\n')
    assert make_task(file).poses.tolist() == [[1, 2, 0.8, -5, 6.5, 90]]
