"""benchmarks/aarch64.py has the requirements of setup.py, and runs existing tests."""

import importlib.util
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope='module')
def aarch64():
    script = ROOT / 'benchmarks' / 'aarch64.py'
    if not script.is_file():
        pytest.skip('no source checkout')
    spec = importlib.util.spec_from_file_location('aarch64', script)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_wheels_exist_for_every_requirement_of_a_flight(aarch64):
    names = {re.split(r'[\[<>=;!~ ]', one)[0] for group in aarch64.requirements().values()
             for one in group}
    assert {'casadi', 'mujoco', 'onnxruntime', 'numpy', 'scipy', 'rosbags', 'pymavlink',
            'dynamixel-sdk', 'pyserial'} <= names
    assert not names & {'torch', 'pytest', 'ros-jazzy-rclpy'}


def test_the_tests_exist_and_cover_each_part_of_the_flight_path(aarch64):
    assert all((ROOT / test).is_file() for test in aarch64.TESTS)
    assert {test.split('/')[1] for test in aarch64.TESTS} == {
        'estimation', 'control', 'safety', 'drivers'}


def test_dependencies_are_resolved_transitively_with_the_first_alternative(aarch64):
    known = {'a': {'Depends': 'b (>= 1), c | d'}, 'b': {'Pre-Depends': 'e:any'}, 'c': {}, 'd': {},
             'e': {'Depends': 'a, missing'}}
    assert aarch64.closure(known, ['a']) == ['a', 'b', 'c', 'e']
