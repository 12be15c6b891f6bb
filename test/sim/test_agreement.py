"""
The plant, in MuJoCo and numpy, and the CasADi model agree; each has its own equations.

Each effect is compared but for the friction of the servos, whose law both take from
:mod:`model.servo`, and ``module_reaction``: there the plant has bodies and the model approximates
them (``benchmarks/multibody_difference.py`` has the difference).
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from sim_robots import acceleration, EQUATIONS, massless_modules, plant, ROBOT

from beetle_omni_ros.model import dynamics
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.rotations import normalized
from beetle_omni_ros.sim.forces import ServoLoads

DRAG = {'body_drag': EQUATIONS['body_drag']}      # by which a wind velocity acts
EFFECTS = {'none': {}, **{name: {name: values} | (DRAG if CATALOGUE[name].beside else {})
                          for name, values in EQUATIONS.items()}, 'all': EQUATIONS}
SERVOS = {'joint_deflection': {'deflection_per_newton': 0.002}}
NOT_COMPARED = {'joint_friction', 'module_reaction', 'formula'}     # see above; one equation
VOLTAGE_RATIO = 0.87
LOW, HIGH = 0.6, 10.0       # [m], the lower in reach of the ground effect


def test_every_effect_with_an_equation_is_compared_or_named():
    assert {*EFFECTS['all'], *SERVOS, *NOT_COMPARED} == {
        name for name, effect in CATALOGUE.items() if effect.apply or effect.servo}


def random_states(count, seed, height=HIGH):
    """States anywhere in the flight envelope, away from the floor and the stops."""
    generator = np.random.default_rng(seed)
    for _ in range(count):
        yield (generator.normal(size=3) * [1, 1, 0.1] + [0, 0, height],
               normalized(generator.normal(size=4)),
               generator.normal(size=3) * 3, generator.normal(size=3) * 3,
               generator.uniform(-3.9, 3.9, 4), generator.uniform(-9, 9, 4),
               generator.uniform(0.5, 20, 4))


def difference(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize('robot', [
    *(massless_modules(effects=effects) for effects in EFFECTS.values()),
    replace(ROBOT, multibody=None)], ids=[*EFFECTS, 'not described'])
def test_plant_without_module_inertia_agrees_with_casadi(robot):
    made, generator = plant(robot), np.random.default_rng(2)
    made.voltage_ratio = VOLTAGE_RATIO
    for p, q, v, w, tilt, tilt_rate, thrust in [*random_states(20, seed=1),
                                                *random_states(20, seed=2, height=LOW)]:
        command = generator.uniform(0.5, 20, 4)
        found = acceleration(made, p, q, v, w, tilt, tilt_rate, thrust, command)
        scale = robot.thrust_scale
        expected = ca.evalf(ca.vertcat(*dynamics.rigid_body(
            robot, v, ca.DM(q), ca.DM(w), ca.DM(tilt), ca.DM(thrust), tilt_rate=ca.DM(tilt_rate),
            thrust_rate=ca.DM(scale * (command - thrust) / robot.rotors.time_constant),
            position=ca.DM(p), voltage_ratio=ca.DM(VOLTAGE_RATIO))))
        linear, angular = np.split(np.array(expected).ravel(), 2)
        assert difference(found[:3], linear) < 1e-6
        assert difference(found[3:6], angular) < 1e-6


def test_loads_of_the_servos_agree_with_the_model():
    robot = replace(ROBOT, effects=SERVOS)
    loads = ServoLoads(robot)
    for *_, tilt, _, thrust in random_states(20, seed=4):
        targets, torques = loads(tilt, thrust)
        for i in range(4):
            _, terms = dynamics.tilt_servo(robot, i, tilt[i], thrust[i])
            assert targets[i] == pytest.approx(terms.target, rel=1e-12)
            assert torques[i] == terms.load == 0.0


@pytest.mark.parametrize('effects', [
    {'wind': {'force': [3.0, -4.0, 2.0]}},
    {'wind': {'force': [3.0, -4.0, 2.0]}, 'body_drag': {'coefficient': 0.3},
     'rotor_drag': {'coefficient': 0.8}}], ids=['wind', 'wind and drag'])
def test_step_is_the_integral_of_the_acceleration(effects):
    """Effects act inside the step as they do in a single state."""
    made = plant(replace(ROBOT, effects=effects))
    for p, q, v, w, tilt, _, thrust in random_states(5, seed=3):
        before = acceleration(made, p, q, v, w, tilt, np.zeros(4), thrust)
        velocity = made.state[1]
        made.step()
        after = made.data.qacc.copy()
        change = (made.state[1] - velocity)[:6] / 0.005
        scale = np.abs(after - before)[:6] + 0.5
        assert np.all(np.abs(change - 0.5 * (before + after)[:6]) < 0.1 * scale)
