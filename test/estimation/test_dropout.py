"""Dropouts, outliers, jumps: the status and the recovery of the filter."""

from dataclasses import replace

from ekf_flights import error_state, feed, fly, ImuReading, new_ekf, run, Sensors
import numpy as np
import pytest

from beetle_omni_ros.estimation import ekf as ekf_module
from beetle_omni_ros.estimation.ekf import EkfParameters, JUMP_POSES
from beetle_omni_ros.model import rotations


def history(ekf, flight, drop=lambda time: False):
    """Feed a flight; list (time, status, position variance) after each IMU sample."""
    rows = []
    for time, sample in flight.arrivals():
        if isinstance(sample, ImuReading):
            feed(ekf, sample)
            variance = ekf.estimate.covariance[0, 0] if ekf.estimate else np.inf
            rows.append((time, ekf.status, variance))
        elif not drop(sample.stamp):
            feed(ekf, sample)
    return rows


@pytest.mark.parametrize('seed', range(2))
def test_half_a_second_without_mocap_costs_less_than_5_cm_and_1_deg(seed):
    sensors = Sensors.matching(EkfParameters.load(), seed)
    flight = fly(seed, 4.5, sensors)
    ekf = run(new_ekf(), flight, drop=lambda time: time > 4.0)
    error = error_state(ekf.estimate, flight)
    assert ekf.status == 'dead_reckoning'
    assert ekf.estimate.stamp == pytest.approx(4.5)
    assert np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[6:9]) < np.deg2rad(1)


def test_a_dropout_changes_status_and_covariance(monkeypatch):
    monkeypatch.setattr(ekf_module, 'LOST', 2.0)
    ekf, flight = new_ekf(), fly(1, 6.0)
    rows = history(ekf, flight, drop=lambda time: 2.0 < time < 4.8)
    by_time = {round(time, 3): (status, variance) for time, status, variance in rows}
    assert by_time[0.1][0] == 'uninitialised'
    assert by_time[1.9][0] == 'tracking'
    assert by_time[2.0 + ekf_module.DEAD_RECKONING + 0.02][0] == 'dead_reckoning'
    assert by_time[2.0 + 2.0 + 0.02][0] == 'lost'
    assert by_time[5.9][0] == 'tracking'
    growing = [variance for time, _, variance in rows if 2.02 < time < 4.8]
    assert np.all(np.diff(growing) > 0)
    assert by_time[5.9][1] < 4 * by_time[1.9][1]
    error = error_state(ekf.estimate, flight)       # after a second start, at the robot
    assert np.linalg.norm(error[:3]) < 0.005 and np.linalg.norm(error[6:9]) < np.deg2rad(0.5)


@pytest.mark.parametrize('shift, turn', [(0.05, 0.0), (0.0, 0.2), (1.0, 3.1)])
def test_single_outliers_are_refused_and_leave_no_trace(shift, turn):
    flight = fly(4, 3.0)
    clean = fly(4, 3.0)
    outliers = range(100, 300, 10)
    for k in outliers:
        pose = flight.poses[k]
        flight.poses[k] = replace(
            pose, position=pose.position + shift,
            quaternion=rotations.multiply(pose.quaternion, rotations.exp((turn, 0, 0))))
    clean.poses = [pose for k, pose in enumerate(clean.poses) if k not in outliers]
    ekf, reference = new_ekf(), new_ekf()
    results = [(feed(ekf, sample), sample) for _, sample in flight.arrivals()]
    run(reference, clean)
    refused = [sample.stamp for accepted, sample in results if not accepted]
    assert refused == [flight.poses[k].stamp for k in outliers]
    assert ekf.rejected == {'outlier': len(outliers)}
    # only the noise estimated around the outliers may change the weight of the good poses
    np.testing.assert_allclose(ekf.estimate.position, reference.estimate.position, atol=5e-4)
    assert ekf.status == 'tracking'


SHIFT = np.array([0.5, -0.3, 0.2])


@pytest.mark.parametrize('shift, turn', [(SHIFT, 0.0), (0 * SHIFT, np.pi / 2)])
def test_a_lasting_jump_is_followed_after_a_delay_unless_the_gyroscope_contradicts(shift, turn):
    """From 2 s on MoCap has moved, or markers are confused: poses turn about the body z axis."""
    flight, turned = fly(5, 5.0), rotations.exp(np.array([0.0, 0.0, turn]))
    flight.poses = [pose if pose.stamp <= 2.0 else replace(
        pose, position=pose.position + shift,
        quaternion=rotations.multiply(pose.quaternion, turned)) for pose in flight.poses]
    ekf = new_ekf()
    rows = history(ekf, flight)
    back = 2.0 + 0.01 * (JUMP_POSES + 5)
    assert {s for time, s, _ in rows if 2.2 < time < back - 0.1} == {'dead_reckoning'}
    assert {s for time, s, _ in rows if time > back} == {'dead_reckoning' if turn else 'tracking'}
    error = error_state(ekf.estimate, flight)
    assert np.linalg.norm(error[6:9]) < np.deg2rad(2)
    assert turn or np.linalg.norm(error[:3] + shift) < 0.01


@pytest.mark.parametrize('fault', [lambda force: force / 9.80665,
                                   lambda force: force[:, [1, 2, 0]]])
def test_an_imu_that_contradicts_gravity_never_starts_the_filter(fault):
    """The IMU is in units of g, or with swapped axes."""
    flight = fly(8, 2.0, agility=0.3)
    forces = fault(np.array([sample.specific_force for sample in flight.imu]))
    flight.imu = [replace(sample, specific_force=f) for sample, f in zip(flight.imu, forces)]
    ekf = run(new_ekf(), flight)
    assert ekf.status != 'tracking'
    assert ekf.rejected['inconsistent_start'] + ekf.rejected['outlier'] > 0


STRUCK = 3.0    # [s]
FAULTS = {
    'x is dead': lambda rate: rate * [0, 1, 1],
    'bias of 2 rad/s about y': lambda rate: rate + [0, 2, 0],
}


@pytest.mark.parametrize('fault', FAULTS)
def test_the_rate_follows_the_poses_if_the_gyroscope_misses_a_rotation(fault):
    flight = fly(0, 6.0, agility=2.0)
    flight.imu = [sample if sample.stamp < STRUCK else replace(
        sample, angular_velocity=FAULTS[fault](sample.angular_velocity)) for sample in flight.imu]
    ekf, found = new_ekf(), []
    for _, sample in flight.arrivals():
        feed(ekf, sample)
        if ekf.estimate is not None and ekf.estimate.stamp > STRUCK + 0.1:
            assert ekf.status == 'tracking'
            found.append(ekf.estimate)
    truth = flight.trajectory(np.array([e.stamp for e in found]))
    hidden = np.linalg.norm(FAULTS[fault](truth['rate']) - truth['rate'], axis=1)
    error = np.linalg.norm([e.angular_velocity for e in found] - truth['rate'], axis=1)
    assert hidden.max() > 1.0
    assert error.max() < 0.33 * hidden.max()
