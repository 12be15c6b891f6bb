"""The estimator on the multibody simulator, from the drop at the start to large turns."""

from dataclasses import replace

from ekf_flights import feed
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.hover import HoverController, HoverParameters
from beetle_omni_ros.estimation.ekf import EkfParameters, ErrorStateEkf
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.sim.simulator import Simulator

DURATION, HEIGHT, POSE_TIME = 8.0, 2.0, 2.0


def fly(conditions, seed, true=None, nominal=None):
    """Fly random poses on the true state; yield the estimator with the truth."""
    robot = true or RobotParameters.load()
    simulator = Simulator(robot, conditions=conditions, seed=seed)
    hover = HoverController(robot, HoverParameters.load())
    hover.reset()
    simulator.reset(np.array([0.0, 0.0, HEIGHT + 1]))
    parameters = EkfParameters.load().of_robot(nominal or RobotParameters.load())
    ekf, rng = ErrorStateEkf(parameters, robot.gravity), np.random.default_rng(seed)
    target, command = PoseTarget(np.array([0, 0, HEIGHT]), np.array([0, 0, 0, 1.0])), None
    for k in range(round(DURATION / simulator.tick)):
        frame = simulator.step()
        truth = frame.truth
        if k % round(POSE_TIME / simulator.tick) == 0 and k:
            quaternion = Rotation.random(random_state=int(rng.integers(2 ** 31))).as_quat()
            target = PoseTarget(np.append(rng.uniform(-1, 1, 2), HEIGHT), quaternion)
        if frame.mocap is not None:
            feed(ekf, frame.mocap)
        feed(ekf, frame.imu)
        if k % 2 == 0:
            command = hover.step(
                State(truth.stamp, truth.position, truth.velocity, truth.quaternion,
                      truth.angular_velocity, truth.tilt, truth.tilt_velocity, truth.stamp,
                      command), target)
            simulator.command(command)
        yield ekf, truth


def errors(ekf, truth):
    """Position [m], velocity [m/s] and attitude [rad] errors."""
    estimate = ekf.estimate
    return (np.linalg.norm(estimate.position - truth.position),
            np.linalg.norm(estimate.velocity - truth.velocity),
            rotations.geodesic_angle(estimate.quaternion, truth.quaternion))


@pytest.mark.parametrize('conditions, position, velocity, angle', [
    ('nominal', 0.002, 0.015, np.deg2rad(0.15)),
    # bias of the MoCap, which is unobservable: 0.01 m and 0.01 rad an axis
    ('published', 0.025, 0.1, np.deg2rad(1.5)),
])
def test_flight_is_tracked_all_the_way(conditions, position, velocity, angle):
    rows = []
    for ekf, truth in fly(conditions, seed=0):
        if truth.stamp > 1.0:
            assert ekf.status == 'tracking'
        if truth.stamp > 3.0:
            rows.append(errors(ekf, truth))
    rms = np.sqrt(np.mean(np.square(rows), axis=0))
    assert rms[0] < position and rms[1] < velocity and rms[2] < angle


HIDDEN = {     # values, compared seconds of flight, columns of the errors, improvement
    'imu_misalignment': ({'rotation': (0.03, -0.02, 0.025)}, (0.5, 4.0), (0, 1, 2), 2.0),
    'mocap_misalignment': ({'rotation': (0.02, -0.02, 0.01)}, (0.5, 4.0), (0, 1, 2), 3.0),
    'imu_lever_arm': ({'offset': (0.06, -0.04, 0.05)}, (0.5, 4.0), (0, 1, 2), 1.5),
    'mocap_time_offset': ({'delay': 0.02}, (0.5, 4.0), (0, 1, 2), 1.2),
    # biases that the filter estimates matter at the start only
    'imu_filter_lag': ({'delay': 0.015}, (0.0, 1.0), (1,), 1.2)}


@pytest.mark.parametrize('name', HIDDEN)
def test_sensor_effects_of_the_robot_file_improve_the_estimate(name):
    values, (first, last), columns, better = HIDDEN[name]
    true = replace(RobotParameters.load(), effects={name: values})

    def error(nominal):
        rows = []       # relative to a flight without fault
        for ekf, truth in fly('nominal', 3, true=true, nominal=nominal):
            if truth.stamp > last:
                break
            if truth.stamp > first and ekf.status == 'tracking':
                rows.append(errors(ekf, truth) / np.array([0.001, 0.01, 0.002]))
        return float(np.sqrt(np.mean(np.square(np.array(rows)[:, columns]))))

    uninformed, informed = error(None), error(true)
    assert informed < uninformed / better, f'{informed:.2f} against {uninformed:.2f}'
