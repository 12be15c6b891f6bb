"""The robot file: its consistency, and refusals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from beetle_omni_ros.identify.robot_file import write_robot_file
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError


@pytest.fixture
def content():
    """The shipped robot file as plain data."""
    return yaml.safe_load(share_path('params/robot.yaml').read_text())


def load(tmp_path, content):
    path = tmp_path / 'robot.yaml'
    path.write_text(yaml.safe_dump(content))
    return RobotParameters.load(path)


def test_the_hash_depends_on_physics_and_not_on_the_name(tmp_path, content):
    original = RobotParameters.load().hash()
    content['name'] = 'sister'
    assert load(tmp_path, content).hash() == original
    content['mass'] = 3.1
    assert load(tmp_path, content).hash() != original


@pytest.mark.parametrize('change, message', [
    (lambda c: c.update(mass=9.0), 'needs 22.1 N a rotor to hover'),
    (lambda c: c['rotors'].update(thrust_min=30), 'rotors.thrust_min'),
    (lambda c: c['rotors'].update(spin=[1, 0, 1, 0]), 'must hold +1 or -1'),
    (lambda c: c['rotors']['map'][1].pop('voltage'), "key 'rotors.map[1].voltage': missing [V]"),
    (lambda c: c.update(mass=0.5), 'multibody: modules and end-effector weigh 0.76121 kg'),
    (lambda c: c.update(inertia=[0.03, 0.06, 0.09]), 'inertia: [0.03, 0.06, 0.09] kg m^2 leaves '
     'the main body the principal moments'),
    (lambda c: c.update(effects={'thrust_coeficient': {'scale': 1}}),
     "effects.thrust_coeficient: unknown effect; did you mean 'thrust_coefficient'?"),
    (lambda c: c.update(effects={'thrust_coefficient': {'scale': 93}}), 'is outside 0.2 to 2'),
    (lambda c: c.update(extends=[1]), "key 'extends': expected the name of another file"),
    (lambda c: c.update(effects=3), "key 'effects': expected a mapping, found 3"),
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


MEASURED = """
rotors: {time_constant: 0.05}
effects: {joint_bandwidth: {kp: [0.3, 0.2, 0.3, 0.3], kd: 0.005}}
intervals:
  rotors.time_constant: [0.03, 0.07]
  effects.joint_bandwidth.kp: [[0.2, 0.1, 0.2, 0.2], [0.4, 0.3, 0.4, 0.3]]
"""


def test_a_drawn_robot_lies_in_the_intervals_of_the_file(tmp_path):
    (tmp_path / 'mine.yaml').write_text('extends: robot.yaml\n' + MEASURED)
    robot = RobotParameters.load(tmp_path / 'mine.yaml')
    drawn = [robot.drawn(np.random.default_rng(seed)) for seed in range(50)]
    low, high = robot.interval('effects.joint_bandwidth.kp')
    kp = np.array([each.joints.kp for each in drawn])
    assert np.all((low <= kp) & (kp <= high))
    lags = np.array([each.rotors.time_constant for each in drawn])
    assert 0.03 <= lags.min() < 0.035 and 0.065 < lags.max() <= 0.07
    assert {each.mass for each in drawn} == {robot.mass}
    assert robot.interval('mass') == (robot.mass, robot.mass)


def test_a_drawn_robot_has_the_lag_that_the_logs_determine():
    robot = RobotParameters.load('measured')
    low, high = robot.interval('tilt_lag')
    drawn = np.array([robot.drawn(np.random.default_rng(seed)).tilt_lag for seed in range(50)])
    assert np.all((low <= drawn) & (drawn <= high))
    free = replace(robot, intervals={
        key: pair for key, pair in robot.intervals.items() if key != 'tilt_lag'})
    lags = np.array([free.drawn(np.random.default_rng(seed)).tilt_lag for seed in range(50)])
    assert np.mean((low <= lags) & (lags <= high)) < 0.9       # the other intervals allow more
    impossible = replace(robot, intervals=robot.intervals | {'tilt_lag': (low / 10, low / 5)})
    with pytest.raises(ParameterError, match='tilt_lag'):
        impossible.drawn(np.random.default_rng(0))


def test_an_interval_belongs_to_the_value_of_its_file(tmp_path):
    (tmp_path / 'mine.yaml').write_text('extends: robot.yaml\n' + MEASURED)
    (tmp_path / 'other.yaml').write_text(
        'extends: mine.yaml\nrotors: {time_constant: 0.2}\nmass: 3.1\n')
    assert list(RobotParameters.load(tmp_path / 'other.yaml').intervals) == [
        'effects.joint_bandwidth.kp']
    (tmp_path / 'effect.yaml').write_text(
        'extends: mine.yaml\neffects: {rotor_lag: {time_constant: 0.2}}\n')
    assert RobotParameters.load(tmp_path / 'effect.yaml').intervals == {}


def test_an_effect_that_acts_by_another_one_is_refused_without_any(tmp_path):
    file = tmp_path / 'mine.yaml'
    wind = 'wind_velocity: {velocity: [1, 0, 0]}'
    file.write_text(f'extends: robot.yaml\neffects: {{{wind}, body_drag: {{coefficient: 0.1}}}}\n')
    assert RobotParameters.load(file).effects['wind_velocity']['velocity'] == (1, 0, 0)
    file.write_text(f'extends: robot.yaml\neffects: {{{wind}, mass: {{mass: 3.1}}}}\n')
    with pytest.raises(ParameterError, match=r'mine\.yaml: .*wind_velocity: expected one of'):
        RobotParameters.load(file)


@pytest.mark.parametrize('text', [
    'mass: [4, 5]', 'mass: 3', 'name: [1, 2]', 'effects.wind.force: [0, 1]'])
def test_an_interval_that_does_not_hold_its_value_is_refused(tmp_path, text):
    (tmp_path / 'mine.yaml').write_text(f'extends: robot.yaml\nintervals: {{{text}}}\n')
    with pytest.raises(ParameterError, match=r'mine\.yaml: key .intervals.*expected') as error:
        RobotParameters.load(tmp_path / 'mine.yaml')
    assert text.partition(':')[0] in str(error.value)
