"""Bad input is refused and counted, and changes nothing; noise of the MoCap is measured."""

from copy import deepcopy
from dataclasses import replace
import warnings

from ekf_flights import feed, fly, new_ekf, run, Sensors
import numpy as np
import pytest

from beetle_omni_ros.estimation.inputs import LONGEST_HELD, NoiseMonitor, SpikeFilter
from beetle_omni_ros.estimation.parameters import MocapParameters

NAN, INF, HUGE = np.nan, np.inf, 1e200


@pytest.fixture(scope='module')
def flown():
    """A flight, a filter in the middle of it, and one after it."""
    flight = fly(1, 2.5)
    middle = run(new_ekf(), flight, until=1.5)
    assert middle.status == 'tracking' and not middle.rejected
    return flight, middle, run(new_ekf(), flight)


@pytest.fixture
def flying(flown):
    """A filter in the middle of a flight, and the flight."""
    return deepcopy(flown[1]), flown[0]


def vector(value, size=3):
    """One bad element."""
    return np.array([0.1] * (size - 1) + [value])


BAD_IMU = [
    ('not_finite', {'stamp': NAN}), ('not_finite', {'specific_force': vector(INF)}),
    ('not_finite', {'angular_velocity': vector(NAN)}),
    ('out_of_range', {'specific_force': vector(HUGE)}),
    ('out_of_range', {'angular_velocity': vector(-100.0)}),
    ('duplicate', {'ahead': 0.0}), ('backwards', {'ahead': -0.001}),
    ('forward_gap', {'ahead': 0.5})]
BAD_POSE = [
    ('not_finite', {'stamp': -INF}), ('not_finite', {'position': vector(NAN)}),
    ('not_finite', {'quaternion': vector(INF, 4)}), ('out_of_range', {'position': vector(-HUGE)}),
    ('quaternion_norm', {'quaternion': np.zeros(4)}),
    ('quaternion_norm', {'quaternion': np.array([0, 0, 0, 1.1])}),
    ('duplicate', {'ahead': 0.0}), ('backwards', {'ahead': -0.02}), ('future', {'ahead': 5.0}),
    ('frozen', {})]


def refused(ekf, sample, reason):
    """Give ``sample``; it must be refused for ``reason`` and change nothing."""
    before, status = ekf.estimate, ekf.status
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert feed(ekf, sample) is False
    assert ekf.rejected == {reason: 1}
    after = ekf.estimate
    assert ekf.status == status and after.stamp == before.stamp
    for name in ('position', 'velocity', 'quaternion', 'covariance'):
        assert np.array_equal(getattr(after, name), getattr(before, name))


def continued(ekf, flight, after, undisturbed):
    """Finish the flight; the filter must track as without the refused input."""
    for time, sample in flight.arrivals():
        if time > after:
            feed(ekf, sample)
    assert ekf.status == 'tracking'
    np.testing.assert_allclose(ekf.estimate.position, undisturbed.estimate.position, atol=1e-4)


@pytest.mark.parametrize('kind, reason, change', [
    *(('imu', *row) for row in BAD_IMU), *(('poses', *row) for row in BAD_POSE)])
def test_a_bad_sample_is_refused_without_effect(flying, flown, kind, reason, change):
    (ekf, flight), change = flying, dict(change)
    delay = flight.delay if kind == 'poses' else 0.0
    last = [s for s in getattr(flight, kind) if s.stamp + delay <= 1.5 + 1e-9][-1]
    stamp = last.stamp + change.pop('ahead', 0.005)
    refused(ekf, replace(last, **{'stamp': stamp, **change}), reason)
    continued(ekf, flight, 1.5, flown[2])


def test_a_pose_older_than_the_history_is_refused():
    flight = fly(2, 1.0)
    ekf = new_ekf()
    run(ekf, flight, drop=lambda time: time > 0.3)
    stale = next(s for s in flight.poses if s.stamp > 0.5)
    refused(ekf, stale, 'too_old')


@pytest.mark.parametrize('jump', [-1000.0, 7.0])
def test_a_permanent_clock_jump_reinitialises_the_filter(jump):
    """Simulated time restarts, or the IMU was silent for long."""
    flight = fly(7, 4.0)
    flight.imu = [replace(s, stamp=s.stamp + jump) if s.stamp > 2.0 else s for s in flight.imu]
    flight.poses = [replace(s, stamp=s.stamp + jump) if s.stamp > 2.0 else s for s in flight.poses]
    ekf, statuses = new_ekf(), []
    events = [(0.005 * k, 0, s) for k, s in enumerate(flight.imu)]
    events += [(0.01 * k + flight.delay, 1, s) for k, s in enumerate(flight.poses)]
    for _, _, sample in sorted(events, key=lambda event: (round(event[0], 7), event[1])):
        feed(ekf, sample)
        statuses.append(ekf.status)
    assert 'uninitialised' in statuses[200:] and statuses[-1] == 'tracking'
    truth = flight.trajectory(np.array([ekf.estimate.stamp - jump]))
    np.testing.assert_allclose(ekf.estimate.position, truth['position'][0], atol=0.005)


def scale_after(poses):
    """Feed poses to a monitor with the default noise; factors on the variances."""
    claim = MocapParameters()
    monitor = NoiseMonitor(claim)
    for pose in poses:
        monitor.add(pose.stamp, pose.position, pose.quaternion)
    return np.diag(monitor.covariance)[[0, 3]] / np.square(
        [claim.position_noise, claim.orientation_noise])


@pytest.mark.parametrize('position, orientation', [(5.0, 1.0), (1.0, 4.0)])
def test_excess_noise_is_estimated_for_each_measurement_kind(position, orientation):
    claim = MocapParameters()
    sensors = Sensors(position_noise=position * claim.position_noise,
                      orientation_noise=orientation * claim.orientation_noise)
    scale = np.sqrt(scale_after(fly(2, 8.0, sensors).poses))
    np.testing.assert_allclose(scale, [position, orientation], rtol=0.25)


# Spikes of the IMU ----------------------------------------------------------------------------

LEVEL, REST = np.array([0.0, 0.0, 9.81]), np.zeros(3)


def used(readings):
    """Which of the readings (force, rate) pass a filter that has seen rest, and how it ended."""
    checked = SpikeFilter()
    assert checked.passes(LEVEL, REST)
    return [checked.passes(*reading) for reading in readings], checked


def test_independent_errors_in_a_row_rarely_pass():
    random, confirmed = np.random.default_rng(0), 0
    for _ in range(1000):
        errors = random.normal(size=(2, 6))
        errors *= 3 / np.linalg.norm(errors, axis=1, keepdims=True)
        passed, _ = used([(LEVEL + 30 * error[:3], REST + 3 * error[3:]) for error in errors])
        assert not passed[0]
        confirmed += passed[1]
    assert confirmed < 70       # 5 % of 1000, and three standard deviations


def test_an_impact_that_fades_passes_with_its_second_reading():
    passed, checked = used([(LEVEL * 20, np.array([4.0, 0, 0])),
                            (LEVEL * 8, np.array([6.0, 1, 0]))])
    assert passed == [False, True]
    assert checked.passes(LEVEL * 8, np.array([6.0, 1, 0]))


def test_readings_that_go_on_jumping_are_not_held_back_for_ever():
    sign = np.resize([1, -1], LONGEST_HELD + 1)
    passed, checked = used([(LEVEL + 90 * s, REST) for s in sign])
    assert passed == [False] * LONGEST_HELD + [True]
