"""Parameter files: every error is refused in one line with file and key."""

from dataclasses import dataclass

import numpy as np
import pytest

from beetle_omni_ros.model import schema
from beetle_omni_ros.model.schema import group, parameter, ParameterError, ParameterFile


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A nested group."""

    gain: float = parameter(1.0, doc='a gain', unit='1/s', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class Outer(ParameterFile):
    """A parameter file's content."""

    mass: float = parameter(doc='mass', unit='kg', low=0.1, high=10)
    offset: np.ndarray = parameter([0, 0, 0], doc='offset', unit='m', shape=(3,), low=-1, high=1)
    mode: str = parameter('a', doc='mode', choices=('a', 'b'))
    count: int = parameter(3, doc='count', low=1, high=9)
    active: bool = parameter(True, doc='switch')
    inner: Inner = group(Inner)
    perhaps: Inner | None = parameter(None, doc='a group that may be absent')


def write(tmp_path, text):
    path = tmp_path / 'file.yaml'
    path.write_text(text)
    return path


def test_plain_and_ros_form_give_equal_parameters(tmp_path):
    plain = Outer.load(write(tmp_path, 'mass: 2\ninner: {gain: 3}\n'))
    ros = Outer.load(write(
        tmp_path, '/**:\n  ros__parameters:\n    mass: 2\n    inner: {gain: 3}\n'))
    assert plain.mass == ros.mass == 2.0
    assert plain.inner.gain == ros.inner.gain == 3.0


@pytest.mark.parametrize('text, message', [
    ('{}', "key 'mass': missing [kg]"),
    ('mass: 2\nmas: 3\n', "key 'mas': unknown key; did you mean 'mass'?"),
    ('mass: 2\ninner: {gian: 3}\n', "key 'inner.gian': unknown key; did you mean 'gain'?"),
    ('mass: heavy\n', "key 'mass': expected a number [kg], found 'heavy'"),
    ('mass: 3038.6\n', "key 'mass': 3038.6 is outside 0.1 to 10 kg"),
    ('mass: .nan\n', 'is not finite'),
    ('mass: 2\noffset: [0, 0]\n', 'expected shape (3,), found (2,)'),
    ('mass: 2\noffset: [0, 0, 5]\n', '5 is outside -1 to 1 m'),
    ('mass: 2\nmode: c\n', "expected one of a, b, found 'c'"),
    ('mass: 2\ncount: 2.5\n', 'expected an integer'),
    ('mass: 2\nactive: 1\n', 'expected true or false'),
    ('mass: 2\ninner: 5\n', 'expected a mapping'),
    ('- 1\n', 'expected a mapping of keys'),
    ('mass: [1\n', 'not valid YAML at line'),
    ('mass: ' + '[' * 30000 + '\n', 'depth'),
    ('mass: 2001-13-01\n', 'not valid YAML'),
])
def test_a_mistake_is_named_with_file_and_key_in_one_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ParameterError) as error:
        Outer.load(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)
    assert '\n' not in str(error.value)


@pytest.mark.parametrize('text, gain', [
    ('mass: 1\n', None), ('mass: 1\nperhaps: null\n', None),
    ('mass: 1\nperhaps: {gain: 2}\n', 2.0), ('mass: 1\nperhaps: {}\n', 1.0)])
def test_an_optional_group_may_be_absent(tmp_path, text, gain):
    found = Outer.load(write(tmp_path, text)).perhaps
    assert (found and found.gain) == gain


def test_flatten_and_nest_invert_each_other():
    outer = Outer(mass=2.0, inner=Inner(gain=4.0))
    flat = {name: value for name, _, _, value in schema.flatten(outer)}
    again = schema.bind(Outer, schema.nest(flat))
    assert again.mass == 2.0 and again.inner == outer.inner
    assert set(flat) >= {'mass', 'inner.gain'}
