"""An IMU and a marker body anywhere on the robot give base_link's state."""

from dataclasses import replace

from ekf_flights import error_state, fly, GRAVITY, run, Sensors
import numpy as np
import pytest

from beetle_omni_ros.estimation.ekf import EkfParameters, ErrorStateEkf

MOUNTINGS = {
    'imu_offset': {'imu_position': (0.12, -0.05, 0.08)},
    'imu_rotated': {'imu_rotation': (0.4, -1.2, 2.0)},
    'marker_offset': {'mocap_position': (0.03, 0.1, 0.15)},
    'marker_rotated': {'mocap_rotation': (-0.3, 0.2, 1.5)},
    'all': {'imu_position': (0.12, -0.05, 0.08), 'imu_rotation': (0.4, -1.2, 2.0),
            'mocap_position': (0.03, 0.1, 0.15), 'mocap_rotation': (-0.3, 0.2, 1.5)},
}


def parameters_for(mounting):
    """The shipped parameters with the mounting of the sensors and equal clocks."""
    shipped = EkfParameters.load()
    changes = {'imu': {}, 'mocap': {}}
    for name, value in mounting.items():
        sensor, field = name.split('_')
        changes[sensor][field] = np.array(value)
    return replace(shipped, imu=replace(shipped.imu, **changes['imu']),
                   mocap=replace(shipped.mocap, **changes['mocap']),
                   initial=replace(shipped.initial, time_offset_std=0.0))


def final_error(mounting, parameters, imu_period):
    """Error state after a noise-free flight."""
    flight = fly(1, 2.0, Sensors.perfect(**mounting), imu_period=imu_period)
    parameters = replace(parameters, imu=replace(parameters.imu, rate=1 / imu_period))
    ekf = run(ErrorStateEkf(parameters, GRAVITY), flight)
    assert ekf.status == 'tracking' and not ekf.rejected
    return error_state(ekf.estimate, flight)


@pytest.mark.parametrize('name', MOUNTINGS)
def test_a_noise_free_flight_is_recovered_up_to_the_integration_error(name):
    """The remaining error is that of the trapezoidal rule, which falls with the step."""
    mounting = MOUNTINGS[name]
    error = final_error(mounting, parameters_for(mounting), 0.005)
    fine = final_error(mounting, parameters_for(mounting), 0.00125)
    assert np.linalg.norm(error[:3]) < 1e-4 and np.linalg.norm(error[6:9]) < 1e-4
    assert np.linalg.norm(error[3:6]) < 2e-3
    assert np.linalg.norm(fine[:3]) < 1e-5 and np.linalg.norm(fine[3:6]) < 2e-4
    assert np.linalg.norm(fine[6:9]) < 1e-5


@pytest.mark.parametrize('name', MOUNTINGS)
def test_ignoring_a_mounting_is_much_worse(name):
    """Without the mounting, the test above would fail."""
    mounting = MOUNTINGS[name]
    flight = fly(1, 2.0, Sensors.perfect(**mounting))
    ekf = run(ErrorStateEkf(parameters_for({}), GRAVITY), flight)
    if ekf.status == 'tracking' and not ekf.rejected:
        error = error_state(ekf.estimate, flight)
        assert np.linalg.norm(error[:3]) > 0.01 or np.linalg.norm(error[6:9]) > 0.01


def test_offset_sensors_stay_consistent():
    mounting = MOUNTINGS['all']
    parameters, nees = parameters_for(mounting), []
    for seed in range(20):
        flight = fly(seed, 1.5, Sensors.matching(parameters, seed))
        estimate = run(ErrorStateEkf(parameters, GRAVITY), flight).estimate
        error = error_state(estimate, flight)
        nees.append(error @ np.linalg.solve(estimate.covariance, error))
    assert 15 - 5 < np.mean(nees) < 15 + 5  # four standard deviations of the mean of 20
