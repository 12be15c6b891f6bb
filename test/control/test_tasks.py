"""Tasks: size and distribution of their poses, disturbances and trajectories."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_flights import targets_of

from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.control.tasks import make_task, NAMES, pose_target, poses_task, TaskPlayer
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.schema import ParameterError


@pytest.mark.parametrize('name', NAMES)
def test_every_named_task_plays_to_its_end(name):
    task = make_task(name, seed=3)
    player = TaskPlayer(task, start=10.0)
    published, t = [], 10.0
    while not player.update(t):
        if player.target is not None:
            published.append(player.target)
        t += 0.005
    assert t - 10.0 == pytest.approx(task.duration, abs=0.01)
    assert [p.stamp for p in published] == pytest.approx([p.stamp for p in targets_of(task, 10.0)])


def test_random_poses_fill_the_stated_ranges_and_follow_the_seed():
    poses = make_task('random1000', seed=1).poses
    low, high = poses.min(axis=0), poses.max(axis=0)
    assert np.all(low >= [-2, -2, 0.6, -180, -180, -180])
    assert np.all(high <= [2, 2, 2, 180, 180, 180])
    assert np.all(high - low > 0.98 * np.array([4, 4, 1.4, 360, 360, 360]))
    assert np.array_equal(poses, make_task('random1000', seed=1).poses)
    assert not np.array_equal(poses, make_task('random1000', seed=2).poses)
    assert np.array_equal(make_task('random100', seed=1).poses, poses[:100])


@pytest.mark.parametrize(('poses', 'text'), [
    ([[0, 0, 1, 0, 0, 0], [0, 0, np.nan, 0, 0, 0]], r'poses\[1\].*nan'),
    ([[0, 0, 1]], r'found shape \(1, 3\)'), (np.zeros((0, 6)), r'found shape \(0, 6\)')])
def test_poses_are_refused_with_the_reason(poses, text):
    with pytest.raises(ParameterError, match=text):
        poses_task('own', poses)


@pytest.mark.parametrize(('name', 'tilt'), [('lemniscate', 0.5), ('lemniscate_large', 2.5)])
def test_each_round_of_the_lemniscate_is_the_curve_of_the_authors(name, tilt):
    period, task = 20.0, make_task(name)
    path, = (target for target in targets_of(task, 0.0) if isinstance(target, TrajectoryTarget))
    for begin, end in task.rounds:
        assert end - begin == pytest.approx(period)
        for t in np.linspace(0, period, 101):
            w, shifted = 2 * np.pi / period, t + period / 4
            given = path.sample(np.array([begin + t]))
            assert given.position[0] == pytest.approx(
                [np.cos(w * shifted), np.sin(2 * w * shifted) / 2,
                 1.0 + 0.3 * np.sin(2 * w * shifted + np.pi / 2)], abs=1e-4)
            attitude = Rotation.from_euler('xyz', [
                -tilt * np.sin(2 * w * shifted), tilt * np.cos(w * shifted),
                np.pi / 2 * np.sin(w * shifted + np.pi) + np.pi / 2])
            assert (attitude.inv() * Rotation.from_quat(given.quaternion[0])).magnitude() < 1e-4


def _played(task, tick=0.005):
    """Times (N,) and wrenches (N, 6) of a task."""
    player, t, rows = TaskPlayer(task, 0.0), 0.0, []
    while not player.update(t):
        rows.append(np.concatenate([[t], player.segment.force_world, player.segment.torque_body]))
        t += tick
    rows = np.array(rows)
    return rows[:, 0], rows[:, 1:]


AUTHORS = [1, 2, 5, 10, 20, 50, 100]


@pytest.mark.parametrize(('name', 'axis', 'levels', 'seconds', 'period'), [
    ('force', [0, 0, 1, 0, 0, 0], np.arange(10.0, 101, 10), 2.0, 2.0),
    ('torque', [0, 0, 0, 1, 0, 0], np.arange(2.5, 30.1, 2.5), 0.05, 2.0),
    ('force_down', [0, 0, -1, 0, 0, 0], AUTHORS, 2.0, 4.0),
    ('force_up', [0, 0, 1, 0, 0, 0], AUTHORS, 2.0, 4.0),
    ('torque_pulses', [0, 0, 0, 1, 0, 0], AUTHORS, 0.05, 5.05)])
def test_each_level_has_the_impulse_of_its_protocol(name, axis, levels, seconds, period):
    times, wrenches = _played(make_task(name))
    assert not wrenches[times < 7.99].any()
    for k, level in enumerate(levels):
        during = (times > 7.999 + k * period) & (times < 7.999 + (k + 1) * period)
        assert wrenches[during].sum(axis=0) * 0.005 == pytest.approx(
            seconds * level * np.array(axis), rel=0.01)
        assert np.abs(wrenches[during]).max() == level
    assert times[-1] == pytest.approx(8 + len(levels) * period, abs=0.01)


def test_the_wind_has_the_stated_mean_intensity_and_length_and_follows_the_seed():
    shares, (times, first) = [], _played(make_task('wind', 0), 0.02)
    for seed in range(12):
        again = _played(make_task('wind', seed), 0.02)[1]
        assert np.array_equal(first, again) == (seed == 0)
        for k, speed in enumerate((2, 3, 4)):
            force = again[(times > 7.999 + 10 * k) & (times < 17.999 + 10 * k)]
            drag = 0.4 * speed + 0.018 * speed ** 2
            # The vertical force is nearly linear in the gust.
            lift = force[:, 2] / (1.6 + 0.018 * speed)
            lag = 0.7 * 0.25 / speed
            near, far = int(lag / 0.02), int(lag / 0.02) + 1
            correlation = [np.corrcoef(lift[:-n], lift[n:])[0, 1] for n in (near, far)]
            shares.append([force[:, 0].mean() / drag, lift.std() / (0.25 * speed),
                           np.interp(lag, [0.02 * near, 0.02 * far], correlation)])
            assert not force[:, 3:].any()
    assert np.mean(shares, axis=0) == pytest.approx([1, 1, np.exp(-1)], abs=0.06)


def test_stick_pushes_come_from_four_sides_above_the_centre():
    times, wrenches = _played(make_task('pushes'))
    impulses = np.array([wrenches[(times > 7.999 + 5 * k) & (times < 12.999 + 5 * k)].sum(axis=0)
                         for k in range(4)]) * 0.005
    assert np.linalg.norm(impulses[:, :3], axis=1) == pytest.approx(1.0)
    assert impulses.sum(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert impulses[:, 3:] == pytest.approx(np.cross([0, 0, 0.1], impulses[:, :3]))


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


def test_set_points_are_a_trajectory_through_each_of_them(tmp_path):
    file = tmp_path / 'points.yaml'
    rows = [[0, 0, 0, 1.2, 0, 0, 0], [2.0, 0.5, 0, 1.4, 0, 40, 90], [4.0, 1, 0, 1, 0, 0, 180]]
    file.write_text(f'set_points: {rows}')
    task = make_task(str(file))
    target = targets_of(task, 10.0)[-1]
    assert task.duration == pytest.approx(12.0)     # after 8 s at the first one
    for time, *pose in rows:
        k = round(time / 0.02)
        assert target.times[k] == pytest.approx(18.0 + time)
        assert target.positions[k] == pytest.approx(pose[:3])
        turn = Rotation.from_euler('ZYX', pose[:2:-1], degrees=True)
        assert (turn.inv() * Rotation.from_quat(target.quaternions[k])).magnitude() < 1e-6


def test_poses_in_yaml_are_those_of_the_same_csv(tmp_path):
    yaml, csv = tmp_path / 'poses.YAML', tmp_path / 'poses.csv'
    yaml.write_text('poses:\n- [1, 2, 0.8, -5, 6.5, 90]\n- [0, 0, 1, 0, 0, 0]\n')
    csv.write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n1,2,0.8,-5,6.5,90\n0,0,1,0,0,0\n')
    tasks = [make_task(str(path)) for path in (yaml, csv)]
    assert tasks[0].poses.tolist() == tasks[1].poses.tolist()
    assert [task.duration for task in tasks] == [16.0, 16.0]
    with pytest.raises(ParameterError, match=r'poses\[0\]: .* the reach of the controller'):
        make_task(str(yaml), reach=2.0)


@pytest.mark.parametrize('content, text', [
    ('points: []', "expected the key 'poses' or 'set_points'"),
    ('poses: []', 'at least 1'),
    ('poses: [[0, 0, 1, 0, 0]]', r'shape \(1, 5\)'),
    ('poses: [[0, 0, 1, 0, 0, 0], [0, 0, 0.1, 0, 0, 0]]', r'poses\[1\]: .*the floor'),
    ('set_points: [[0, 0, 0, 1]]', 'at least 3, found numbers of shape'),
    ('set_points: [[0,0,0,1,0,0,0], [2,0,0,1,0,0,0], [1,0,0,1,0,0,0]]', 'increase from 0'),
    ('set_points: [[0,0,0,1,0,0,0], [2,0,0,0.1,0,0,0], [4,0,0,1,0,0,0]]', 'the floor'),
    ('set_points: [[0,0,0,1,0,0,0], [2,99,0,1,0,0,0], [4,0,0,1,0,0,0]]', 'the fence')])
def test_a_task_in_yaml_is_refused_with_the_reason(tmp_path, content, text):
    file = tmp_path / 'points.yaml'
    file.write_text(content)
    with pytest.raises(ParameterError, match=text):
        make_task(str(file))
