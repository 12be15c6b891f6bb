"""Reader of untrusted YAML files: limits of size, depth and aliases, errors of one line."""

from copy import deepcopy
from functools import lru_cache
from pathlib import Path
import reprlib
from typing import Any

import yaml

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


__all__ = ['parse_yaml', 'quoted', 'read_yaml', 'shortened', 'YamlError']
