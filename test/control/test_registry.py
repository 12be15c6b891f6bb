"""The registry: controllers by names and classes, and refusals."""

from pathlib import Path
import sys
from types import SimpleNamespace

import pytest

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.registry import ControllerOptions
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

ROBOT = RobotParameters.load()
ROOT = Path(__file__).resolve().parents[2]
MODULE = '''
from dataclasses import dataclass
import numpy as np
from beetle_omni_ros.control.base import Command
from beetle_omni_ros.model.schema import parameter


class MyController:
    """Holds still.

    For tests.
    """

    period = 0.02

    def reset(self):
        pass

    def step(self, state, target):
        return Command(state.stamp, np.zeros(4), np.full(4, 7.0))


class Tuned(MyController):
    """Has parameters."""

    name = 'my_tuned'

    @dataclass(frozen=True, kw_only=True)
    class Parameters:
        gain: float = parameter(2.0, doc='of the law', low=0, high=9)

    parameters_file = 'tuned.yaml'

    def __init__(self, robot, parameters):
        self.gain = parameters.gain

    def set_health(self, health):
        pass


class Needs(MyController):
    def __init__(self, robot, gain):
        pass


class Narrow(MyController):
    def step(self, state):
        pass


class Slow(MyController):
    period = 5
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Change to a folder with a module of controllers; return its name."""
    name = f'own_{tmp_path.name}'.replace('-', '_')
    (tmp_path / f'{name}.py').write_text(MODULE)
    (tmp_path / 'tuned.yaml').write_text('gain: 3.0\n')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'path', list(sys.path))
    return name


def test_every_shipped_controller_is_built_and_satisfies_the_protocol():
    for name, entry in registry.SHIPPED.items():
        # the policy of the published training may not be there
        if name != 'rl_published' or (ROOT / entry.policy_file).is_file():
            controller = entry.make(ROBOT)
            assert entry.name == name and entry.reference == name and entry.description
            assert hasattr(controller, 'set_health') == entry.flies_degraded


def test_a_class_is_found_by_module_and_by_file_under_its_own_name(module, tmp_path):
    for spec in (f'{module}:MyController', f'{tmp_path / module}.py:MyController',
                 f'./{module}.py:MyController'):
        entry = registry.find(spec)
        assert (entry.name, entry.description) == ('my_controller', 'Holds still.')
        assert entry.make(ROBOT).step(SimpleNamespace(stamp=1.0), None).stamp == 1.0
        # the reference for other processes is valid in any folder
        assert registry.find(entry.reference).name == 'my_controller'
    assert Path(registry.find(f'./{module}.py:MyController').reference).is_absolute()


def test_parameters_and_attributes_of_a_class_are_used(module, tmp_path):
    entry = registry.find(f'{module}:Tuned')
    assert entry.name == 'my_tuned' and entry.flies_degraded
    assert entry.make(ROBOT, ControllerOptions(without='all')).gain == 3.0
    (tmp_path / 'other.yaml').write_text('gain: 4.0\n')
    assert entry.make(ROBOT, ControllerOptions(parameters=tmp_path / 'other.yaml')).gain == 4.0
    (tmp_path / 'other.yaml').write_text('gian: 4.0\n')
    with pytest.raises(ParameterError, match="gian.*did you mean 'gain'"):
        entry.make(ROBOT, ControllerOptions(parameters=tmp_path / 'other.yaml'))


@pytest.mark.parametrize('spec, message', [
    ('nmpx', 'expected one of nmpc, rl, .*FILE.py:Class or package.module:Class'),
    ('{}:Absent', "no 'Absent' in .*its classes: .*MyController"),
    ('{}:Needs', "building it raised TypeError: .*'gain'"),
    ('{}:Narrow', r'expected a method step\(state, target\)'),
    ('{}:Slow', 'period is 5, expected .* at most 1 s'),
    ('{}_absent:My', "no module '.*_absent'"), ('{}.py', 'expected FILE.py:Class')])
def test_an_unusable_class_is_refused_in_one_line(module, spec, message):
    with pytest.raises(ParameterError, match=message) as caught:
        registry.find(spec.format(module)).make(ROBOT)
    assert '\n' not in str(caught.value)


def test_a_class_with_a_syntax_error_is_refused_with_file_and_line(tmp_path):
    (tmp_path / 'wrong.py').write_text('import numpy\n\nclass My:\n    def step(self:\n')
    with pytest.raises(ParameterError, match=r'raised SyntaxError: .* \(wrong.py:4\)$'):
        registry.find(f'{tmp_path}/wrong.py:My')


def test_two_controllers_of_the_same_name_are_refused(module, tmp_path):
    with pytest.raises(ParameterError, match='both are called my_controller'):
        registry.find_all(['nmpc', f'{module}:MyController', f'{module}.py:MyController'])


def test_the_fallback_is_the_first_controller_that_flies_with_lost_actuators():
    assert registry.pilot() == 'nmpc'
    assert registry.pilot(['rl', 'hover']) == 'hover'
    assert registry.pilot(['rl']) == ''
