"""The CasADi model against Newton and Euler written out with numpy and scipy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from test_allocation import independent_wrench

from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()


def random_state(seed):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=3), Rotation.random(random_state=seed).as_quat(),
            rng.normal(size=3), rng.uniform(-3.9, 3.9, 4), rng.uniform(0, 20, 4))


def newton_euler(robot, velocity, quaternion, rate, tilt, thrust):
    """Textbook equations, rotor by rotor, with scipy's rotations."""
    force, torque = independent_wrench(robot, tilt, thrust)
    acceleration = Rotation.from_quat(quaternion).apply(force) / robot.mass \
        - [0, 0, robot.gravity]
    inertia = np.diag(robot.inertia)
    return acceleration, np.linalg.solve(inertia, torque - np.cross(rate, inertia @ rate))


@pytest.mark.parametrize('seed', range(3))
def test_accelerations_agree_with_newton_and_euler(seed):
    state = random_state(seed)
    ours = model.body_acceleration(ROBOT)(*state)
    theirs = newton_euler(ROBOT, *state)
    for a, b in zip(ours, theirs):
        assert np.allclose(np.array(a).ravel(), b, rtol=1e-12, atol=1e-11)


def test_integrator_agrees_with_an_adaptive_solver():
    rng = np.random.default_rng(1)
    v, q, w, tilt, thrust = random_state(5)
    x = np.concatenate([rng.normal(size=3), v, q, w, tilt, rng.normal(size=4), thrust])
    u = np.concatenate([tilt + 0.05 * rng.normal(size=4), rng.uniform(5, 15, 4)])
    d = 0.1 * rng.normal(size=10)
    f = model.full_model(ROBOT)
    reference = solve_ivp(lambda _, y: np.array(f(y, u, d)).ravel(), (0, 0.01), x,
                          rtol=1e-11, atol=1e-12).y[:, -1]
    errors = [np.abs(np.array(model.integrator(ROBOT, n)(x, u, d, 0.01)).ravel()
                     - reference).max() for n in (2, 4, 8)]
    assert errors[0] < 5e-3   # servo rates; the body's states are a hundred times closer
    assert errors[1] < errors[0] / 10   # fourth order: 16 times for half the step
    assert errors[2] < errors[1] / 10


def test_servo_keeps_its_rate_limit_and_torque_limit():
    def rates(robot):
        step, state = model.integrator(robot, 5), np.eye(25)[9]
        u = np.r_[np.full(4, 3.5), np.zeros(4)]
        for _ in range(200):
            state = np.array(step(state, u, np.zeros(10), 0.002)).ravel()
            yield state[17]

    limit = ROBOT.joints.velocity_limit
    assert 0.95 * limit < np.abs(list(rates(ROBOT))).max() < 1.35 * limit
    weak = replace(ROBOT, joints=replace(ROBOT.joints, effort_limit=0.01))
    torque = np.diff([0.0, *rates(weak)]) / 0.002 * ROBOT.joints.inertia
    assert np.abs(torque).max() <= 0.01 * (1 + 1e-9)


@pytest.mark.parametrize('name', list(CATALOGUE))
def test_an_effect_at_its_neutral_value_changes_nothing(name):
    own = {'mass': ROBOT.mass, 'inertia': tuple(ROBOT.inertia),
           'torque_to_thrust_ratio': ROBOT.rotors.torque_to_thrust_ratio,
           'time_constant': ROBOT.rotors.time_constant, 'thrust_max': ROBOT.rotors.thrust_max,
           **{key: getattr(ROBOT.joints, key) for key in ('kp', 'kd', 'velocity_limit',
                                                          'effort_limit')}}
    values = {key: own.get(key, spec.neutral) for key, spec in CATALOGUE[name].parameters.items()}
    state = random_state(7)
    plain = model.body_acceleration(ROBOT)(*state)
    beside = {'rotor_drag': {'coefficient': 0.0}} if CATALOGUE[name].beside else {}
    neutral = model.body_acceleration(replace(ROBOT, effects=beside | {name: values}))(*state)
    for a, b in zip(plain, neutral):
        assert np.allclose(np.array(a), np.array(b), atol=1e-12)


def test_a_shifted_centre_of_mass_is_the_same_body_seen_from_another_point():
    offset = np.array([0.01, -0.02, 0.03])
    v, q, w, tilt, thrust = random_state(9)
    shifted = replace(ROBOT, effects={'centre_of_mass': {'offset': tuple(offset)}})
    rotors = replace(ROBOT.rotors, positions=ROBOT.rotors.positions - offset)
    at_centre = newton_euler(replace(ROBOT, rotors=rotors), v, q, w, tilt, thrust)
    linear, angular = (np.array(a).ravel() for a in model.body_acceleration(shifted)(v, q, w, tilt,
                                                                             thrust))
    lever = -offset    # from the centre of mass to base_link's origin
    expected = at_centre[0] + Rotation.from_quat(q).apply(
        np.cross(at_centre[1], lever) + np.cross(w, np.cross(w, lever)))
    assert np.allclose(angular, at_centre[1], atol=1e-9)
    assert np.allclose(linear, expected, atol=1e-9)


@pytest.mark.parametrize('name', CATALOGUE)
def test_a_declaration_is_complete_and_consistent(name):
    effect = CATALOGUE[name]
    assert effect.source
    for spec in (spec for spec in effect.parameters.values() if not spec.text):
        neutral = np.array(spec.neutral, dtype=float)
        assert np.isnan(neutral).all() == bool(spec.number)
        assert np.all(np.isnan(neutral) | (neutral >= spec.low) & (neutral <= spec.high))
