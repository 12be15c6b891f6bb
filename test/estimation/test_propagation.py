"""Propagation against the analytic flight, its linearisation against finite differences."""

from dataclasses import replace

from ekf_flights import GRAVITY, Sensors, Trajectory
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.estimation.state import Node, propagate, STATES, transition
from beetle_omni_ros.model import rotations


def moved(node, error):
    """``node`` displaced by an error state (15,)."""
    quaternion = rotations.multiply(node.quaternion, rotations.exp(error[6:9]))
    return replace(node, position=node.position + error[:3], velocity=node.velocity + error[3:6],
                   quaternion=quaternion, rotation=rotations.matrix(quaternion),
                   accelerometer_bias=node.accelerometer_bias + error[9:12],
                   gyroscope_bias=node.gyroscope_bias + error[12:15])


def difference(a, b):
    """Error state (15,) that takes ``b`` to ``a``."""
    turn = rotations.log(rotations.multiply(rotations.conjugate(b.quaternion), a.quaternion))
    return np.concatenate([a.position - b.position, a.velocity - b.velocity, turn,
                           a.accelerometer_bias - b.accelerometer_bias,
                           a.gyroscope_bias - b.gyroscope_bias])


def random_node(rng):
    """Any attitude, agile motion."""
    quaternion = Rotation.random(random_state=int(rng.integers(2 ** 31))).as_quat()
    return Node(3.0, 10 * rng.standard_normal(3), 5 * rng.standard_normal(3),
                rng.standard_normal(3), 3 * rng.standard_normal(3), quaternion,
                rotations.matrix(quaternion), 0.2 * rng.standard_normal(3),
                0.05 * rng.standard_normal(3), 0.0)


@pytest.mark.parametrize('seed', range(3))
def test_transition_matches_finite_differences(seed):
    rng = np.random.default_rng(seed)
    node, dt, step = random_node(rng), rng.uniform(0.001, 0.01), 1e-5
    reading = (node.stamp + dt, node.force + rng.standard_normal(3),
               node.rate + 0.1 * rng.standard_normal(3), GRAVITY)
    after = propagate(node, *reading)
    exact = transition(node, after, np.eye(STATES))[:15, :15]
    numeric = np.stack([
        (difference(propagate(moved(node, step * axis), *reading), after)
         - difference(propagate(moved(node, -step * axis), *reading), after)) / (2 * step)
        for axis in np.eye(15)], axis=1)
    # left out: the third order of the right Jacobian, and the commutator of the two rates
    angle, change = dt * np.linalg.norm(node.rate), dt * np.linalg.norm(reading[2] - node.rate)
    np.testing.assert_allclose(exact, numeric, rtol=0, atol=dt * (angle ** 2 + change) / 6)


def integrated_error(period, duration=1.0, seed=4):
    """Error of position, velocity and attitude after noise-free dead reckoning."""
    trajectory, sensors, rng = Trajectory(seed), Sensors.perfect(), np.random.default_rng(0)
    times = period * np.arange(round(duration / period) + 1)
    samples = sensors.imu(trajectory, times, np.zeros((len(times), 6)), rng)
    truth = trajectory(times[[0, -1]])
    quaternion = truth['rotation'][0].as_quat()
    node = Node(0.0, samples[0].specific_force, samples[0].angular_velocity,
                truth['position'][0], truth['velocity'][0], quaternion,
                rotations.matrix(quaternion), np.zeros(3), np.zeros(3), 0.0)
    for sample in samples[1:]:
        node = propagate(node, sample.stamp, sample.specific_force, sample.angular_velocity,
                         GRAVITY)
    turn = Rotation.from_quat(node.quaternion).inv() * truth['rotation'][1]
    return np.array([np.linalg.norm(node.position - truth['position'][1]),
                     np.linalg.norm(node.velocity - truth['velocity'][1]), turn.magnitude()])


def test_noise_free_dead_reckoning_follows_the_analytic_flight_to_second_order():
    coarse, fine = integrated_error(0.01), integrated_error(0.005)
    assert np.all(fine < [1e-3, 1e-3, 1e-4])
    assert np.all(coarse[:2] / fine[:2] > 3.5)
