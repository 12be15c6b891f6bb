"""
Parameters: dataclass fields with default, unit, range and meaning, and the YAML files of changes.

A parameter file is YAML, either plain or in the ROS 2 form (``/**: ros__parameters: ...``). The
same file serves a node's ``--params-file`` and tools without ROS. Every error is one line that
names file, key and expected value.
"""

from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import field, fields, is_dataclass, MISSING
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
import reprlib
from types import NoneType
from typing import Any, ClassVar, get_args, get_type_hints, Self

import numpy as np
import yaml

from beetle_omni_ros.robot.resources import share_path

NAMES = tuple[str, ...]     # type of a parameter that is a list of names
# Type of a field that is no number -> types of its value in a file, and their name.
KINDS: dict[Any, tuple[Any, str]] = {
    bool: ((bool,), 'true or false'), str: ((str,), 'text'), tuple: ((list, tuple), 'a list'),
    NAMES: ((list, tuple), 'a list of names'), dict: ((dict, NoneType), 'a mapping')}
MAX_BYTES = 1 << 20     # of a file; the shipped ones have up to 16 kB
QUOTED = 200            # characters of a value in a message
FILE_NAME, KEY, WHOLE = 500, 80, 1000    # characters of them in a message

_short = reprlib.Repr()
_short.maxlevel, _short.maxlist, _short.maxtuple, _short.maxdict = 3, 8, 8, 8
_short.maxstring, _short.maxother = 120, 120


class RunError(RuntimeError):
    """A flight, a comparison or a training failed; the text is one line."""


class ParameterError(ValueError):
    """A parameter file or value cannot be used; the text names file, key and expected value."""


def quoted(value: Any) -> str:
    """Represent any value in one line of at most ``QUOTED`` characters."""
    return shortened(_short.repr(value), QUOTED)


def shortened(text: str, length: int = QUOTED) -> str:
    """Shorten to one line of at most ``length`` characters."""
    line = ' '.join(text[:4 * length].split())
    return line if len(line) <= length and len(text) <= 4 * length else f'{line[:length - 3]}...'


def parameter(default: Any = MISSING, *, doc: str, unit: str = '', low: float | None = None,
              high: float | None = None, shape: tuple[int, ...] | None = None,
              choices: tuple[str, ...] | None = None):
    """
    Declare one dataclass field as a parameter.

    Args:
        default: value if the file omits it; a list is copied into an array.
        doc: meaning in one phrase, for the reference page and ROS.
        unit: SI unit, '' for a pure number.
        low: smallest legal value, inclusive (each element of an array).
        high: largest legal value, inclusive.
        shape: shape of an array parameter.
        choices: legal strings.

    """
    metadata = {'doc': doc, 'unit': unit, 'low': low, 'high': high, 'shape': shape,
                'choices': choices}
    if isinstance(default, (list, np.ndarray)):
        default = np.array(default, dtype=float)
    if isinstance(default, (dict, np.ndarray)):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def group(cls: type, doc: str = ''):
    """Declare a nested dataclass of parameters that defaults to ``cls()``."""
    return field(default_factory=cls, metadata={'doc': doc})


def read_yaml(path: str | Path) -> Any:
    """
    Read the one document of a YAML file.

    Raises:
        ParameterError: missing, unreadable or too large file, or broken YAML.

    """
    at = shortened(str(path), FILE_NAME)
    try:
        with open(path, 'rb') as file:
            data = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        raise ParameterError(f'{at}: cannot be read ({getattr(error, "strerror", error)})') \
            from None
    if len(data) > MAX_BYTES:
        raise ParameterError(f'{at}: larger than {MAX_BYTES} bytes')
    return parse_yaml(data, f'{at}: ')


_parsed = lru_cache(maxsize=32)(yaml.safe_load)     # a flight reads files several times, in 40 ms


def parse_yaml(data: bytes | str, at: str = '') -> Any:
    """Read the one document of a YAML text; raises ParameterError that starts with ``at``."""
    try:
        return deepcopy(_parsed(data))
    except yaml.YAMLError as error:
        mark = getattr(error, 'problem_mark', None)
        where = f' at line {mark.line + 1}, column {mark.column + 1}' if mark else ''
        problem = getattr(error, 'problem', None) or str(error)
        raise ParameterError(f'{at}not valid YAML{where} ({shortened(problem)})') from None
    except RecursionError:
        raise ParameterError(f'{at}not valid YAML (too deep)') from None
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        # PyYAML's own errors about values such as `0b_` or a date with month 13
        raise ParameterError(f'{at}not valid YAML ({shortened(str(error))})') from None


def load_yaml(path: str | Path) -> dict:
    """
    Read a YAML mapping, plain or below ``ros__parameters``.

    Raises:
        ParameterError: missing or unreadable file, broken YAML, or no mapping.

    """
    data = read_yaml(path)
    for value in data.values() if isinstance(data, dict) else ():
        if isinstance(value, dict) and set(value) == {'ros__parameters'}:
            data = value['ros__parameters']
            break
    if not isinstance(data, dict | None):
        raise ParameterError(f'{path}: expected a mapping of keys, found {type(data).__name__}')
    return data or {}


class ParameterFile:
    """
    Base of the dataclass of a parameter file.

    A subclass names its shipped file: ``class EkfParameters(ParameterFile, file='ekf.yaml')``.
    """

    _file: ClassVar[str]

    def __init_subclass__(cls, file: str = '', **keywords):
        """Set the shipped file; a subclass of a subclass inherits it."""
        super().__init_subclass__(**keywords)
        if file:
            cls._file = file

    @classmethod
    def load(cls, path: str | Path | None = None) -> Self:
        """
        Read a file, by default the shipped one.

        Raises:
            ParameterError: names file, key and expected value.

        """
        return load(cls, path or share_path(f'params/{cls._file}'))


def load(cls: type, path: str | Path):
    """Read ``path`` and bind it to the parameter dataclass ``cls``."""
    return bind(cls, load_yaml(path), str(path))


def bind(cls: type, mapping: dict, where: str = '', prefix: str = ''):
    """
    Build ``cls`` from a nested mapping.

    Args:
        cls: a dataclass whose fields come from :func:`parameter` or :func:`group`.
        mapping: keys to values, nested like the dataclass.
        where: file name, for messages.
        prefix: dotted path of ``cls`` in the file, for messages.

    Raises:
        ParameterError: unknown or missing key, wrong type, shape or range.

    """
    if not isinstance(mapping, dict):
        raise ParameterError(f'{_at(where, prefix)}: expected a mapping, '
                             f'found {type(mapping).__name__}')
    hints: dict[str, Any] = get_type_hints(cls)
    known = {f.name: f for f in fields(cls) if f.init}
    for key in mapping:
        if key not in known:
            raise unknown(_at(where, _join(prefix, key)), 'key', key, known)
    values: dict[str, Any] = {}
    for name, entry in known.items():
        key, hint = _join(prefix, name), hints[name]
        if name not in mapping:
            if entry.default is MISSING and entry.default_factory is MISSING:
                raise ParameterError(f'{_at(where, key)}: missing{_unit(entry.metadata)}')
            continue
        value = mapping[name]
        if NoneType in get_args(hint):      # Class | None
            hint = get_args(hint)[0]
            if value is None:
                values[name] = None
                continue
        nested = is_dataclass(hint)
        values[name] = bind(hint, value, where, key) if nested \
            else check(entry, hint, value, _at(where, key))
    try:
        return cls(**values)
    except ParameterError as error:
        text = f'{_at(where, prefix)}: {error}' if where else str(error)
        raise ParameterError(shortened(text, FILE_NAME + WHOLE)) from None


def check(entry, hint: Any, value: Any, at: str) -> Any:
    """Validate a value of a field; ``at`` is file and key, for messages."""
    if hint is np.ndarray:
        return _array(entry, value, at)
    if hint in (int, float):
        return _number(entry, hint, value, at)
    kinds, what = KINDS[hint]
    if not isinstance(value, kinds) or (
            hint == NAMES and not all(isinstance(name, str) for name in value)):
        raise ParameterError(f'{at}: expected {what}, found {quoted(value)}')
    choices = entry.metadata['choices']
    if choices and value not in choices:
        raise ParameterError(f"{at}: expected one of {', '.join(choices)}, found {quoted(value)}")
    return hint(value or ()) if hint in (tuple, dict, NAMES) else value


def unknown(at: str, what: str, name: Any, known: Iterable[str]) -> ParameterError:
    """Error of a name that is not one of the known ones."""
    near = get_close_matches(str(name)[:KEY], known, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
    return ParameterError(f'{at}: unknown {what}; {hint}')


def _number(entry, hint, value, at):
    """Finite int or float within its range."""
    found = numbers(value, at, entry.metadata) if isinstance(
        value, (int, float, np.number)) and not isinstance(value, bool) else None
    if found is None or value != hint(value):
        kind = 'an integer' if hint is int else 'a number'
        raise ParameterError(f'{at}: expected {kind}{_unit(entry.metadata)}, '
                             f'found {quoted(value)}')
    return hint(value)


def _array(entry, value, at):
    """(n,) or the declared shape, of finite numbers within their range."""
    array, shape = numbers(value, at, entry.metadata), entry.metadata['shape']
    if shape is not None and array.shape == (np.prod(shape),):
        array = array.reshape(shape)    # ROS has flat arrays only
    if shape is not None and array.shape != tuple(shape):
        raise ParameterError(f'{at}: expected shape {tuple(shape)}, found {array.shape}')
    if shape is None and array.ndim != 1:
        raise ParameterError(f'{at}: expected a list of numbers, found {quoted(value)}')
    return array


def numbers(value: Any, at: str, spec: Mapping[str, Any]) -> np.ndarray:
    """
    Convert to finite numbers from ``spec['low']`` to ``spec['high']`` [``spec['unit']``].

    Raises:
        ParameterError: the text starts with ``at``.

    """
    try:
        array = np.array(value, dtype=float)
    except (OverflowError, TypeError, ValueError):
        raise ParameterError(f'{at}: expected numbers{_unit(spec)}, '
                             f'found {quoted(value)}') from None
    low, high = (limit if spec[name] is None else spec[name]
                 for name, limit in (('low', -np.inf), ('high', np.inf)))
    for number in array.ravel():
        if not np.isfinite(number):
            raise ParameterError(f'{at}: {number} is not finite')
        if not low <= number <= high:
            raise ParameterError(
                f"{at}: {number:g} is outside {low:g} to {high:g} {spec['unit']}".rstrip())
    return array


def _unit(spec):
    return f" [{spec['unit']}]" if spec['unit'] else ''


def _join(prefix, key):
    key = shortened(str(key), KEY)
    return f'{prefix}.{key}' if prefix else key


def _at(where, key):
    parts = (shortened(where, FILE_NAME), f"key '{key}'" if key else '')
    return ': '.join(part for part in parts if part) or 'parameters'


def flatten(instance, prefix: str = ''):
    """
    Iterate over the leaves of a parameter dataclass.

    Yields:
        (dotted name, dataclass field, annotated type, value) of each leaf.

    """
    hints = get_type_hints(type(instance))
    for entry in fields(instance):
        value = getattr(instance, entry.name)
        name = _join(prefix, entry.name)
        if is_dataclass(hints[entry.name]):
            yield from flatten(value, name)
        else:
            yield name, entry, hints[entry.name], value


def nest(flat: dict[str, Any]) -> dict:
    """Turn dotted names into the nested mapping that :func:`bind` takes."""
    nested: dict = {}
    for name, value in flat.items():
        *path, leaf = name.split('.')
        level = nested
        for part in path:
            level = level.setdefault(part, {})
        level[leaf] = value
    return nested
