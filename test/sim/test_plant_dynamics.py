"""Mechanics of the multibody plant: free fall, momentum, ground, payload, totals of its parts."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from sim_robots import HIGH, momenta, plant, ROBOT, WORLD

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import combined, mass_properties, Variation
from beetle_omni_ros.sim.plant import PAYLOAD_DEPTH

WEIGHTLESS = replace(ROBOT, gravity=0.0)


@pytest.mark.parametrize('target', [0.3, 3.0], ids=['servo linear', 'rate limited'])
def test_tilting_modules_react_on_the_body_and_keep_momenta(target):
    made = plant(WEIGHTLESS)
    made.set_targets(np.array([target, -target, 0.5 * target, target]), np.zeros(4))
    turned = 0.0
    for _ in range(100):
        made.step()
        turned = max(turned, np.abs(made.state[1][3:6]).max())
    linear, angular, centre = momenta(made)
    np.testing.assert_allclose(linear, 0, atol=1e-7)
    np.testing.assert_allclose(angular, 0, atol=1e-7)
    np.testing.assert_allclose(centre, HIGH, atol=1e-6)
    assert turned > 1e-3


def test_wrench_acts_in_its_frames():
    made = plant(WEIGHTLESS, quaternion=rotations.from_rpy(0, 0, np.pi / 2))
    made.wrench[:] = [3.0, 0, 0, 0, 0, 0.5]
    for _ in range(20):
        made.step()
    linear, angular, centre = momenta(made)
    np.testing.assert_allclose(linear, [0.3, 0, 0], atol=1e-4)
    np.testing.assert_allclose(angular, [0, 0, 0.05], atol=1e-4)


def test_robot_rests_on_its_feet():
    made = plant(position=None)
    height = made.state[0][2]
    assert WORLD.foot_depth - 1e-3 < height < WORLD.foot_depth
    for _ in range(200):
        made.step()
    assert made.contact
    np.testing.assert_allclose(made.state[0][:3], [0, 0, height], atol=1e-5)
    np.testing.assert_allclose(made.specific_force, [0, 0, ROBOT.gravity], atol=1e-3)


def test_payload_adds_its_weight_below_the_centre():
    made = plant()
    made.set_payload(0.75)
    before = ROBOT.mass
    assert made.model.body_mass.sum() == pytest.approx(before + 0.75)
    mujoco.mj_forward(made.model, made.data)
    depth = HIGH[2] - made.data.subtree_com[1][2]
    assert depth == pytest.approx(0.75 * PAYLOAD_DEPTH / (before + 0.75), rel=1e-6)
    made.data.act[:] = (before + 0.75) * ROBOT.gravity / 4
    mujoco.mj_forward(made.model, made.data)
    assert abs(made.data.qacc[2]) < 2e-3
    made.set_payload(0.0)
    assert made.model.body_mass.sum() == pytest.approx(before)


# Totals of the robot file ---------------------------------------------------------------------

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
