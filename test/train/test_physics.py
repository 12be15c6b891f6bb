"""The generated functions agree with the CasADi functions."""

from dataclasses import replace

import casadi as ca
from learning import ROBOT, uniform
import numpy as np
import pytest
from sim_robots import EQUATIONS
import torch

from beetle_omni_ros.model.effects import CATALOGUE, validated
from beetle_omni_ros.train import model

EFFECTS = validated({
    **{name: values for name, values in EQUATIONS.items() if name != 'voltage_sag'},
    'module_reaction': {'module_inertia': 2e-4, 'mass_moment': 3e-3},
    'formula': {'expressions': ['force: velocity * speed', 'rotor_torque: turning * spin * thrust',
                                'thrust: thrust * ground'], 'coefficients': [-0.1, 0.03, 0.2]}})
EVERYTHING = replace(ROBOT, effects=EFFECTS)


def states(count, seed=0, dtype=torch.float64):
    """States, commands, wrenches and bodies, also at and beyond all limits."""
    g = torch.Generator().manual_seed(seed)
    limit, rate = ROBOT.joints.position_limit, ROBOT.joints.velocity_limit
    quaternion = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=-1)
    tilt, joint_rate = uniform(g, -limit, limit, count, 4), uniform(g, -rate, rate, count, 4)
    tilt[::3] = limit * torch.sign(tilt[::3])
    joint_rate[::4] = rate * torch.sign(joint_rate[::4])
    thrust = uniform(g, 0, 20, count, 4)
    thrust[::5] = 20 * torch.round(thrust[::5] / 20)
    x = torch.cat((torch.randn(count, 6, generator=g), quaternion,
                   torch.randn(count, 3, generator=g), tilt, joint_rate, thrust), -1)
    u = torch.cat((uniform(g, -6, 6, count, 4), uniform(g, -5, 25, count, 4)), -1)
    body = torch.tensor(model.nominal_body(EVERYTHING)) * uniform(g, 0.9, 1.1, count, 33)
    return [value.to(dtype) for value in (x, u, torch.randn(count, 6, generator=g), body)]


@pytest.mark.parametrize('robot', [ROBOT, EVERYTHING, replace(ROBOT, multibody=None)],
                         ids=['shipped', 'every effect', 'one rigid body'])
def test_torch_agrees_with_casadi(robot):
    assert set(EFFECTS) == {name for name, effect in CATALOGUE.items()
                            if effect.apply and name != 'voltage_sag'}   # needs a voltage
    function = model.substep(robot, 0.0025)
    inputs = states(200)
    ours = model.torch_function(function)(*inputs).numpy()
    theirs = np.array(function.map(200)(*(value.numpy().T for value in inputs))).T
    assert ours.dtype == np.float64
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)


def test_every_operation_of_the_tables_is_correct_with_constants_too():
    x, y = ca.SX.sym('x', 2), ca.SX.sym('y', 2)
    a, b = x[0], y[1]
    inside = ca.logic_and(a > -1, ca.logic_not(ca.logic_or(b <= 0.3, a != a)))
    out = ca.vertcat(
        a + b, a - b, a * b, a / b, -a, a * a, 2 * a, 1 / b, ca.sqrt(b), ca.sin(a), ca.cos(a),
        ca.exp(a), ca.fabs(a), ca.fmin(a, b), ca.fmax(a, b), ca.fmin(a, 0.1), ca.fmax(0.1, a),
        ca.if_else(a < 0.2, b, 3.0), ca.if_else(a == a, b, 0), inside, 7.0)
    function = ca.Function('sample', [x, y], [out], ['x', 'y'], ['z'])
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(60, 2)), rng.uniform(0.1, 2, (60, 2))
    ours = model.torch_function(function)(torch.tensor(x), torch.tensor(y)).numpy()
    np.testing.assert_allclose(ours, np.array(function.map(60)(x.T, y.T)).T, atol=1e-14)


@pytest.mark.skipif(not torch.cuda.is_available(), reason='triton compiles for a GPU')
def test_the_kernel_agrees_with_torch():
    made = model.Physics(EVERYTHING, 0.01, 4, 'cuda')
    x, _, wrench, body = (value.cuda() for value in states(1000, 3, torch.float32))
    commands = [states(1000, seed, torch.float32)[1].cuda() for seed in (4, 5, 6)]
    delays = uniform(torch.Generator().manual_seed(7), 0.0, 0.02, 1000, 2).cuda()
    torch.testing.assert_close(made.advance(x, commands, delays, wrench, body), made.advance_torch(
        x, commands, delays, wrench, body), rtol=0, atol=1e-3)
