"""Generator and baselines, written independently, agree about the described robot."""

from gap_data.baselines.answer import fit
from gap_data.baselines.logs import load
from gap_data.baselines.residual import jacobian, Model, SIZE, SLICES
from gap_data.cases import Case
from gap_data.make import make_case
import numpy as np
import pytest


@pytest.fixture(scope='module')
def quiet(tmp_path_factory):
    folder = tmp_path_factory.mktemp('quiet')
    case = Case('none', 'clean', 11, command_age=0.01, duration=15.0, fit=1, holdout=0)
    made = make_case(case, folder / 'flights', folder / 'sealed')
    start, slopes = jacobian(load(made / 'fit_1'), Model(made / 'robot.yaml'))
    scale = np.sqrt((start ** 2).mean(axis=0))
    return start, (slopes / scale[:, None]).reshape(-1, SIZE), (start / scale).ravel()


# largest estimate of an effect in a flight without effects [unit of the effect]
BOUNDS = {'mass': 0.003, 'centre_of_mass': 1e-4, 'thrust_coefficient': 1e-3,
          'torque_coefficient': 1e-4, 'rotor_lag': 0.0015, 'command_latency': 5e-4,
          'joint_command_latency': 3e-4, 'joint_feedback_delay': 5e-4, 'mocap_time_offset': 1e-3,
          'imu_filter_lag': 1e-3, 'joint_offset': 2e-3, 'joint_deflection': 2e-5, 'wind': 0.03,
          'imu_accelerometer_bias': 0.01, 'imu_gyroscope_bias': 1e-3, 'imu_misalignment': 2e-3,
          'imu_lever_arm': 3e-3, 'mocap_misalignment': 2e-3, 'propeller_gyroscopic_torque': 5e-4}


@pytest.mark.parametrize('name', BOUNDS)
def test_a_quiet_flight_shows_no_effect(quiet, name):
    _, columns, target = quiet
    theta, _ = fit(columns, target, [name])
    assert np.abs(theta[SLICES[name]]).max() < BOUNDS[name]


def test_servos_follow_the_described_equation(quiet):
    start, _, _ = quiet
    assert np.sqrt((start[:, 12:] ** 2).mean()) < 5e-4  # [rad] half an encoder count
