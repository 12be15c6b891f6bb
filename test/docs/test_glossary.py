"""One name, one thing: the glossary of CONTRIBUTING.md, and names of classes."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path
import re

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / 'beetle_omni_ros'


@cache
def modules_of_classes():
    """Class -> modules of the package that define it."""
    places = defaultdict(set)
    for path in SOURCE.rglob('*.py'):
        module = '.'.join(path.relative_to(SOURCE).with_suffix('').parts)
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.ClassDef):
                places[node.name].add(module)
    return places


def test_each_class_of_the_glossary_exists_where_it_is_said_to_be():
    text = (ROOT / 'CONTRIBUTING.md').read_text(encoding='utf-8')
    rows = re.findall(r'^\| ([^|]+) \| [^|]+ \| `(\w+)` \| `([\w.]+)` \|$', text, re.M)
    assert len(rows) >= 40 and len({term for term, *_ in rows}) == len(rows)
    assert [term for term, *_ in rows] == sorted(term for term, *_ in rows)
    places = modules_of_classes()
    for term, name, module in rows:
        assert places[name] == {module}, f'{term}: {name} in {places[name]}, expected {module}'


def test_a_class_name_has_one_meaning():
    twice = {name for name, modules in modules_of_classes().items() if len(modules) > 1}
    assert not twice, 'rename one of each'
