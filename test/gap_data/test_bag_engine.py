"""Bags under the flight engine, flown by the independent simulator."""

from dataclasses import replace

from gap_data.cases import Case
from gap_data.make import make_case
from gap_data.truth import Robot
import numpy as np
import pytest

from beetle_omni_ros.identify.flights.bag_flight import BagFlight
from beetle_omni_ros.identify.flights.body import BodyModel
from beetle_omni_ros.identify.flights.keys import all_keys, extra_keys
from beetle_omni_ros.identify.flights.verdict import judged
from beetle_omni_ros.identify.recording.bag import IMU, JOINTS, POSE, read_recording
from beetle_omni_ros.identify.recording.flight import prepare
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.model.parameters import RobotParameters

P, ROBOT = GapParameters.load(), RobotParameters.load()


def flights(folder, seed, *effects, duration=40.0, fit=2, holdout=0, **more):
    """Prepared flights of one case, the held-out ones last."""
    case = Case('singles' if effects else 'none', 'hard', seed, effects, duration=duration,
                gust=True, multibody=True, tolerance=True, fit=fit, holdout=holdout, **more)
    made = make_case(case, folder / 'flights', folder / 'sealed')
    return [prepare(read_recording(path), ROBOT, P) for path in sorted(made.glob('*_?'))]


def names(result):
    return [name for effect in result['effects'] for name in effect['names']]


def test_feedback_of_gusts_in_a_smooth_task_is_no_effect(tmp_path):
    smooth = flights(tmp_path, 952385194, course='lemniscate', conditions='published',
                     duration=60.0, fit=1)      # without the test of bands, the inertia is named
    result = judged(smooth, [], ROBOT, P)
    assert names(result) == [] and result['false_alarm_probability'] > 0.05


def test_a_late_mocap_is_named_although_it_is_noisy(tmp_path):
    late = flights(tmp_path, 5, ('mocap_time_offset', 0.015, 'plain'), course='lemniscate',
                   conditions='published', duration=30.0)
    result = judged(late, [], ROBOT, P)
    assert names(result) == ['mocap_time_offset']
    low, high = result['effects'][0]['parameters']['delay']['interval']
    assert low - 0.002 < 0.015 < high


def test_a_hidden_effect_is_named_though_the_sensors_differ_from_flight_to_flight(tmp_path):
    rng, bias = np.random.default_rng(1), np.repeat([0.05, 0.004], 3)
    made = [replace(each, times=each.times | {
        topic: each.times[topic] + rng.uniform(-0.008, 0.008) for topic in (POSE, JOINTS)},
        values=each.values | {IMU: each.values[IMU] + rng.normal(size=6) * bias})
        for each in flights(tmp_path, 6, ('rotor_drag', 0.6, 'plain'), duration=30.0, holdout=1)]
    result = judged(made[:2], made[2:], ROBOT, P)
    assert result['verdict'] == 'named' and names(result) == ['rotor_drag']
    found = result['effects'][0]['parameters']['coefficient']
    assert found['interval'][0] < 0.6 < found['interval'][1]
    assert found['value'] == pytest.approx(0.6, rel=0.2)
    assert result['closure'] > 0.8
    assert any('joint feedback delay differs' in finding for finding in result['findings'])


def one_flight(folder, *effects, **more):
    """The engine's model of one short flight."""
    keys = {**all_keys(ROBOT), **extra_keys(ROBOT)}
    flight, = flights(folder, 7, *effects, duration=20.0, fit=1, **more)
    return BagFlight(flight, ROBOT, BodyModel(ROBOT, keys, (0.0, 0.0)), keys, P)


def test_gains_loads_and_inertia_of_a_servo_have_one_common_factor(tmp_path):
    made = one_flight(tmp_path)
    made.modules = 1.0
    factor = ['joint_bandwidth.kp', 'joint_bandwidth.kd', 'swing.ratio', 'modules.share']
    slopes = made.linear({}, factor).slopes[:, 12:]
    assert np.abs(slopes.sum(axis=2)).max() < 1e-3 * np.abs(slopes).max()


def test_a_limited_servo_of_another_plant_has_the_torque_and_speed_of_its_motor(tmp_path):
    made = one_flight(tmp_path, ('joint_velocity_limit', 3.2, 'plain'))
    made.modules, motor = 1.0, Robot().numbers['speed_torque_slope']
    limit = 'joint_velocity_limit.velocity_limit'
    fitted = [limit, 'droop.ratio', 'swing.ratio', 'base.tilt_delay', *(
        f'servo.{gain}[{k}]' for gain in ('kp', 'kd') for k in range(4))]
    theta = dict.fromkeys(fitted, 0.0) | {limit: np.log(0.34)}
    for _ in range(4):
        linear = made.linear(theta, fitted)
        step = np.linalg.lstsq(linear.slopes[:, 12:].reshape(-1, len(fitted)),
                               -linear.residual[:, 12:].ravel(), rcond=None)[0]
        theta = {name: theta[name] + part for name, part in zip(fitted, step, strict=True)}
    assert ROBOT.joints.velocity_limit * np.exp(theta[limit]) == pytest.approx(3.3, rel=5e-3)
    assert ROBOT.joints.speed_gradient * np.exp(theta['droop.ratio']) * motor == pytest.approx(
        1.0, rel=0.1)


def test_slopes_agree_with_differences_of_the_residual(tmp_path):
    made = one_flight(tmp_path, noise=0.0)      # which the slopes must not explain
    some = ['mass.mass', 'imu_misalignment.rotation[1]', 'mocap_time_offset.delay',
            'imu_filter_lag.delay', 'joint_command_latency.delay', 'rotor_lag.time_constant']
    linear = made.linear({}, some)
    for k, name in enumerate(some):
        step = 0.3 * made.keys[name].smallest
        ahead, behind = (made.linear({name: s * step}, []).residual for s in (1, -1))
        slope = (ahead - behind) / (2 * step)
        assert np.abs(slope - linear.slopes[..., k]).max() < 0.1 * np.abs(slope).max()
