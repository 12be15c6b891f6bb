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
from typing import Any, ClassVar, get_args, get_type_hints, TypeVar

import numpy as np
import yaml

from beetle_omni_ros.model.resources import share_path

NAMES = tuple[str, ...]     # type of a parameter that is a list of names
NUMBER = (int, float, np.number)
Loaded = TypeVar('Loaded', bound='ParameterFile')     # Python 3.10 lacks Self
# Type of a field -> types of its value in a file, and their name.
KINDS: dict[Any, tuple[Any, str]] = {
    bool: (bool, 'true or false'), int: (NUMBER, 'an integer'), float: (NUMBER, 'a number'),
    np.ndarray: (object, 'numbers'), str: (str, 'text'), tuple: ((list, tuple), 'a list'),
    NAMES: ((list, tuple), 'a list of names'), dict: ((dict, NoneType), 'a mapping')}
QUOTED, MESSAGE = 200, 1500     # characters of a value in a message, and of a message

_short = reprlib.Repr()
_short.maxlevel, _short.maxlist, _short.maxtuple, _short.maxdict = 3, 8, 8, 8
_short.maxstring, _short.maxother = 120, 120


class RunError(RuntimeError):
    """A flight, a comparison or a training failed; the text is one line."""


class ParameterError(ValueError):
    """A parameter file or value cannot be used; the text names file, key and expected value."""

    def __init__(self, text: str):
        super().__init__(shortened(text, MESSAGE))


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

    ``default`` is the value if the file omits it, ``doc`` the meaning in one phrase, ``low`` and
    ``high`` are the smallest and largest legal value of a number or of each element of an array.
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
    """Read the one document of a YAML file; a ParameterError begins with the path."""
    try:
        data = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise ParameterError(f'{path}: cannot be read ({getattr(error, "strerror", error)})') \
            from None
    return parse_yaml(data, f'{path}: ')


@lru_cache(maxsize=32)      # a flight reads files several times
def _parsed(data):
    """Read YAML by libyaml, if PyYAML has it, in a tenth of the time."""
    return yaml.load(data, getattr(yaml, 'CSafeLoader', yaml.SafeLoader))


def parse_yaml(data: bytes | str, at: str = '') -> Any:
    """Read the one document of a YAML text; a ParameterError begins with ``at``."""
    try:
        return deepcopy(_parsed(data))
    except (yaml.YAMLError, RecursionError, AttributeError, LookupError, TypeError,
            ValueError) as error:   # PyYAML raises the others at `0b_` or a date with month 13
        mark = getattr(error, 'problem_mark', None)
        where = f' at line {mark.line + 1}, column {mark.column + 1}' if mark else ''
        problem = getattr(error, 'problem', None) or str(error)
        raise ParameterError(f'{at}not valid YAML{where} ({shortened(problem)})') from None


def load_yaml(path: str | Path) -> dict:
    """Read a YAML mapping, plain or below ``ros__parameters``; {} of an empty file."""
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
    def load(cls: type[Loaded], path: str | Path | None = None) -> Loaded:
        """Read a file, by default the shipped one; an error names file, key and expectation."""
        path = path or share_path(f'params/{cls._file}')
        return bind(cls, load_yaml(path), str(path))


def bind(cls: type, mapping: dict, where: str = '', prefix: str = ''):
    """
    Build a dataclass of :func:`parameter` and :func:`group` fields from a nested mapping.

    A ParameterError names ``where``, the file, and the key. ``prefix`` is the dotted path of
    ``cls`` in the file, with a dot at its end.
    """
    if not isinstance(mapping, dict):
        raise ParameterError(f'{_at(where, prefix)}: expected a mapping, '
                             f'found {type(mapping).__name__}')
    hints: dict[str, Any] = get_type_hints(cls)
    known = {f.name: f for f in fields(cls) if f.init}
    for key in mapping:
        if key not in known:
            raise unknown(_at(where, f'{prefix}{key}'), 'key', key, known)
    values: dict[str, Any] = {}
    for name, entry in known.items():
        at, hint = _at(where, f'{prefix}{name}'), hints[name]
        if name not in mapping:
            if entry.default is MISSING and entry.default_factory is MISSING:
                raise ParameterError(f'{at}: missing{_unit(entry.metadata)}')
            continue
        value, (inner, *more) = mapping[name], get_args(hint) or (hint,)
        nested, optional = is_dataclass(inner), more == [NoneType]
        if value is None and optional:
            values[name] = None
        elif nested and more == [...]:      # tuple[Class, ...]
            values[name] = tuple(bind(inner, row, where, f'{prefix}{name}[{k}].')
                                 for k, row in enumerate(check(entry, tuple, value, at)))
        elif nested:
            values[name] = bind(inner, value, where, f'{prefix}{name}.')
        else:
            values[name] = check(entry, inner if optional else hint, value, at)
    try:
        return cls(**values)
    except ParameterError as error:
        raise ParameterError(f'{_at(where, prefix)}: {error}' if where else str(error)) from None


def check(entry, hint: Any, value: Any, at: str) -> Any:
    """Validate a value of a field; ``at`` is file and key, for messages."""
    spec, (kinds, what) = entry.metadata, KINDS[hint]
    fits = isinstance(value, kinds) and isinstance(value, bool) == (hint is bool)
    if fits and hint == NAMES:
        fits = all(isinstance(name, str) for name in value)
    if fits and hint in (int, float, np.ndarray):
        array = numbers(value, at, spec)
        if hint is np.ndarray:
            shape = spec['shape'] or (array.size,)
            if array.ndim == 1 and array.size == np.prod(shape):
                return array.reshape(shape)     # ROS has flat arrays only
            if array.shape != shape:
                raise ParameterError(f'{at}: expected shape {shape}, found {array.shape}')
            return array
        fits = value == hint(value)
    if not fits:
        raise ParameterError(f'{at}: expected {what}{_unit(spec)}, found {quoted(value)}')
    choices = spec['choices']
    if choices and value not in choices:
        raise ParameterError(f"{at}: expected one of {', '.join(choices)}, found {quoted(value)}")
    return hint(() if value is None else value)


def unknown(at: str, what: str, name: Any, known: Iterable[str]) -> ParameterError:
    """Error of a name that is not one of the known ones."""
    near = get_close_matches(str(name), known, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
    return ParameterError(f'{at}: unknown {what}; {hint}')


def numbers(value: Any, at: str, spec: Mapping[str, Any]) -> np.ndarray:
    """Convert to finite numbers from ``spec['low']`` to ``spec['high']`` [``spec['unit']``]."""
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
            unit = spec['unit'] if spec['unit'] != '1' else ''
            raise ParameterError(
                f'{at}: {number:g} is outside {low:g} to {high:g} {unit}'.rstrip())
    return array


def _unit(spec):
    return f" [{spec['unit']}]" if spec['unit'] else ''


def _at(where, key):
    """Place in a message; ``key`` may end with a dot."""
    return ': '.join(filter(None, (where, key and f"key '{key.strip('.')}'"))) or 'parameters'


def flatten(instance, prefix: str = ''):
    """Yield dotted name, dataclass field, annotated type and value of each parameter."""
    hints = get_type_hints(type(instance))
    for entry in fields(instance):
        value = getattr(instance, entry.name)
        name = f'{prefix}{entry.name}'
        if is_dataclass(hints[entry.name]):
            yield from flatten(value, f'{name}.')
        else:
            yield name, entry, hints[entry.name], value


def nest(flat: dict[str, Any]) -> dict:
    """Turn dotted names into the nested mapping that :func:`bind` takes."""
    nested: dict = {}
    for name, value in flat.items():
        put(nested, name, value)
    return nested


def put(mapping: dict, name: str, value: Any) -> None:
    """Set the value of a dotted name; a part that is no mapping is passed over."""
    *path, leaf = name.split('.')
    for part in path:
        level = mapping.setdefault(part, {})
        mapping = level if isinstance(level, dict) else mapping
    mapping[leaf] = value
