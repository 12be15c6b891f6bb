"""Parameter files of unknown origin: refused in one bounded line that names file and key."""

import re
import time

import pytest

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import bind, load_yaml, ParameterError, quoted
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.train.run_folder import parse_changes

LONGEST = 1000      # characters of a refusal, beside the file's name
LAUGHS = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{two}: &{two} [{", ".join(["*" + one] * 9)}]\n'
    for one, two in zip('abcdefgh', 'bcdefghi', strict=True))


def refusal(cls, text, tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_text(text)
    begin = time.process_time()
    with pytest.raises(ParameterError) as error:
        cls.load(path)
    message = str(error.value)
    assert time.process_time() - begin < 3
    assert '\n' not in message and len(message) < LONGEST + len(str(path)), message[:2000]
    assert str(path) in message
    return message




@pytest.mark.parametrize('text, expected', [
    (LAUGHS, 'values, with aliases written out'),
    (LAUGHS + 'mass: *i\n', 'values, with aliases written out'),
    ('mass: ' + '[' * 30000 + '\n', 'nested deeper than'),
    ('mass: ' + '[' * 60 + ']' * 60 + '\n', 'nested deeper than'),
    ('a: &a [*a]\n', 'nested deeper than'),
    ('mass: ' + '9' * 5000 + '\n', 'not valid YAML'),
    ('mass: 0b_\n', 'not valid YAML'),
    ('mass: 2001-13-01\n', 'not valid YAML'),
    ('mass: !!bool x\n', 'not valid YAML'),
    ('mass: *' + 'x' * 5000 + '\n', 'not valid YAML at line 1'),
    ('x' * 2_000_000, 'larger than'),
    ('? ' + 'x' * 5000 + '\n: 1\n', 'unknown key'),
    ('/**: {ros__parameters: 3}\n', 'expected a mapping'),
    ('extends: [1]\n', "key 'extends': expected the name of a file"),
    ('extends: "a\\0b"\n', "key 'extends': expected the name of a file"),
    ('extends: ' + 'x' * 5000 + '\n', "key 'extends': expected the name of a file"),
])
def test_a_malicious_file_is_refused_in_one_line(tmp_path, text, expected):
    assert expected in refusal(RobotParameters, text, tmp_path)


@pytest.mark.parametrize('value, expected', [
    ('3', "key 'effects': expected a mapping, found 3"),
    ('[1]', "key 'effects': expected a mapping, found [1]"),
    ('{thrust_coefficient: {scale: 0x' + 'f' * 9000 + '}}', 'effects.thrust_coefficient.scale'),
    ('{thrust_coefficient: ' + 'x' * 9000 + '}', 'effects.thrust_coefficient: expected the keys'),
    ('{' + 'x' * 900 + ': 3}', 'unknown effect')])
def test_effects_of_another_kind_are_refused(tmp_path, value, expected):
    text = share_path('params/robot.yaml').read_text() + f'\neffects: {value}\n'
    assert expected in refusal(RobotParameters, text, tmp_path)


@pytest.mark.parametrize('cells, expected', [
    ('.nan', 'nan is not finite'), ('.inf', 'inf is not finite'), ('6.5', 'expected an integer'),
    ('0x' + 'f' * 9000, 'expected an integer, found an integer of 36000 bits')])
def test_an_integer_parameter_refuses_other_types(tmp_path, cells, expected):
    text = 'extends: robot.yaml\nbattery: {cells: ' + cells + '}\n'
    message = refusal(RobotParameters, text, tmp_path)
    assert "key 'battery.cells'" in message and expected in message


@pytest.mark.parametrize('rows', ['3', 'x', '{a: 1}'])
def test_a_thrust_map_refuses_other_types_than_lists(tmp_path, rows):
    message = refusal(RobotParameters, f'extends: robot.yaml\nrotors: {{map: {rows}}}\n', tmp_path)
    assert "key 'rotors.map': expected a list" in message


def test_a_charge_table_refuses_other_types_than_lists(tmp_path):
    text = share_path('params/simulator.yaml').read_text()
    text = re.sub(r'charge_levels: +\[[^]]*\]', 'charge_levels: 1.0', text)
    message = refusal(SimulatorParameters, text, tmp_path)
    assert "key 'battery.charge_levels': expected a list of numbers, found 1.0" in message


@pytest.mark.parametrize('text, expected', [
    ('grid: x\n', "key 'grid': expected a number [s], found 'x'"),
    ('grid: .nan\n', "key 'grid': nan is not finite"),
    ('grid: 1\n', "key 'grid': 1 is outside 0.005 to 0.05 s"),
    ('crowd: 2.5\n', "key 'crowd': expected an integer, found 2.5"),
    ('least_gian: 3\n', "key 'least_gian': unknown key; did you mean 'least_gain'?"),
    ('slow_below: 1.0\n', "key 'slow_below': 1 Hz is none of band_edges [0.3, 0.6, 1.2, 2.4]"),
    ('floors: 3\n', "key 'floors': expected shape (5,), found ()"),
    ('floors: [1, 2, 3, 4, x]\n', "key 'floors': expected numbers, found [1, 2, 3, 4, 'x']"),
    ('floors: [0.1, 0.1, 0.1, 0.1, -1]\n', "key 'floors': -1 is outside 1e-09 to 1000")])
def test_gap_parameters_have_type_range_and_shape(tmp_path, text, expected):
    assert expected in refusal(GapParameters, text, tmp_path)


def test_a_long_value_is_truncated_in_messages():
    for value in ('x' * 10**6, list(range(10**6)), dict.fromkeys(range(99), 'y' * 500),
                  'a\nb' * 999, 1 << 100_000, b'\xff' * 9999):
        assert len(quoted(value)) <= 200 and '\n' not in quoted(value)
    assert quoted('heavy') == "'heavy'" and quoted([1, 2.5]) == '[1, 2.5]'


def test_a_long_value_on_the_command_line_is_truncated_in_messages():
    with pytest.raises(ParameterError, match='not valid YAML') as error:
        parse_changes(['iterations=[' + '1, ' * 10000])
    assert len(str(error.value)) < LONGEST


def test_few_yaml_aliases_are_accepted(tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_text('base: &base {gain: 1}\nmore: {<<: *base, mass: 2}\nlist: [*base, *base]\n')
    assert load_yaml(path)['more'] == {'gain': 1, 'mass': 2}


def test_an_invalid_path_is_refused():
    with pytest.raises(ParameterError, match='cannot be read'):
        load_yaml('a\0b')


def test_parameter_values_of_a_node_are_bounded():
    with pytest.raises(ParameterError) as error:
        bind(RobotParameters, {'mass': 'x' * 10**6})
    assert len(str(error.value)) < LONGEST
