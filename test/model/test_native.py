"""Compiled functions: equal results, one build, optional use."""

import shutil

import casadi as ca
import numpy as np
import pytest

from beetle_omni_ros.model import native
from beetle_omni_ros.model.dynamics import body_acceleration
from beetle_omni_ros.model.parameters import RobotParameters

needs_compiler = pytest.mark.skipif(
    not shutil.which('gcc') and not shutil.which('cc'), reason='no C compiler')
X = ca.SX.sym('x', 3)
FUNCTION = ca.Function('thing', [X], [ca.sin(X) * ca.exp(X[0]) / X[1]])


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    return tmp_path / 'beetle_omni_ros'


@needs_compiler
def test_compiled_and_interpreted_results_are_bitwise_equal():
    interpreted = body_acceleration(RobotParameters.load())
    compiled, generator = native.compiled(interpreted), np.random.default_rng(0)
    assert compiled.is_a('External') and not interpreted.is_a('External')
    for _ in range(20):
        arguments = [generator.normal(size=interpreted.numel_in(i))
                     for i in range(interpreted.n_in())]
        for found, expected in zip(compiled.call(arguments), interpreted.call(arguments)):
            assert np.array_equal(np.array(found), np.array(expected))


@needs_compiler
def test_code_is_built_once_and_again_after_a_change(cache):
    native.compiled(FUNCTION)
    first = {path: path.stat().st_mtime_ns for path in cache.iterdir()}
    assert len(first) == 1
    native.compiled(ca.Function('thing', [X], FUNCTION.call([X])))
    assert {path: path.stat().st_mtime_ns for path in cache.iterdir()} == first
    native.compiled(ca.Function('thing', [X], [2 * ca.sin(X)]))
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize(('variable', 'value'), [
    ('CC', 'no-such-cc'), ('CC', 'false'), ('XDG_CACHE_HOME', __file__)])
def test_without_compiled_code_the_interpreter_is_used(monkeypatch, variable, value):
    monkeypatch.setenv(variable, value)
    assert native.compiled(FUNCTION) is FUNCTION


def test_a_library_that_is_none_is_not_used(tmp_path, monkeypatch):
    (tmp_path / 'broken.so').write_text('no library')
    monkeypatch.setattr(native, 'built', lambda *_: tmp_path / 'broken.so')
    assert native.compiled(FUNCTION) is FUNCTION
