"""The covariance matches the error of the estimate, with sensors anywhere on the robot."""

from dataclasses import replace

from ekf_flights import error_state, feed, fly, GRAVITY, new_ekf, run, Sensors
import numpy as np
import pytest
from scipy.stats import chi2

from beetle_omni_ros.estimation.ekf import EkfParameters, ErrorStateEkf

FLIGHTS, DURATION, STATES = 50, 2.0, 15
CHECKED = (0.5, 2.0)    # [s] instants of each flight
MOUNTING = {'imu_position': (0.12, -0.05, 0.08), 'imu_rotation': (0.4, -1.2, 2.0),
            'mocap_position': (0.03, 0.1, 0.15), 'mocap_rotation': (-0.3, 0.2, 1.5)}


def parameters_for(mounting):
    """The shipped parameters with the mounting of the sensors and equal clocks."""
    shipped = EkfParameters.load()
    changes = {'imu': {'delay_std': 0.0}, 'mocap': {}}
    for name, value in mounting.items():
        sensor, field = name.split('_')
        changes[sensor][field] = np.array(value)
    return replace(shipped, imu=replace(shipped.imu, **changes['imu']),
                   mocap=replace(shipped.mocap, **changes['mocap']))


@pytest.fixture(scope='module')
def flights():
    """Error and covariance of each flight, with offset sensors, at each checked instant."""
    parameters = parameters_for(MOUNTING)
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
def test_nees_of_all_states_and_of_each_block_is_inside_its_band(flights, instant):
    """The uncertainty of no block of states is over- or underestimated."""
    for part, band in ((slice(None), 0.025), *((slice(k, k + 3), 0.001)
                                               for k in range(0, STATES, 3))):
        nees = [error[part] @ np.linalg.solve(covariance[part, part], error[part])
                for error, covariance in (rows[instant] for rows in flights)]
        low, high = chi2.ppf([band, 1 - band], FLIGHTS * len(range(STATES)[part])) / FLIGHTS
        assert low < np.mean(nees) < high, part


def test_absolute_ros_time_does_not_change_the_estimate():
    """At 1.8e9 s a double resolves 0.2 us, which must not change the estimate."""
    flight, late = fly(9, 2.0), fly(9, 2.0)
    shift = 1.8e9
    late.imu = [replace(s, stamp=s.stamp + shift) for s in late.imu]
    late.poses = [replace(s, stamp=s.stamp + shift) for s in late.poses]
    a = run(new_ekf(), flight).estimate
    b = run(new_ekf(), late).estimate
    np.testing.assert_allclose(a.position, b.position, atol=1e-5)
    np.testing.assert_allclose(a.quaternion, b.quaternion, atol=1e-5)
