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

HEIGHT, POSE_TIME = 2.0, 2.0
SHIPPED = RobotParameters.load()


def fly(conditions, seed, duration, robot=SHIPPED):
    """Frames of random poses, flown on the true state."""
    simulator = Simulator(robot, conditions=conditions, seed=seed)
    hover = HoverController(robot, HoverParameters.load())
    hover.reset()
    simulator.reset(np.array([0.0, 0.0, HEIGHT + 1]))
    rng, frames = np.random.default_rng(seed), []
    target, command = PoseTarget(np.array([0, 0, HEIGHT]), np.array([0, 0, 0, 1.0])), None
    for k in range(round(duration / simulator.tick)):
        frames.append(simulator.step())
        truth = frames[-1].truth
        if k % round(POSE_TIME / simulator.tick) == 0 and k:
            quaternion = Rotation.random(random_state=int(rng.integers(2 ** 31))).as_quat()
            target = PoseTarget(np.append(rng.uniform(-1, 1, 2), HEIGHT), quaternion)
        if k % 2 == 0:
            command = hover.step(
                State(truth.stamp, truth.position, truth.velocity, truth.quaternion,
                      truth.angular_velocity, truth.tilt, truth.tilt_velocity, truth.stamp,
                      command), target)
            simulator.command(command)
    return frames


def estimated(frames, robot=SHIPPED):
    """Yield the estimator of a robot file with the truth."""
    ekf = ErrorStateEkf(EkfParameters.load().of_robot(robot), robot.gravity)
    for frame in frames:
        if frame.mocap is not None:
            feed(ekf, frame.mocap)
        feed(ekf, frame.imu)
        yield ekf, frame.truth


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
    for ekf, truth in estimated(fly(conditions, 0, 8.0)):
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


def unlike_without_fault(frames, robot):
    """Times (N,) and errors (N, 3) relative to those of a flight without fault."""
    rows = [(truth.stamp, *errors(ekf, truth)) for ekf, truth in estimated(frames, robot)
            if ekf.status == 'tracking']
    return np.split(np.array(rows) / [1, 0.001, 0.01, 0.002], [1], axis=1)


def with_effects(*names):
    return replace(SHIPPED, effects={name: HIDDEN[name][0] for name in names})


@pytest.fixture(scope='module')
def hidden():
    """Frames of a robot with all these effects, and the errors if they are known."""
    robot = with_effects(*HIDDEN)
    frames = fly('nominal', 3, 4.0, robot)
    return frames, unlike_without_fault(frames, robot)


@pytest.mark.parametrize('name', HIDDEN)
def test_sensor_effects_of_the_robot_file_improve_the_estimate(name, hidden):
    _, (first, last), columns, better = HIDDEN[name]
    frames, known = hidden
    unknown = unlike_without_fault(frames, with_effects(*HIDDEN.keys() - {name}))
    informed, uninformed = (
        np.sqrt(np.mean(found[(t[:, 0] > first) & (t[:, 0] <= last)][:, columns]**2))
        for t, found in (known, unknown))
    assert informed < uninformed / better, f'{informed:.2f} against {uninformed:.2f}'
