"""The blind flights share no code with the tested package."""

import ast
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[2] / 'benchmarks' / 'gap_data'
FILES = sorted(ROOT.rglob('*.py'))
GENERATOR = ('truth', 'hidden', 'mjcf', 'plant', 'rotors', 'effects', 'effects_body',
             'effects_actuators', 'effects_sensors', 'effects_outside', 'controller', 'courses',
             'gusts', 'flight', 'sensors', 'bags', 'cases', 'make')


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ''


@pytest.mark.parametrize('path', FILES, ids=lambda p: p.stem)
def test_no_file_imports_the_package(path):
    assert not [name for name in imported(path) if name.split('.')[0] == 'beetle_omni_ros']


def test_the_whole_generator_loads_without_the_package():
    code = (f'import sys; sys.path.insert(0, {str(ROOT.parent)!r})\n'
            + ''.join(f'import gap_data.{name}\n' for name in GENERATOR)
            + 'found = [m for m in sys.modules if m.split(".")[0] == "beetle_omni_ros"]\n'
            'assert not found, found')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=False, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_cache_key_covers_every_file_of_the_generator():
    from gap_data.cases import GENERATOR as KEYED
    # `cases` itself is in the key by its content: the case's fields
    assert {f'{name}.py' for name in GENERATOR} - {'cases.py'} <= set(KEYED)
