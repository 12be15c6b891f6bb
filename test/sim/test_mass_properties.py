"""The parts have the totals of the robot file."""

from dataclasses import replace

import numpy as np
import pytest
from sim_robots import plant, ROBOT

from beetle_omni_ros.model.parameters import combined, mass_properties, Variation


def whole(properties):
    return combined([properties.main_body, *properties.modules, properties.end_effector])


def test_variation_moves_the_totals():
    variation = Variation(1.04, np.array([0.96, 1.03, 1.05]), np.array([0.01, -0.007, 0.004]))
    total = whole(mass_properties(ROBOT, variation))
    assert total.mass == pytest.approx(1.04 * ROBOT.mass, rel=1e-12)
    np.testing.assert_allclose(total.centre, variation.centre_of_mass, atol=1e-15)
    np.testing.assert_allclose(total.inertia, np.diag(ROBOT.inertia * variation.inertia_scale),
                               atol=1e-15)


@pytest.mark.parametrize('effects', [
    {}, {'module_reaction': {'module_inertia': 9.9e-5, 'mass_moment': 2.1e-3}},
    {'module_reaction': {'module_inertia': 9.9e-5, 'mass_moment': 0.0}}],
    ids=['rigid', 'with reaction', 'inertia only'])
def test_totals_hold_for_a_robot_whose_parts_are_not_described(effects):
    properties = mass_properties(replace(ROBOT, multibody=None, effects=effects))
    total = whole(properties)
    assert total.mass == pytest.approx(ROBOT.mass, rel=1e-12)
    np.testing.assert_allclose(total.inertia, np.diag(ROBOT.inertia), atol=1e-15)
    module_effect = effects.get('module_reaction', {})
    for module, joint in zip(properties.modules, properties.joint_origins):
        lever = module.centre - joint
        assert module.mass * -lever[2] == pytest.approx(module_effect.get('mass_moment', 0.0))
        assert module.inertia_about(joint)[0, 0] == pytest.approx(
            module_effect.get('module_inertia', 0.0))


def test_mujoco_sees_the_same_totals():
    made = plant()
    model, data = made.model, made.data
    inertia = np.zeros((3, 3))
    for body in range(1, model.nbody):
        axes = data.ximat[body].reshape(3, 3)
        r = data.xipos[body] - data.xpos[1]
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T \
            + model.body_mass[body] * (r @ r * np.eye(3) - np.outer(r, r))
    assert model.body_mass.sum() == pytest.approx(ROBOT.mass, rel=1e-12)
    np.testing.assert_allclose(data.subtree_com[1], data.xpos[1], atol=1e-12)
    np.testing.assert_allclose(inertia, np.diag(ROBOT.inertia), atol=1e-9)
