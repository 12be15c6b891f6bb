"""Parameter files bound to dataclasses, with units, ranges and one-line errors.

A parameter file is YAML, either plain or in the ROS 2 form (``/**: ros__parameters: ...``). The
same file serves a node's ``--params-file`` and tools without ROS.
"""

from copy import deepcopy
from dataclasses import field, fields, is_dataclass, MISSING
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
import reprlib
import types
from typing import Any, ClassVar, get_args, get_origin, get_type_hints, TypeVar, Union

import numpy as np
import yaml

from beetle_omni_ros.robot.resources import share_path

# Parameters with more than numbers, from lists and mappings of a file.
STRUCTURED: dict[Any, tuple[tuple[type, ...], str]] = {
    tuple: ((list, tuple), 'a list'), dict: ((dict, type(None)), 'a mapping')}
File = TypeVar('File', bound='ParameterFile')
NAMES = tuple[str, ...]     # type of a parameter that is a list of names
FILE_NAME, KEY, WHOLE = 500, 80, 1000    # characters of them in a message
MAX_BYTES = 1 << 20     # the shipped files have 2 to 8 kB
MAX_NODES = 50_000      # with every alias written out
MAX_DEPTH = 40          # nested lists and mappings
QUOTED = 200            # characters of a value in a message

# Errors of PyYAML's constructors beside its own, for example for `0b_`, `!!bool x`, a date with
# month 13, or an integer of more than 4300 digits.
CONSTRUCTION = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


class YamlError(ValueError):
    """A file that cannot be read as YAML; the text is one line without the file's name."""


class _Short(reprlib.Repr):
    """Representations of bounded length and cost."""

    def __init__(self):
        super().__init__()
        self.maxlevel, self.maxlist, self.maxtuple, self.maxdict = 3, 8, 8, 8
        self.maxstring, self.maxother = 120, 120

    def repr_int(self, x, level):
        """Decimal digits; for a large integer, the number of its bits."""
        return repr(x) if x.bit_length() < 256 else f'an integer of {x.bit_length()} bits'


_short = _Short()


def quoted(value: Any) -> str:
    """Represent any value in one line of at most ``QUOTED`` characters."""
    return shortened(_short.repr(value), QUOTED)


def shortened(text: str, length: int = QUOTED) -> str:
    """Shorten to one line of at most ``length`` characters."""
    line = ' '.join(text[:4 * length].split())
    return line if len(line) <= length and len(text) <= 4 * length else f'{line[:length - 3]}...'


def read_yaml(path: str | Path) -> Any:
    """
    Read the one document of a YAML file.

    Raises:
        YamlError: missing, unreadable or too large file, broken YAML, too deep nesting, or
            aliases that stand for more than ``MAX_NODES`` values.

    """
    try:
        with open(path, 'rb') as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise YamlError(f'cannot be read ({error.strerror})') from None
    except ValueError:
        raise YamlError('cannot be read (no name of a file)') from None
    if len(data) > MAX_BYTES:
        raise YamlError(f'larger than {MAX_BYTES} bytes')
    return parse_yaml(data)


def parse_yaml(data: bytes | str) -> Any:
    """
    Read the one document of a YAML text.

    Raises:
        YamlError: as :func:`read_yaml`.

    """
    return deepcopy(_parsed(data))


@lru_cache(maxsize=32)      # one flight reads the same files several times, each in 40 ms
def _parsed(data):
    loader = None
    try:
        loader = yaml.SafeLoader(data)
        node = loader.get_single_node()
        if node is None:
            return None
        _size(node, {}, 0)
        return loader.construct_document(node)
    except RecursionError:
        raise YamlError(f'nested deeper than {MAX_DEPTH} levels') from None
    except yaml.YAMLError as error:
        raise YamlError(_problem(error)) from None
    except YamlError:
        raise
    except CONSTRUCTION as error:
        raise YamlError(f'not valid YAML ({shortened(str(error))})') from None
    finally:
        if loader is not None:
            loader.dispose()


def _size(node, sizes, depth):
    """Number of values of a node, with aliases expanded."""
    if depth > MAX_DEPTH:
        raise YamlError(f'nested deeper than {MAX_DEPTH} levels')
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in sizes:
        children = node.value if isinstance(node, yaml.SequenceNode) else \
            [child for pair in node.value for child in pair]
        sizes[id(node)] = 1 + sum(_size(child, sizes, depth + 1) for child in children)
    if sizes[id(node)] > MAX_NODES:
        raise YamlError(f'more than {MAX_NODES} values, with aliases written out')
    return sizes[id(node)]


def _problem(error):
    """One line about a syntax error, with its position if known."""
    mark = getattr(error, 'problem_mark', None)
    where = f' at line {mark.line + 1}, column {mark.column + 1}' if mark else ''
    problem = getattr(error, 'problem', None) or str(error).splitlines()[0]
    return f'not valid YAML{where} ({shortened(problem)})'


class RunError(RuntimeError):
    """A flight, a comparison or a training failed; the text is one line."""


class ParameterError(ValueError):
    """A parameter file or value cannot be used; the text names file, key and expected value."""


def parameter(default: Any = MISSING, *, doc: str, unit: str = '', low: float | None = None,
              high: float | None = None, shape: tuple[int, ...] | None = None,
              choices: tuple[str, ...] | None = None, read_only: bool = False):
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
        read_only: whether it can change only at start.

    """
    metadata = {'doc': doc, 'unit': unit, 'low': low, 'high': high, 'shape': shape,
                'choices': choices, 'read_only': read_only}
    if isinstance(default, (list, np.ndarray)):
        value = np.array(default, dtype=float)
        return field(default_factory=lambda: value.copy(), metadata=metadata)
    if isinstance(default, dict):
        return field(default_factory=lambda: dict(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def group(cls: type, doc: str = ''):
    """Declare a nested dataclass of parameters that defaults to ``cls()``."""
    return field(default_factory=cls, metadata={'doc': doc})


def load_yaml(path: str | Path) -> dict:
    """
    Read a YAML mapping, plain or below ``ros__parameters``.

    Raises:
        ParameterError: missing or unreadable file, broken YAML, or no mapping.

    """
    try:
        data = read_yaml(path)
    except YamlError as error:
        raise ParameterError(f'{shortened(str(path), FILE_NAME)}: {error}') from None
    for value in data.values() if isinstance(data, dict) else ():
        if isinstance(value, dict) and set(value) == {'ros__parameters'}:
            data = value['ros__parameters']
            break
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ParameterError(f'{path}: expected a mapping of keys, found {type(data).__name__}')
    return data


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
    def load(cls: type[File], path: str | Path | None = None) -> File:
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
    hints = get_type_hints(cls)
    known = {f.name: f for f in fields(cls) if f.init}
    for key in mapping:
        if key not in known:
            near = get_close_matches(str(key)[:KEY], known, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(known)}"
            raise ParameterError(f'{_at(where, _join(prefix, key))}: unknown key{hint}')
    values = {}
    for name, entry in known.items():
        key = _join(prefix, name)
        if name not in mapping:
            if entry.default is MISSING and entry.default_factory is MISSING:
                raise ParameterError(f'{_at(where, key)}: missing'
                                     f'{_unit_text(entry)}')
            continue
        nested = _nested(hints[name])
        if nested and not (mapping[name] is None and nested is not hints[name]):
            values[name] = bind(nested, mapping[name], where, key)
        else:
            values[name] = check(entry, hints[name], mapping[name], _at(where, key))
    try:
        return cls(**values)
    except ParameterError as error:
        text = f'{_at(where, prefix)}: {error}' if where else str(error)
        raise ParameterError(shortened(text, FILE_NAME + WHOLE)) from None


def _nested(hint):
    """Dataclass of a nested field, also as ``Class | None``; else None."""
    return next((part for part in (hint, *get_args(hint)) if is_dataclass(part)), None)


def check(entry, hint: type, value: Any, at: str) -> Any:
    """
    Validate one value against its declaration and convert it to its declared type.

    Args:
        entry: dataclass field made by :func:`parameter`.
        hint: annotated type of the field.
        value: value of the file or the user.
        at: file and key, for messages.

    """
    meta = entry.metadata
    optional = get_origin(hint) in (Union, types.UnionType)
    if optional:
        if value is None:
            return None
        hint = next(a for a in get_args(hint) if a is not type(None))
    if meta.get('shape') is not None or hint is np.ndarray:
        return _check_array(meta, value, at)
    if hint is bool:
        if not isinstance(value, bool):
            raise ParameterError(f'{at}: expected true or false, found {quoted(value)}')
        return value
    if hint in (int, float):
        return _check_number(entry, hint, value, at)
    if hint is str:
        if not isinstance(value, str):
            raise ParameterError(f'{at}: expected text, found {quoted(value)}')
        if meta.get('choices') and value not in meta['choices']:
            raise ParameterError(f"{at}: expected one of {', '.join(meta['choices'])}, "
                                 f'found {quoted(value)}')
        return value
    if hint == NAMES:
        if not isinstance(value, (list, tuple)) or not all(isinstance(v, str) for v in value):
            raise ParameterError(f'{at}: expected a list of names, found {quoted(value)}')
        return tuple(value)
    if hint in STRUCTURED:
        kinds, what = STRUCTURED[hint]
        if not isinstance(value, kinds):
            raise ParameterError(f'{at}: expected {what}, found {quoted(value)}')
        return hint(value or ())
    return value


def _check_number(entry, hint, value, at):
    """Finite int or float within its range."""
    kind = 'an integer' if hint is int else 'a number'
    found = f'{at}: expected {kind}{_unit_text(entry)}, found {quoted(value)}'
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise ParameterError(found)
    try:
        number = float(value)
    except (OverflowError, TypeError):      # an integer beyond float's range; a complex number
        raise ParameterError(found) from None
    _check_range(entry.metadata, number, at)
    if hint is int and value != int(value):
        raise ParameterError(found)
    return hint(value)


def _check_array(meta, value, at):
    """(n,) or the declared shape, of finite numbers within their range."""
    try:
        array = np.array(value, dtype=float)
    except (OverflowError, TypeError, ValueError):
        raise ParameterError(f'{at}: expected numbers, found {quoted(value)}') from None
    shape = meta.get('shape')
    if shape is not None and array.shape != tuple(shape):
        raise ParameterError(f'{at}: expected shape {tuple(shape)}, found {array.shape}')
    if shape is None and array.ndim != 1:
        raise ParameterError(f'{at}: expected a list of numbers, found {quoted(value)}')
    for element in array.ravel():
        _check_range(meta, float(element), at)
    return array


def _check_range(meta, value, at):
    low, high, unit = meta.get('low'), meta.get('high'), meta.get('unit')
    if not np.isfinite(value):
        raise ParameterError(f'{at}: {value} is not finite')
    if (low is not None and value < low) or (high is not None and value > high):
        span = f'{-np.inf if low is None else low:g} to {np.inf if high is None else high:g}'
        raise ParameterError(f'{at}: {value:g} is outside {span}' + (f' {unit}' if unit else ''))


def _unit_text(entry):
    unit = entry.metadata.get('unit')
    return f' [{unit}]' if unit else ''


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

