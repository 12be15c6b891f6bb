"""The blind flights share no code with the tested package."""

import ast
from pathlib import Path

from gap_data.cases import GENERATOR
import pytest

ROOT = Path(__file__).resolve().parents[2] / 'benchmarks' / 'gap_data'


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ''


@pytest.mark.parametrize('path', sorted(ROOT.rglob('*.py')), ids=lambda path: path.stem)
def test_no_file_imports_the_package(path):
    assert not [name for name in imported(path) if name.split('.')[0] == 'beetle_omni_ros']


def test_the_cache_key_covers_every_file_of_the_generator():
    files, left = set(), ['make']
    while left:
        files.add(file := f'{left.pop()}.py')
        left += [name.removeprefix('gap_data.') for name in imported(ROOT / file)
                 if name.startswith('gap_data.')
                 and f'{name.removeprefix("gap_data.")}.py' not in files]
    # `cases` itself is in the key by its content: the case's fields
    assert files - {'cases.py'} <= set(GENERATOR)
