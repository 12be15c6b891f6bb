"""Metrics against cases with known results, and bag against memory."""

import json

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from synthetic_flights import (
    fly,
    targets_of,
    write_command,
    write_joints,
    write_odom,
    write_state,
    write_target,
    write_truth,
)

from beetle_omni_ros.bags.log import geodesic_angles, LogRecorder, roll_pitch_yaw
from beetle_omni_ros.bags.metrics import failed, metrics, metrics_by_controller
from beetle_omni_ros.bags.task_metrics import step_response
from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.control.tasks import make_task, pose_target
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.show.table import grids

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
    expected = [np.degrees(rotations.to_rpy(q)) for q in a.as_quat()]
    assert roll_pitch_yaw(a.as_quat()) == pytest.approx(np.array(expected), abs=1e-9)


def ramp_log(stamp=100.0):
    """One pose whose position error is the time since the target in cm, orientation in deg."""
    recorder = LogRecorder()
    write_state(recorder, stamp - 1, 'flying:nmpc')
    write_target(recorder, pose_target(np.array([1, 2, 3, 0, 0, 90.0]), stamp))
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


def steady(task, position, write=write_truth, recorder=None):
    """
    Fly the targets of a task; ``position(k, t)`` is the offset (3,) at target k, t s after it.

    Returns:
        The log.

    """
    recorder = recorder or LogRecorder()
    write_state(recorder, 0.0, 'flying:nmpc')
    for k, target in enumerate(task if isinstance(task, list) else targets_of(task, 1.0)):
        write_target(recorder, target)
        for t in np.arange(0, 8, 0.005):
            write(recorder, target.stamp + t, target.position + position(k, t), target.quaternion,
                  np.zeros(3), np.zeros(3))
    return recorder.log()


HOVER = np.array([0, 0, 1, 0, 0, 0.0])


def test_payloads_report_the_steady_height_error_of_each_mass():
    task = make_task('payload')
    masses = [segment.payload for segment in task.segments]
    payload = metrics(steady(task, lambda k, t: [0, 0, -0.1 * masses[k]]), task)['payload']
    assert [entry['payload_kg'] for entry in payload] == [0, 0.25, 0.5, 0.75, 1.0]
    assert [entry['height_error_m'] for entry in payload] == pytest.approx(
        [0, -0.025, -0.05, -0.075, -0.1])


def test_without_truth_the_estimate_counts_and_a_replaced_pose_does_not():
    targets = [pose_target(HOVER, stamp) for stamp in (0.0, 3.0)]
    result = metrics(steady(targets, lambda k, t: [0.05, 0, 0], write_odom))
    assert [pose['U_position_m'] for pose in result['poses']] == [pytest.approx(0.05)]
    assert 'estimation' not in result


def test_effort_is_command_minus_joint_and_a_repeated_command_counts_once():
    recorder = LogRecorder()
    steady([pose_target(HOVER, 1.0)], lambda k, t: np.zeros(3), recorder=recorder)
    for k in range(1600):
        t, stamp = 1 + 0.005 * k, 1 + 0.01 * (k // 2)
        write_joints(recorder, t, np.full(4, 0.1), np.zeros(4))
        write_command(recorder, stamp, np.array([0.1, 0.2, 0.0, 0.1]),
                      np.full(4, 7.0 + 0.5 * (k // 2 % 2)), received=t)
    result = metrics(recorder.log())
    assert result['joint_error_mean_rad'] == pytest.approx(0.05)
    assert result['thrust_mean_N'] == pytest.approx(7.25, abs=1e-3)
    assert result['hover_command_change_rms'] == pytest.approx({'joint_rad': 0.0, 'thrust_N': 0.5})


@pytest.mark.parametrize(('offset', 'angle', 'reached'), [
    (0.099, 9.9, True), (0.101, 0.0, False), (0.0, 10.1, False)])
def test_reached_means_within_10_cm_and_10_deg(offset, angle, reached):
    log = flown(make_task('random1', seed=1), offset=offset, angle=angle, approach=0.1)
    result = metrics(log)
    assert result['poses'][0]['reached'] is reached
    assert result['success_rate'] == float(reached)


@pytest.mark.parametrize('height', [None, 0.16, np.nan])
def test_a_crash_is_detected_in_the_flight(height):
    recorder = LogRecorder()
    fly(recorder, make_task('waypoints'), duration=20.0)
    write_truth(recorder, 0.0, np.zeros(3), LEVEL, np.zeros(3), np.zeros(3))    # before take-off
    assert metrics(recorder.log())['crashed'] is False
    if height is None:
        write_state(recorder, 15.0, 'emergency_stop')
    else:
        write_truth(recorder, 15.001, np.array([0, 0, height]), LEVEL, np.zeros(3), np.zeros(3))
    assert metrics(recorder.log())['crashed'] is True


def landed(speed, upright=True, ends=('landing', 'disarmed:supervisor_paused')):
    """Result of a pose and of a descent of 0.85 m at a constant speed [m/s] onto the legs."""
    task, recorder, end = make_task('random1', seed=1), LogRecorder(), 9.2
    fly(recorder, task)
    for t in np.arange(0, 0.85 / speed + 1, 0.005):
        height = max(1.0 - speed * t, 0.15)
        moves = height > 0.15
        write_truth(recorder, end + t, np.array([0, 0, height]),
                    LEVEL if upright or moves else rotations.from_rpy(1.2, 0, 0),
                    np.array([0, 0, -speed * moves]), np.zeros(3))
    for state, after in zip(ends, (0.0, 0.85 / speed), strict=False):
        write_state(recorder, end + after, state)
    return metrics(recorder.log(), task)


@pytest.mark.parametrize(('speed', 'upright', 'fell'), [
    (0.3, True, False), (3.1, True, True), (0.3, False, True)])
def test_a_landing_has_the_speed_of_its_touchdown_and_a_fall_is_a_failure(speed, upright, fell):
    result = landed(speed, upright)
    assert result['landing'] == {'speed_m_s': pytest.approx(speed), 'fell': fell}
    assert not result['crashed'] and result['success_rate'] == 1
    assert failed(result) == ('the robot fell in the landing' if fell else '')
    row = next(row for row in grids({'nmpc': result})[0].rows if row[0].startswith('landing'))
    assert row[1] == ('fell, ' if fell else '') + f'{speed:.2f}'


def test_without_an_ended_landing_there_is_none_and_an_emergency_stop_in_it_is_a_fall():
    assert 'landing' not in landed(0.3, ends=('landing',))
    assert 'landing' not in landed(0.3, ends=())
    assert 'landing' not in landed(0.3, ends=('flying:nmpc', 'emergency_stop:crash'))
    assert landed(0.3, ends=('landing', 'emergency_stop:control_lost'))['landing']['fell']


def test_a_pose_that_hover_reached_in_fallback_is_not_reached():
    task, recorder = make_task('waypoints'), LogRecorder()
    fly(recorder, task, duration=24.0)
    for t, state in ((12.0, 'fallback:controller_silent'), (20.0, 'flying:nmpc')):
        write_state(recorder, t, state)     # in the U window of the second pose only
    result = metrics(recorder.log(), task)
    assert [pose['reached'] for pose in result['poses'][:3]] == [True, False, True]
    cell = next(row[1] for row in grids({'nmpc': result})[0].rows if row[0] == 'poses reached')
    assert cell == '2 of 15, 1 in fallback'


def test_an_interrupted_flight_has_what_was_flown_and_misses_nothing():
    task = make_task('waypoints')
    log = flown(task, duration=20.0)
    log.state_t, log.states = log.state_t[:-1], log.states[:-1]     # no landing
    assert len(metrics(log, task)['poses']) == 15
    log.meta['interrupted'] = True
    result = metrics(log, task)
    assert [pose['reached'] for pose in result['poses']] == [True, True]
    assert result['ended'] == 'interrupted at 20.2 s' and not failed(result)
    task = make_task('force')
    log = flown(task, start=0.0, duration=13.0, after=0.0)
    log.meta['interrupted'] = True
    assert metrics(log, task)['force']['lost_at_N'] is None


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


def test_tracking_reports_every_round_of_a_trajectory_whole_or_in_windows():
    task = make_task('lemniscate')
    log = flown(task, duration=task.rounds[1][1] + 2.0)
    tracking = metrics(log, task)['trajectory']
    assert [part['position_mean_m'] for part in tracking['rounds']] \
        == [pytest.approx(0.02, abs=1e-6)] * 2 + [None] * 3
    assert tracking['rounds'][0]['orientation_max_deg'] == pytest.approx(3.0, abs=1e-6)
    whole = log.targets.pop()
    for start in range(0, len(whole.times) - 1, 75):
        part = slice(start, start + 150)        # half of each window repeats in the next
        log.targets.append(TrajectoryTarget(
            whole.times[part], whole.positions[part], whole.quaternions[part],
            whole.velocities[part], whole.angular_velocities[part], whole.times[start]))
    windows = metrics(log, task)['trajectory']
    assert windows.pop('rounds') == tracking.pop('rounds')
    assert windows == pytest.approx(tracking)


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


def decaying(task, duration, period, lag):
    """Log of a hover with an error of 0.1 m at each disturbance, which decays with lag(t) [s]."""
    recorder = LogRecorder()
    target, = targets_of(task, 0.0)
    write_state(recorder, -1.0, 'flying:nmpc')
    write_target(recorder, target)
    for t in np.arange(0, duration + 0.001, 0.005):
        since = (t - 8.001) % period if t > 8.001 else 100.0
        write_truth(recorder, t, target.position + [0.1 * np.exp(-since / lag(t)), 0, 0],
                    target.quaternion, np.array([0.03, 0, 0.04]), np.array([0, 0.2, 0]))
    return recorder.log()


def test_a_torque_has_its_time_of_recovery_and_a_lasting_force_has_none():
    task = make_task('torque')
    log = decaying(task, 12.0, 2.0, lambda t: 0.5)
    pulse, *_ = metrics(log, task)['torque']['levels']
    assert pulse['recovery_s'] == pytest.approx(np.log(5) / 2, abs=6e-3)
    force, *_ = metrics(flown(make_task('force')), make_task('force'))['force']['levels']
    assert 'recovery_s' not in force


def test_a_step_of_a_second_order_system_has_its_known_rise_settling_and_overshoot():
    damping, frequency = 0.6, 5.0
    fast = frequency * np.sqrt(1 - damping ** 2)

    def response(t):
        return 1 - np.exp(-damping * frequency * t) * (
            np.cos(fast * t) + damping / np.sqrt(1 - damping ** 2) * np.sin(fast * t))

    peak = np.pi / fast
    rise = np.diff([brentq(lambda t, s=share: response(t) - s, 0, peak) for share in (0.1, 0.9)])
    settling = brentq(lambda t: response(t) - 1.05, peak, 2 * peak)     # the last crossing
    times = np.arange(0, 8.001, 0.001)
    found = step_response(times, 3.0 - 0.4 * response(times), -0.4)
    assert found['rise_s'] == pytest.approx(rise[0], abs=2e-3)
    assert found['settling_s'] == pytest.approx(settling, abs=2e-3)
    assert found['overshoot_percent'] == pytest.approx(
        100 * np.exp(-np.pi * damping / np.sqrt(1 - damping ** 2)), abs=0.01)
    assert found['end'] == pytest.approx(2.6)


def test_each_axis_has_its_own_step_response():
    task, recorder = make_task('steps'), LogRecorder()
    lags = [0.2 + 0.1 * k for k in range(6)]
    write_state(recorder, 0.0, 'flying:nmpc')
    for k, target in enumerate(targets_of(task, 1.0)):
        write_target(recorder, target)
        before, now = np.array(HOVER), task.poses[k]
        for t in np.arange(0.005, 8.001, 0.005) if k < 10 else ():  # no step of pitch and yaw
            pose = now + (before - now) * np.exp(-t / lags[min(k // 2, 5)]) * (k % 2)
            write_truth(recorder, target.stamp + t, pose[:3],
                        rotations.from_rpy(*np.radians(pose[3:])), np.zeros(3), np.zeros(3))
    steps = metrics(recorder.log(), task)['steps']
    assert [step['axis'] for step in steps] == ['x', 'y', 'z', 'roll', 'pitch', 'yaw']
    assert [step['step_m'] for step in steps[:3]] == [0.3, 0.2, 0.5]
    assert [step['step_deg'] for step in steps[3:]] == pytest.approx(np.degrees([0.5, 0.5, 0.3]))
    for step, lag in zip(steps[:5], lags, strict=False):    # of a first-order lag
        assert step['rise_s'] == pytest.approx(lag * np.log(9), abs=6e-3)
        assert step['settling_s'] == pytest.approx(lag * np.log(20), abs=6e-3)
        assert step['overshoot_percent'] < 0.1
    assert steps[5]['rise_s'] is None


def test_pushes_report_their_peaks_and_when_the_robot_has_recovered():
    task = make_task('pushes')
    # the last push is not settled after 5 s
    log = decaying(task, 28.0, 5.0, lambda t: 1.0 if t < 23.001 else 5.0)
    pushes = metrics(log, task)['pushes']
    assert pushes['speed_mean_m_s'] == pytest.approx(0.05)
    assert pushes['angular_speed_mean_rad_s'] == pytest.approx(0.2)
    assert [push['peak_position_m'] for push in pushes['pushes']] == pytest.approx(
        [0.1] * 4, abs=1e-3)
    assert [push['recovery_s'] for push in pushes['pushes'][:3]] == pytest.approx(
        [np.log(5)] * 3, abs=6e-3)
    assert pushes['pushes'][3]['recovery_s'] is None


def test_each_wind_speed_that_was_flown_to_its_end_has_its_errors():
    task = make_task('wind')
    slow, middle, fast = metrics(flown(task, duration=29.0), task)['wind']
    for part in (slow, middle):
        assert part['position_mean_m'] == pytest.approx(0.02, abs=1e-6)
        assert part['orientation_std_deg'] == pytest.approx(0.0, abs=1e-6)
    assert [part['speed_m_s'] for part in (slow, middle, fast)] == [2, 3, 4]
    assert fast['position_mean_m'] is None


def test_metrics_of_an_empty_flight_are_empty_and_strict_json(tmp_path):
    result = metrics(LogRecorder().log())
    write_json(tmp_path / 'out.json', {'meta': {}, 'x': result, 'y': float('nan')})
    back = json.loads((tmp_path / 'out.json').read_text())
    assert back['x']['poses'] == []
    assert back['y'] is None
