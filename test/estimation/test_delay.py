"""Poses are used at their capture time, for any time of arrival."""

from dataclasses import replace

from ekf_flights import error_state, feed, fly, new_ekf, run
import numpy as np
import pytest

from beetle_omni_ros.estimation.ekf import PoseReading


@pytest.mark.parametrize(('delay', 'capture'), [(0.037, 0.0), (0.13, 0.0017)])
def test_replay_equals_processing_in_order(delay, capture):
    """For any latency of poses and any phase relative to the IMU samples."""
    flight = fly(1, 1.5)
    poses = flight.trajectory(np.array([s.stamp + capture for s in flight.poses]))
    flight.poses = [PoseReading(s.stamp + capture, p, q) for s, p, q in
                    zip(flight.poses, poses['position'], poses['rotation'].as_quat())
                    if s.stamp + capture + delay < 1.49]
    flight.delay = delay
    late = run(new_ekf(), flight).estimate
    flight.delay = 0.0
    prompt = run(new_ekf(), flight).estimate
    for name in ('position', 'velocity', 'quaternion'):
        np.testing.assert_allclose(getattr(late, name), getattr(prompt, name), atol=1e-9)
    np.testing.assert_allclose(late.covariance, prompt.covariance, rtol=1e-6, atol=1e-12)


def test_latency_in_imu_stamps_is_estimated_and_compensated():
    age = 0.025
    flight = fly(4, 6.0, agility=0.5)
    flight.imu = [replace(s, stamp=s.stamp + age) for s in flight.imu]
    ekf = run(new_ekf(), flight)
    assert ekf.status == 'tracking'
    error = error_state(replace(ekf.estimate, stamp=ekf.estimate.stamp - age), flight)
    truth = flight.trajectory(np.array([ekf.estimate.stamp, ekf.estimate.stamp - age]))
    assert np.linalg.norm(ekf.estimate.position - truth['position'][0]) < 0.004
    assert np.linalg.norm(error[:3]) > 0.5 * age * np.linalg.norm(truth['velocity'][0])


def test_a_late_angular_rate_is_extrapolated_linearly():
    """The error in motion is less than half of that of holding the last reading."""
    age, flight = 0.025, fly(4, 6.0)
    flight.imu = [replace(s, stamp=s.stamp + age) for s in flight.imu]
    ekf, found = new_ekf(), []
    for _, sample in flight.arrivals():
        feed(ekf, sample)
        if ekf.estimate is not None and ekf.estimate.stamp > 4.0:
            found.append(ekf.estimate)
    stamps = np.array([e.stamp for e in found])
    truth, held = flight.trajectory(stamps)['rate'], flight.trajectory(stamps - age)['rate']
    error = np.array([e.angular_velocity for e in found]) - truth
    assert np.sqrt(np.mean(error ** 2)) < 0.5 * np.sqrt(np.mean((held - truth) ** 2))


def test_late_stamps_of_the_mocap_do_not_shift_the_estimate_in_time():
    """Poses stamped on arrival seem too late, so that the clock of the IMU is the right one."""
    flight = fly(5, 6.0, agility=0.5)
    flight.poses = [replace(s, stamp=s.stamp + 0.012) for s in flight.poses]
    flight.delay = 0.0
    ekf = run(new_ekf(), flight)
    assert ekf.status == 'tracking'
    error = error_state(ekf.estimate, flight)
    assert np.linalg.norm(error[:3]) < 0.004 and np.linalg.norm(error[6:9]) < np.deg2rad(0.3)
