"""A formula is data: its terms act as the equations that they state, and errors name the term."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.model import dynamics
from beetle_omni_ros.model.formula import described, library, parsed, size_of
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.forces import AddedForces

ROBOT = RobotParameters.load()
HOVER = ROBOT.hover_thrust
# Entry of the catalogue -> a formula of the same equation.
SAME = {
    'body_drag': ({'coefficient': 0.1}, {'force: velocity * speed': -0.1}),
    'rotor_drag': ({'coefficient': 0.6}, {'rotor_force: in_plane_velocity * rotor_speed': -0.15}),
    'rotor_hub_moment': ({'coefficient': 0.2}, {
        'rotor_torque: normal_cross_velocity * rotor_speed': -0.05}),
    'axial_inflow': ({'per_rotor': 0.4}, {'thrust: axial_speed * rotor_speed': -0.4}),
    'translational_lift': ({'per_rotor': 0.1}, {'thrust: in_plane_speed * in_plane_speed': 0.1}),
    'ground_effect': ({'gain_at_0.25m': 0.1}, {
        'thrust: thrust * ground * upright * upright': 0.1 * HOVER}),
    'tilt_thrust_loss': ({'loss_at_60deg': 0.06}, {
        'thrust: thrust * tilt_sine * tilt_sine': -0.08 * HOVER}),
    'rotor_thrust_coefficient': ({'scale': (1.0, 0.9, 1.0, 1.0)}, {
        'thrust: thrust * rotor_2': -0.1 * HOVER}),
    'wind': ({'force': (0.5, 0.0, -0.3)}, {'force: world_x': 0.5, 'force: world_z': -0.3}),
    'propeller_gyroscopic_torque': ({'angular_momentum_at_hover': 0.05}, {
        'rotor_torque: turning * spin * rotor_speed': -0.05,
        'rotor_torque: normal * spin * spin_up': -0.05})}


def with_formula(terms):
    return replace(ROBOT, effects={'formula': {
        'expressions': tuple(terms), 'coefficients': tuple(terms.values())}})


def states(count=20):
    """Arguments of the added wrench at random states."""
    rng = np.random.default_rng(4)
    for _ in range(count):
        quaternion = rng.normal(size=4)
        yield (quaternion / np.linalg.norm(quaternion), rng.normal(size=3), rng.normal(size=3),
               rng.uniform(-2, 2, 4), rng.normal(size=4), rng.normal(size=4),
               rng.uniform(3, 12, 4), rng.normal(size=4), rng.normal(size=3) + [0, 0, 2], 1.0)


@pytest.mark.parametrize('name', SAME)
def test_a_formula_is_the_equation_of_an_entry(name):
    values, terms = SAME[name]
    entry, formula = (dynamics.added_wrench(robot, list(robot.effects)) for robot in (
        replace(ROBOT, effects={name: values}), with_formula(terms)))
    for state in states():
        expected = np.ravel(entry(*state))
        assert np.allclose(np.ravel(formula(*state)), expected, atol=1e-4 * np.abs(expected).max())


def test_the_plant_has_the_formula_of_the_model():
    robot = with_formula(SAME['rotor_drag'][1])
    added, model = AddedForces(robot, False), dynamics.added_wrench(robot, ['formula'])
    names = ('quaternion', 'velocity', 'rate', 'tilt', 'tilt_rate', 'tilt_acceleration', 'thrust',
             'thrust_rate', 'position', 'voltage_ratio')
    for state in states(5):
        motion = dict(zip(names, state, strict=True))
        expected = np.ravel(model(*state))
        assert np.abs(expected).max() > 0.01
        assert np.allclose(added(driven=motion['tilt'], **motion), expected)


def test_each_term_of_the_library_has_words_a_unit_a_size_and_an_effect():
    terms = library()
    assert len(set(terms)) == len(terms)
    made = dynamics.added_wrench(with_formula(dict.fromkeys(terms, 1.0)), ['formula'])
    assert np.isfinite([np.ravel(made(*state)) for state in states()]).all()
    for term in terms:
        assert all(described(term)) and size_of(term, 30.0, 0.3) > 0
    assert described('force: velocity * speed')[0] == 'N s^2/m^2'
    assert described('torque: torque_x')[0] == '1'
    assert described('rotor_torque: turning * spin')[0] == 'N m s'
    level = library(torques=False, tilting=False)
    assert not any('torque' in parsed(term)[0] or 'tilt_rate' in term for term in level)


@pytest.mark.parametrize('term, error', [
    ('push: velocity', 'expected TARGET: FACTOR'), ('force: speed', "factor 'speed'"),
    ('torque: velocity', "factor 'velocity'"),      # no torque along a polar vector
    ('force: velocity * rotor_speed', "factor 'rotor_speed'"), ('thrust:', "factor ''")])
def test_a_wrong_term_is_refused(term, error):
    with pytest.raises(ParameterError, match=error):
        with_formula({term: 1.0})


def test_a_robot_file_reads_an_effect_from_a_file(tmp_path):
    (tmp_path / 'drag.yaml').write_text(
        "expressions: ['force: velocity']\ncoefficients: [-0.4]\nunits: [N s/m]\n"
        'source: {written_by: me}\n')
    file = tmp_path / 'robot_new.yaml'
    file.write_text('extends: robot.yaml\neffects: {formula: drag.yaml}\n')
    assert RobotParameters.load(file).effects['formula'] == {
        'expressions': ('force: velocity',), 'coefficients': (-0.4,)}
    (tmp_path / 'drag.yaml').write_text(
        "expressions: ['force: velocity']\ncoefficients: [-0.4, 1.0]\n")
    with pytest.raises(ParameterError, match='robot_new.yaml: effects.formula: .*one coefficient'):
        RobotParameters.load(file)
