"""Every Python file has the style of pyproject.toml, and the core is typed."""

import importlib.util
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_ruff_has_nothing_to_say():
    if importlib.util.find_spec('ruff'):
        ruff = [sys.executable, '-m', 'ruff']
    elif shutil.which('ruff'):
        ruff = ['ruff']
    else:
        pytest.skip('ruff is not installed')
    done = subprocess.run([*ruff, 'check', '--no-cache', '--output-format', 'concise', str(ROOT)],
                          cwd=ROOT, capture_output=True, text=True, check=False, timeout=60,
                          env={**os.environ, 'NO_COLOR': '1'})
    assert done.returncode == 0, f'{done.stdout}\n{done.stderr}'


def test_mypy_has_nothing_to_say():
    if not importlib.util.find_spec('mypy'):
        pytest.skip('mypy is not installed')
    done = subprocess.run([sys.executable, '-m', 'mypy', '--no-color-output'], cwd=ROOT,
                          capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, f'{done.stdout}\n{done.stderr}'
