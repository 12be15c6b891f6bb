"""Metrics against cases with known results, and bag against memory."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_flights import (
    fly,
    write_command,
    write_joints,
    write_odom,
    write_state,
    write_truth,
)

from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.runs.bag import BagWriter, read_bag
from beetle_omni_ros.runs.body import geodesic_angles, roll_pitch_yaw
from beetle_omni_ros.runs.json_file import write_json
from beetle_omni_ros.runs.metrics import metrics, metrics_by_controller, task_of
from beetle_omni_ros.runs.recorder import LogRecorder, Tee
from beetle_omni_ros.runs.tasks import make_task, pose_target

LEVEL = np.array([0, 0, 0, 1.0])


def flown(task, **options):
    recorder = LogRecorder()
    fly(recorder, task, **options)
    return recorder.log()


def test_geodesic_angles_agree_with_scipy():
    a, b = (Rotation.random(50, random_state=k) for k in (1, 2))
    assert geodesic_angles(a.as_quat(), b.as_quat()) == pytest.approx(
        (b.inv() * a).magnitude(), abs=1e-9)
    assert geodesic_angles(a.as_quat(), -a.as_quat()) == pytest.approx(0, abs=1e-7)


def test_roll_pitch_yaw_agrees_with_the_scalar_form():
    quaternions = Rotation.random(50, random_state=3).as_quat()
    expected = [np.degrees(rotations.to_rpy(q)) for q in quaternions]
    assert roll_pitch_yaw(quaternions) == pytest.approx(np.array(expected), abs=1e-9)


def ramp_log(stamp=100.0):
    """One pose whose position error is the time since the target in cm, orientation in deg."""
    recorder = LogRecorder()
    write_state(recorder, stamp - 1, 'flying:nmpc')
    recorder.write_target(pose_target(np.array([1, 2, 3, 0, 0, 90.0]), stamp))
    turn = rotations.from_rpy(0, 0, np.pi / 2)
    for k in range(1601):
        t = 0.005 * k
        write_truth(recorder, stamp + t, np.array([1, 2 - 0.01 * t, 3]),
                    rotations.multiply(turn, rotations.exp([np.radians(t), 0, 0])),
                    np.array([0.3, 0, 0.4]), np.array([0, 0.2, 0]))
    return recorder.log()


def test_u_and_l_are_the_means_over_their_windows():
    result = metrics(ramp_log())
    pose, = result['poses']
    assert pose['U_position_m'] == pytest.approx(0.0725)
    assert pose['U_orientation_deg'] == pytest.approx(7.25)
    assert pose['L_position_m'] == pytest.approx(0.04)
    assert pose['L_orientation_deg'] == pytest.approx(4.0)
    assert pose['target'] == pytest.approx([1, 2, 3, 0, 0, 90])
    assert pose['reached'] is True
    assert result['hover_speed_mean_m_s'] == pytest.approx(0.5)
    assert result['hover_angular_speed_mean_rad_s'] == pytest.approx(0.2)
    assert result['hover_angular_speed_std_rad_s'] == pytest.approx(0)


@pytest.mark.parametrize(('offset', 'angle', 'reached'), [
    (0.099, 9.9, True), (0.101, 0.0, False), (0.0, 10.1, False)])
def test_reached_means_within_10_cm_and_10_deg(offset, angle, reached):
    log = flown(make_task('random1', seed=1), offset=offset, angle=angle, approach=0.1)
    result = metrics(log)
    assert result['poses'][0]['reached'] is reached
    assert result['success_rate'] == float(reached)


def test_mean_median_and_max_are_over_the_poses():
    task = make_task('random3')
    recorder = LogRecorder()
    write_state(recorder, 0.0, 'flying:nmpc')
    for k, target in enumerate(task.targets(1.0)):
        recorder.write_target(target)
        for t in target.stamp + np.arange(0, 8, 0.005):
            write_truth(recorder, t, target.position + [0.01 * (k + 1) ** 2, 0, 0],
                        target.quaternion, np.zeros(3), np.zeros(3))
    result = metrics(recorder.log(), task)
    assert result['mean']['U_position_m'] == pytest.approx((0.01 + 0.04 + 0.09) / 3)
    assert result['median']['U_position_m'] == pytest.approx(0.04)
    assert result['max']['U_position_m'] == pytest.approx(0.09)
    assert [pose['target'] for pose in result['poses']] == [list(p) for p in task.poses]


def test_the_lowest_point_is_reported_with_its_pose():
    task, recorder = make_task('random3'), LogRecorder()
    write_state(recorder, 0.0, 'flying:nmpc')
    for k, target in enumerate(task.targets(1.0)):
        recorder.write_target(target)
        for t in target.stamp + np.arange(0, 8, 0.005):
            dip = 0.4 if k == 1 and 3 < t - target.stamp < 3.1 else 0.0
            write_truth(recorder, t, np.array([0, 0, 0.7 - dip]), target.quaternion, np.zeros(3),
                        np.zeros(3))
    # on the ground before and after, which is not part of the flight
    write_truth(recorder, 30.0, np.zeros(3), LEVEL, np.zeros(3), np.zeros(3))
    result = metrics(recorder.log(), task)
    assert result['lowest'] == {'height_m': pytest.approx(0.3), 'pose': 1}
    assert metrics(LogRecorder().log())['lowest'] == {}


def test_effort_is_command_minus_joint_and_mean_thrust():
    recorder = LogRecorder()
    recorder.write_target(pose_target(np.array([0, 0, 1, 0, 0, 0.0]), 0.0))
    for k in range(1601):
        t = 0.005 * k
        write_truth(recorder, t, np.array([0, 0, 1]), LEVEL, np.zeros(3), np.zeros(3))
        write_joints(recorder, t, np.full(4, 0.1), np.zeros(4))
        if k % 2 == 0:
            write_command(recorder, t, np.array([0.1, 0.2, 0.0, 0.1]),
                          np.full(4, 7.0 + 0.5 * (k // 2 % 2)))
    result = metrics(recorder.log())
    assert result['joint_error_mean_rad'] == pytest.approx(0.05)
    assert result['thrust_mean_N'] == pytest.approx(7.25, abs=1e-3)
    assert result['hover_command_change_rms'] == pytest.approx({'joint_rad': 0.0, 'thrust_N': 0.5})


def test_a_command_repeated_between_answers_counts_once():
    recorder = LogRecorder()
    recorder.write_target(pose_target(np.array([0, 0, 1, 0, 0, 0.0]), 0.0))
    for k in range(1601):
        t, stamp = 0.005 * k, 0.01 * (k // 2)
        write_truth(recorder, t, np.array([0, 0, 1]), LEVEL, np.zeros(3), np.zeros(3))
        write_command(recorder, stamp, np.zeros(4), np.full(4, 7.0 + (k // 2) % 2), received=t)
    assert metrics(recorder.log())['hover_command_change_rms']['thrust_N'] == pytest.approx(1.0)


@pytest.mark.parametrize('name', ['waypoints', 'lemniscate', 'torque', 'payload', 'hover'])
def test_a_bag_gives_the_metrics_of_the_flight_in_memory(tmp_path, name):
    task = make_task(name)
    meta = {'task': name, 'seed': 0}
    memory = LogRecorder(meta)
    duration = {'waypoints': 16.5, 'lemniscate': 33.0, 'torque': 11.0, 'payload': 16.0,
                'hover': 12.0}[name]
    with BagWriter(tmp_path / 'bag', meta) as bag:
        fly(Tee(memory, bag), task, duration=duration, start=1.7e9 + 0.123456789)
    mine, theirs = metrics(memory.log(), task), metrics(read_bag(tmp_path / 'bag'))
    assert_close(mine, theirs)
    assert mine['poses'][0]['U_position_m'] == pytest.approx(0.02, abs=1e-4)


def assert_close(mine, theirs, at=''):
    assert type(mine) is type(theirs), at
    if isinstance(mine, dict):
        assert set(mine) == set(theirs), at
        for key in mine:
            assert_close(mine[key], theirs[key], f'{at}.{key}')
    elif isinstance(mine, list):
        assert len(mine) == len(theirs), at
        for k, (a, b) in enumerate(zip(mine, theirs, strict=True)):
            assert_close(a, b, f'{at}[{k}]')
    elif isinstance(mine, float):
        assert mine == pytest.approx(theirs, abs=1e-6), at
    else:
        assert mine == theirs, at


def test_poses_that_were_never_flown_count_as_missed():
    task = make_task('waypoints')
    log = flown(task, duration=16.0, after=0.0)
    result = metrics(log, task)
    assert len(result['poses']) == 15
    assert result['success_rate'] == pytest.approx(2 / 15)
    assert result['poses'][5]['U_position_m'] is None
    assert result['mean']['U_position_m'] == pytest.approx(0.02, abs=1e-4)


def test_a_pose_replaced_before_its_time_does_not_count():
    recorder = LogRecorder()
    for stamp in (0.0, 3.0):
        recorder.write_target(pose_target(np.array([0, 0, 1, 0, 0, 0.0]), stamp))
    for t in np.arange(0, 11.2, 0.005):
        write_truth(recorder, t, np.array([0, 0, 1]), LEVEL, np.zeros(3), np.zeros(3))
    assert len(metrics(recorder.log())['poses']) == 1


@pytest.mark.parametrize('how', ['fall', 'stop', 'nan'])
def test_a_crash_is_detected_in_the_flight(how):
    recorder = LogRecorder()
    fly(recorder, make_task('waypoints'), duration=20.0)
    if how == 'fall':
        write_truth(recorder, 15.001, np.array([0, 0, 0.16]), LEVEL, np.zeros(3), np.zeros(3))
    elif how == 'nan':
        write_truth(recorder, 15.001, np.full(3, np.nan), LEVEL, np.zeros(3), np.zeros(3))
    else:
        write_state(recorder, 15.0, 'emergency_stop')
    assert metrics(recorder.log())['crashed'] is True
    assert metrics(flown(make_task('waypoints'), duration=20.0))['crashed'] is False


def test_landing_after_the_task_is_not_a_crash():
    recorder = LogRecorder()
    fly(recorder, make_task('random2'))
    for k in range(200):
        write_truth(recorder, 17.3 + 0.005 * k, np.array([0, 0, 0.16]), LEVEL, np.zeros(3),
                    np.zeros(3))
    write_state(recorder, 18.5, 'disarmed')
    result = metrics(recorder.log(), make_task('random2'))
    assert result['crashed'] is False
    assert result['success_rate'] == 1.0


def test_poses_after_an_early_landing_have_no_errors_and_the_end_is_stated():
    task, recorder = make_task('waypoints'), LogRecorder()
    fly(recorder, task, duration=26.0)
    write_state(recorder, 14.1, 'landing:rotor2_lost')      # 13.1 s after the first target
    result = metrics(recorder.log(), task)
    assert result['ended'] == 'landing: rotor2_lost at 13.1 s'
    assert [pose['U_position_m'] is None for pose in result['poses'][:3]] == [False, True, True]
    assert result['poses'][1]['L_position_m'] is None and result['success_rate'] == 1 / 15
    assert result['hover_speed_mean_m_s'] is not None    # of the first pose
    assert metrics(recorder.log())['ended'] == result['ended']      # by the task of the metadata


def test_a_landing_after_the_task_or_after_the_loss_of_control_is_no_early_end():
    for name, duration in (('random2', None), ('force', 20.0)):
        task = make_task(name)
        assert 'ended' not in metrics(flown(task, duration=duration), task)


def test_each_controller_has_the_metrics_of_its_poses():
    task = make_task('waypoints')
    recorder = LogRecorder()
    fly(recorder, task, duration=39.0)
    write_state(recorder, 17.2, 'flying:rl')
    write_state(recorder, 20.0, 'fallback')
    write_state(recorder, 21.0, 'flying:rl')
    results = metrics_by_controller(recorder.log(), task)
    assert list(results) == ['nmpc', 'rl']
    assert [len(result['poses']) for result in results.values()] == [2, 3]
    assert results['rl']['poses'][0]['target'] == [0, 1, 1, 0, -25, 0]


def test_metrics_use_the_estimate_without_truth():
    recorder = LogRecorder()
    recorder.write_target(pose_target(np.array([0, 0, 1, 0, 0, 0.0]), 0.0))
    for t in np.arange(0, 8.1, 0.005):
        write_odom(recorder, t, np.array([0.05, 0, 1]), LEVEL, np.zeros(3), np.zeros(3))
    result = metrics(recorder.log())
    assert result['poses'][0]['U_position_m'] == pytest.approx(0.05)
    assert 'estimation' not in result


def test_the_estimation_error_is_reported_if_truth_is_recorded():
    result = metrics(flown(make_task('random1')))
    assert result['estimation']['position_rms_m'] == pytest.approx(1e-3 * np.sqrt(3), rel=0.1)


def test_tracking_reports_every_round():
    result = metrics(flown(make_task('lemniscate')), make_task('lemniscate'))
    tracking = result['trajectory']
    assert len(tracking['rounds']) == 5
    for part in (tracking, *tracking['rounds']):
        assert part['position_mean_m'] == pytest.approx(0.02, abs=1e-6)
        assert part['orientation_max_deg'] == pytest.approx(3.0, abs=1e-6)
    duration = make_task('lemniscate').rounds[0][1] + 2.0
    cut = metrics(flown(make_task('lemniscate'), duration=duration), make_task('lemniscate'))
    assert [part['position_mean_m'] is None for part in cut['trajectory']['rounds']] \
        == [False, True, True, True, True]


def test_windows_of_a_trajectory_have_the_metrics_of_one():
    task = make_task('lemniscate')
    log = flown(task)
    expected = metrics(log, task)['trajectory']
    whole = log.targets.pop()
    for start in range(0, len(whole.times) - 1, 75):
        part = slice(start, start + 150)        # half of each window repeats in the next
        log.targets.append(TrajectoryTarget(
            whole.times[part], whole.positions[part], whole.quaternions[part],
            whole.velocities[part], whole.angular_velocities[part], whole.times[start]))
    result = metrics(log, task)['trajectory']
    assert result.pop('rounds') == expected.pop('rounds')
    assert result == pytest.approx(expected)


def test_the_level_at_which_control_was_lost_is_reported():
    task, recorder = make_task('force'), LogRecorder()
    fly(recorder, task, start=0.0, duration=13.0, after=0.0)
    result = metrics(recorder.log(), task)['force']
    assert result['withstood_N'] == 20
    assert result['lost_at_N'] == 30  # the flight ended during it
    assert result['levels'][0]['peak_position_m'] == pytest.approx(0.02, abs=1e-3)
    complete = metrics(flown(task), task)['force']
    assert complete['lost_at_N'] is None
    assert complete['withstood_N'] == 100


def test_a_robot_far_from_its_target_has_lost_control():
    task, recorder = make_task('torque'), LogRecorder()
    fly(recorder, task, start=0.0)
    write_truth(recorder, 11.0011, np.array([1.6, 0, 1.5]), LEVEL, np.zeros(3), np.zeros(3))
    result = metrics(recorder.log(), task)['torque']
    assert (result['withstood_N_m'], result['lost_at_N_m']) == (2.5, 5.0)
    assert result['levels'][-1]['peak_position_m'] == pytest.approx(1.6, abs=1e-6)


def test_payloads_report_the_steady_height_error_of_each_mass():
    task, recorder = make_task('payload'), LogRecorder()
    write_state(recorder, 0.0, 'flying:nmpc')
    for target, segment in zip(task.targets(0.0), task.segments, strict=True):
        recorder.write_target(target)
        for t in target.stamp + np.arange(0, 8, 0.005):
            write_truth(recorder, t, np.array([0, 0, 1 - 0.1 * segment.payload]), LEVEL,
                        np.zeros(3), np.zeros(3))
    payload = metrics(recorder.log(), task)['payload']
    assert [entry['payload_kg'] for entry in payload] == [0, 0.25, 0.5, 0.75, 1.0]
    assert [entry['height_error_m'] for entry in payload] == pytest.approx(
        [0, -0.025, -0.05, -0.075, -0.1])


def test_a_task_is_rebuilt_from_the_meta_data_of_a_bag():
    recorder = LogRecorder({'task': 'random7', 'seed': 5})
    np.testing.assert_array_equal(task_of(recorder.log()).poses, make_task('random7', 5).poses)
    for meta in ({}, {'task': 'my/poses.csv'}, {'task': 'nonsense'}):
        assert task_of(LogRecorder(meta).log()) is None


def test_metrics_of_an_empty_flight_are_empty_and_strict_json(tmp_path):
    result = metrics(LogRecorder().log())
    write_json(tmp_path / 'out.json', {'meta': {}, 'x': result, 'y': float('nan')})
    back = json.loads((tmp_path / 'out.json').read_text())
    assert back['x']['poses'] == []
    assert back['y'] is None


def test_the_result_has_the_keys_of_the_interface():
    result = metrics(flown(make_task('random1')), make_task('random1'))
    assert {'poses', 'mean', 'median', 'max', 'success_rate', 'crashed', 'compute_ms',
            'joint_error_mean_rad', 'thrust_mean_N', 'hover_command_change_rms'} <= set(result)
    keys = {'U_position_m', 'U_orientation_deg', 'L_position_m', 'L_orientation_deg'}
    assert set(result['poses'][0]) == {'target', 'reached', *keys}
    for name in ('mean', 'median', 'max'):
        assert set(result[name]) == keys
    assert result['compute_ms'] == {'median': 0.2, 'p99': 0.4, 'max': 0.9, 'deadline_misses': 0}
