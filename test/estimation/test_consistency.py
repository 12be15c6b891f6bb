"""The covariance matches the error of the estimate."""

from dataclasses import replace

from ekf_flights import error_state, feed, fly, GRAVITY, run, Sensors
import numpy as np
import pytest
from scipy.stats import chi2

from beetle_omni_ros.estimation.ekf import EkfParameters, ErrorStateEkf
from beetle_omni_ros.estimation.model import ErrorStateModel
from beetle_omni_ros.estimation.track import Track

FLIGHTS, DURATION, STATES = 50, 3.0, 15
CHECKED = (0.5, 1.0, 2.0, 3.0)  # [s] instants of each flight


@pytest.fixture(scope='module')
def flights():
    """Error and covariance of each flight at each checked instant."""
    parameters = EkfParameters.load()
    outcome = []
    for seed in range(FLIGHTS):
        flight = fly(seed, DURATION, Sensors.matching(parameters, seed))
        ekf, rows = ErrorStateEkf(parameters, GRAVITY), []
        for time, sample in flight.arrivals():
            feed(ekf, sample)
            if len(rows) < len(CHECKED) and time >= CHECKED[len(rows)] - 1e-9:
                rows.append((error_state(ekf.estimate, flight), ekf.estimate.covariance))
        outcome.append(rows)
    return outcome


@pytest.mark.parametrize('instant', range(len(CHECKED)))
def test_nees_is_inside_its_95_percent_band(flights, instant):
    nees = [error @ np.linalg.solve(covariance, error)
            for error, covariance in (rows[instant] for rows in flights)]
    low, high = chi2.ppf([0.025, 0.975], FLIGHTS * STATES) / FLIGHTS
    assert low < np.mean(nees) < high


@pytest.mark.parametrize('block', range(5))
def test_each_block_of_states_is_consistent_by_itself(flights, block):
    """The uncertainty of each block of states is neither over- nor underestimated."""
    part = slice(3 * block, 3 * block + 3)
    nees = [error[part] @ np.linalg.solve(covariance[part, part], error[part])
            for error, covariance in (rows[-1] for rows in flights)]
    low, high = chi2.ppf([0.001, 0.999], FLIGHTS * 3) / FLIGHTS
    assert low < np.mean(nees) < high


def test_biases_are_recovered():
    parameters = EkfParameters.load()
    sensors = Sensors(accelerometer_bias=np.array([0.3, -0.2, 0.1]),
                      gyroscope_bias=np.array([0.03, -0.05, 0.02]))
    flight = fly(3, 8.0, sensors)
    estimate = run(ErrorStateEkf(parameters, GRAVITY), flight).estimate
    np.testing.assert_allclose(estimate.accelerometer_bias, sensors.accelerometer_bias, atol=0.01)
    np.testing.assert_allclose(estimate.gyroscope_bias, sensors.gyroscope_bias, atol=0.001)


def test_covariance_stays_symmetric_and_positive():
    ekf = ErrorStateEkf(EkfParameters.load(), GRAVITY)
    for _, sample in fly(5, 4.0).arrivals():
        feed(ekf, sample)
        if ekf.estimate is not None:
            covariance = ekf.estimate.covariance
            assert np.allclose(covariance, covariance.T, rtol=0, atol=1e-12)
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_covariance_does_not_depend_on_when_it_is_read():
    often, once = (ErrorStateEkf(EkfParameters.load(), GRAVITY) for _ in range(2))
    pairs = []
    for _, sample in fly(5, 2.0).arrivals():
        feed(often, sample), feed(once, sample)
        if often.estimate is not None:
            pairs.append((often.estimate.covariance, once.estimate))
    assert len(pairs) > 300
    assert all(np.array_equal(early, late.covariance) for early, late in pairs)


def test_pending_covariances_do_not_reach_beyond_the_history():
    model = ErrorStateModel(EkfParameters.load(), GRAVITY)
    force, still, history = np.array([0.0, 0.0, GRAVITY]), np.zeros(3), 0.2
    first = model.start(0.0, force, still, still, np.array([0.0, 0.0, 0.0, 1.0]), None)
    track = Track(model, first, history)
    for k in range(1, 200):
        track.predict(0.005 * k, force, still, False)
        steps = track.newest.pending()
        assert len(steps) < len(track.nodes) and steps[0][0].stamp >= track.nodes[0].stamp


def test_same_input_gives_the_same_numbers():
    flight = fly(6, 2.0)
    first, second = (run(ErrorStateEkf(EkfParameters.load(), GRAVITY), flight).estimate
                     for _ in range(2))
    assert np.array_equal(first.covariance, second.covariance)
    assert np.array_equal(first.quaternion, second.quaternion)


def test_after_reset_the_filter_equals_a_new_one():
    flight = fly(7, 1.5)
    ekf = run(ErrorStateEkf(EkfParameters.load(), GRAVITY), fly(8, 2.0))
    ekf.reset()
    assert ekf.status == 'uninitialised' and ekf.estimate is None and not ekf.rejected
    fresh = run(ErrorStateEkf(EkfParameters.load(), GRAVITY), flight).estimate
    assert np.array_equal(run(ekf, flight).estimate.covariance, fresh.covariance)


def test_absolute_ros_time_does_not_change_the_estimate():
    """At 1.8e9 s a double resolves 0.2 us, which must not change the estimate."""
    flight, late = fly(9, 2.0), fly(9, 2.0)
    shift = 1.8e9
    late.imu = [replace(s, stamp=s.stamp + shift) for s in late.imu]
    late.poses = [replace(s, stamp=s.stamp + shift) for s in late.poses]
    a = run(ErrorStateEkf(EkfParameters.load(), GRAVITY), flight).estimate
    b = run(ErrorStateEkf(EkfParameters.load(), GRAVITY), late).estimate
    np.testing.assert_allclose(a.position, b.position, atol=1e-5)
    np.testing.assert_allclose(a.quaternion, b.quaternion, atol=1e-5)
