"""
MuJoCo's plant and the CasADi model describe the same rigid body.

Wind and drag have the same equations in both; here they show frames and points of application.
"""

from dataclasses import replace

import numpy as np
import pytest
from sim_robots import acceleration, massless_modules, plant, ROBOT

from beetle_omni_ros.robot.dynamics import body_acceleration
from beetle_omni_ros.robot.rotations import normalized

EFFECTS = {
    'none': {},
    'mass': {'mass': {'mass': 3.3}},
    'inertia': {'inertia': {'inertia': (0.08, 0.07, 0.11)}},
    'centre_of_mass': {'centre_of_mass': {'offset': (0.01, -0.015, 0.02)}},
    'thrust_coefficient': {'thrust_coefficient': {'scale': 0.93}},
    'rotor_thrust_coefficient': {'rotor_thrust_coefficient': {'scale': [1.0, 0.9, 1.05, 0.97]}},
    'torque_coefficient': {'torque_coefficient': {'torque_to_thrust_ratio': 0.021}},
    'wind': {'wind': {'force': [1.0, -2.0, 0.5]}},
    'body_drag': {'body_drag': {'coefficient': 0.11}},
    'rotor_drag': {'rotor_drag': {'coefficient': 0.4}},
}
EFFECTS['all'] = {name: values for each in EFFECTS.values() for name, values in each.items()}


def random_states(count, seed):
    """States anywhere in the flight envelope, away from the floor and the stops."""
    generator = np.random.default_rng(seed)
    for _ in range(count):
        yield (generator.normal(size=3) + [0, 0, 10], normalized(generator.normal(size=4)),
               generator.normal(size=3) * 3, generator.normal(size=3) * 3,
               generator.uniform(-3.9, 3.9, 4), generator.uniform(-9, 9, 4),
               generator.uniform(0.5, 20, 4))


def difference(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize('robot', [
    *(massless_modules(effects=effects) for effects in EFFECTS.values()),
    replace(ROBOT, multibody=None)], ids=[*EFFECTS, 'not described'])
def test_plant_without_module_inertia_agrees_with_casadi(robot):
    made, model = plant(robot), body_acceleration(robot)
    for p, q, v, w, tilt, tilt_rate, thrust in random_states(40, seed=1):
        linear, angular = model(v, q, w, tilt, thrust)
        found = acceleration(made, p, q, v, w, tilt, tilt_rate, thrust)
        assert difference(found[:3], np.array(linear).ravel()) < 1e-6
        assert difference(found[3:6], np.array(angular).ravel()) < 1e-6


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
