"""One servo: the same numbers in numpy, CasADi, torch and C, and the motion of exact solutions."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from beetle_omni_ros.model import native
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.servo import CASADI, NUMPY, Responses, Servo, Step

torch = pytest.importorskip('torch')

ROBOT = RobotParameters.load()
PLAIN = Servo.of(ROBOT.joints)
KINDS = {
    'plain': Servo.of(ROBOT.joints, velocity_limit=None, effort_limit=None),
    'limits': Servo.of(ROBOT.joints, effort_limit=0.05, position_limit=0.5),
    'friction': Servo.of(ROBOT.joints, coulomb=0.01, stiction=0.03)}


def states(count=200, seed=0):
    """(4, count) targets, tilts [rad], rates [rad/s] and loads [N m]."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (4, count)) * [[1.0], [0.6], [12.0], [0.02]]


@pytest.mark.parametrize('kind', KINDS)
def test_numpy_casadi_torch_and_c_take_the_same_step(kind):
    from beetle_omni_ros.train.model import torch_function
    target, tilt, rate, load = states()
    expected = np.array(Step(NUMPY, KINDS[kind], 0.001)(target, tilt, rate, load))
    names = ca.SX.sym('x', 4)
    after = ca.vertcat(*Step(CASADI, KINDS[kind], 0.001)(*ca.vertsplit(names)))
    step = ca.Function(f'servo_{kind}', [names], [after], ['x'], ['y'])
    rows = np.stack([target, tilt, rate, load])
    for found in (np.array(step.map(200)(rows)), np.array(native.compiled(step).map(200)(rows)),
                  torch_function(step)(torch.tensor(rows.T)).numpy().T):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_a_step_is_of_second_order():
    kp, kd, inertia = ROBOT.joints.kp, ROBOT.joints.kd, ROBOT.joints.inertia
    servo = Servo(inertia, kp, kd)
    a = np.array([[0, 1], [-kp / inertia, -kd / inertia]])
    values, vectors = np.linalg.eig(a)
    exact = (vectors @ np.diag(np.exp(0.05 * values)) @ np.linalg.inv(vectors)).real @ [0.3, 2.0]

    def error(count):
        step, tilt, rate = Step(NUMPY, servo, 0.05 / count), 0.3, 2.0
        for _ in range(count):
            tilt, rate = step(0.0, tilt, rate)
        return abs(tilt - exact[0])

    assert error(80) < error(40) / 3.7 < error(20) / 3.7**2
    assert error(80) < 1e-4


def test_stiction_holds_a_joint_exactly_still_and_releases_it_beyond():
    servo = replace(PLAIN, coulomb=0.01, stiction=0.03)
    step = Step(NUMPY, servo, 0.001)
    assert step(0.9 * 0.03 / servo.kp, 0.0, 0.0) == (0.0, 0.0)
    assert step(1.1 * 0.03 / servo.kp, 0.0, 0.0)[1] > 0
    assert step(0.0, 0.0, 0.0, 0.029) == (0.0, 0.0)


def test_a_load_beyond_the_motor_torque_moves_the_joint():
    servo = replace(PLAIN, effort_limit=0.05)
    assert servo.acceleration(NUMPY, 1.0, 0.0, 0.0, -0.08) == pytest.approx(-0.03 / servo.inertia)
    _, rate = Step(NUMPY, servo, 1e-5)(1.0, 0.0, 0.0, -0.08)
    assert rate == pytest.approx(-0.03 / servo.inertia * 1e-5)


@pytest.mark.parametrize('gradient', [14.0, 0.0])
@pytest.mark.parametrize('duration', [2e-3, 1e-3, 2.5e-4])
@pytest.mark.parametrize(('load', 'friction'), [(0.02, 0.0), (0.0, 0.0), (-0.02, 0.0),
                                                (-0.01, 0.01)])
def test_a_motor_at_full_voltage_gains_speed_as_in_closed_form_at_every_step(
        gradient, duration, load, friction):
    servo = Servo(7.5e-5, 0.3, 0.01, velocity_limit=10.0, effort_limit=3.0, coulomb=friction,
                  stiction=friction, speed_gradient=gradient)
    step, rate, end = Step(NUMPY, servo, duration), 7.0, 10.0 + gradient * (load - friction)
    for time in duration * np.arange(1, 20):
        rate = step.kick(9.0, 0.0, rate, load)
        left = np.exp(-time / (gradient * servo.inertia)) if gradient else 0.0
        assert rate == pytest.approx(end + (7.0 - end) * left)


@pytest.mark.parametrize('name', ['measured', None])
def test_a_drawn_robot_responds_within_the_limits_of_its_file(name):
    robot = RobotParameters.load(name)
    allowed = Responses.of(robot)
    for seed in range(50):
        own = Responses.of(robot.drawn(np.random.default_rng(seed)))
        for key in ('servo_lag', 'servo_delay', 'rotor_lag', 'rotor_delay'):
            (low, high), (least, most) = getattr(own, key), getattr(allowed, key)
            assert least - 1e-12 <= low <= high <= most + 1e-12, key
        assert own.friction <= allowed.friction
