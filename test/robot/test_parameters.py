"""The robot file: its consistency, and refusals."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from beetle_omni_ros.identify.robot_file import write_robot_file
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError


@pytest.fixture
def content():
    """The shipped robot file as plain data."""
    return yaml.safe_load(share_path('params/robot.yaml').read_text())


def load(tmp_path, content):
    path = tmp_path / 'robot.yaml'
    path.write_text(yaml.safe_dump(content))
    return RobotParameters.load(path)


def test_rotor_positions_of_parts_and_totals_agree():
    robot = RobotParameters.load()
    parts = robot.multibody
    for i in range(4):
        axis = robot.tilt_axes[i]
        joint = parts.module.joint_offset * np.sign(axis) + [0, 0, parts.module.joint_height]
        rotor = joint + parts.module.rotor_offset * axis \
            - [0, 0, parts.centre_of_gravity_height]
        assert np.allclose(rotor, robot.rotors.positions[i], atol=5e-4)


def test_the_rotor_map_grows_with_thrust_at_every_voltage():
    for row in RobotParameters.load().rotors.map:
        g = np.linspace(0, row.thrust_max / 10, 200)
        duty = np.polynomial.polynomial.polyval(g, row.coefficients)
        assert np.all(np.diff(duty) > 0)
        assert 50 < duty[0] < duty[-1] <= 100


def test_the_hash_depends_on_physics_and_not_on_the_name(tmp_path, content):
    original = RobotParameters.load().hash()
    content['name'] = 'sister'
    assert load(tmp_path, content).hash() == original
    content['mass'] = 3.1
    assert load(tmp_path, content).hash() != original


@pytest.mark.parametrize('change, message', [
    (lambda c: c.update(mass=9.0), 'needs 22.1 N a rotor to hover'),
    (lambda c: c.update(mass=-1), "key 'mass': -1 is outside"),
    (lambda c: c['rotors'].pop('thrust_max'), "key 'rotors.thrust_max': missing [N]"),
    (lambda c: c['rotors'].update(thrust_min=30), 'rotors.thrust_min'),
    (lambda c: c['rotors'].update(spin=[1, 0, 1, 0]), 'must hold +1 or -1'),
    (lambda c: c['rotors']['map'][1].pop('voltage'), "key 'rotors.map[1].voltage': missing [V]"),
    (lambda c: c['joints'].update(stiffness=1), "key 'joints.stiffness': unknown key"),
    (lambda c: c.update(effects={'thrust_coeficient': {'scale': 1}}),
     "effects.thrust_coeficient: unknown effect; did you mean 'thrust_coefficient'?"),
    (lambda c: c.update(effects={'thrust_coefficient': {'factor': 1}}), 'expected the keys scale'),
    (lambda c: c.update(effects={'thrust_coefficient': {'scale': 93}}), 'is outside 0.2 to 2'),
    (lambda c: c.update(effects={'wind': {'force': [1, 2]}}), 'expected shape (3,)'),
])
def test_a_bad_robot_file_is_refused_with_the_key(tmp_path, content, change, message):
    change(content)
    with pytest.raises(ParameterError) as error:
        load(tmp_path, content)
    assert message in str(error.value)
    assert 'robot.yaml' in str(error.value)
    assert '\n' not in str(error.value)


def test_a_file_that_extends_another_contains_differences_only(tmp_path):
    (tmp_path / 'mine.yaml').write_text(
        'extends: robot.yaml\nmass: 3.2\nrotors: {thrust_max: 18.0}\n')
    (tmp_path / 'other.yaml').write_text(
        'extends: mine.yaml\neffects: {wind: {force: [1, 0, 0]}}\n')
    shipped, mine = RobotParameters.load(), RobotParameters.load(tmp_path / 'other.yaml')
    assert (mine.mass, mine.rotors.thrust_max) == (3.2, 18.0)
    assert mine.effects == {'wind': {'force': (1.0, 0.0, 0.0)}}
    assert np.array_equal(mine.rotors.positions, shipped.rotors.positions)
    assert mine.joints == shipped.joints


def test_the_name_of_a_shipped_file_is_a_robot_file_unless_a_local_file_has_it(
        tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert RobotParameters.load('robot.yaml').hash() == RobotParameters.load().hash()
    (tmp_path / 'other').mkdir()
    write_robot_file(tmp_path / 'other' / 'mine.yaml', '', {'mass': 3.1}, Path('robot.yaml'))
    assert RobotParameters.load('other/mine.yaml').mass == 3.1
    (tmp_path / 'robot.yaml').write_text('extends: robot.yaml\nmass: 3.2\n')
    assert RobotParameters.load('robot.yaml').mass == 3.2
    with pytest.raises(ParameterError, match='none.yaml: no such file'):
        RobotParameters.load('none.yaml')


@pytest.mark.parametrize('text, message', [
    ('extends: nowhere.yaml\n', "key 'extends': no file 'nowhere.yaml'"),
    ('extends: mine.yaml\n', 'extends itself'),
    ('extends: robot.yaml\nmas: 3\n', "key 'mas': unknown key; did you mean 'mass'?"),
])
def test_a_bad_extension_is_refused_with_the_key(tmp_path, text, message):
    (tmp_path / 'mine.yaml').write_text(text)
    with pytest.raises(ParameterError) as error:
        RobotParameters.load(tmp_path / 'mine.yaml')
    assert message in str(error.value)
    assert 'mine.yaml' in str(error.value)


def test_the_weak_and_heavy_plant_is_weaker_and_heavier():
    shipped = RobotParameters.load()
    plant = RobotParameters.load(share_path('params/robot_weak_and_heavy.yaml'))
    assert plant.mass == pytest.approx(1.05 * shipped.mass)
    assert plant.effects == {'thrust_coefficient': {'scale': 0.93}}
