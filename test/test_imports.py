"""Imports point one way, and heavy or special libraries stay in their subpackage."""

import ast
from pathlib import Path
import sys

import pytest

from beetle_omni_ros.model.resources import PACKAGE

SOURCE = Path(sys.modules[PACKAGE].__file__).parent

# Subpackage -> permitted imports of the package beside itself. A new one needs a line here.
ALLOWED = {
    'model': (),
    'control': ('model',),
    'estimation': ('model',),
    'drivers': ('model', 'bags.messages'),
    'sim': ('model', 'drivers.mavlink'),     # framing of the emulated board
    'supervisor': ('model', 'control.base', 'control.registry', 'estimation.inputs'),
    'bags': ('model', 'control.base', 'control.registry', 'control.tasks'),
    'show': ('model', 'control.base', 'control.tasks', 'bags'),
    'flight': ('model', 'control', 'estimation', 'drivers', 'sim', 'supervisor', 'bags', 'show'),
    'identify': ('model', 'bags', 'show'),
    'train': ('model', 'control.guidance', 'control.policy_file'),
    'ros': ('model', 'control', 'estimation', 'drivers', 'sim', 'supervisor', 'bags', 'show',
            'flight'),
    # The command line.
    'start': (),
    'options': ('model', 'control'),
    'identify_commands': ('options', 'model', 'bags', 'show', 'flight', 'identify'),
    'commands': ('options', 'identify_commands', 'model', 'control', 'drivers',
                 'bags', 'show', 'flight', 'identify', 'train', 'ros'),
    'cli': ('model', 'commands', 'options'),
    '__main__': ('cli',),
}

# Library -> the only subpackage that imports it.
KEPT_IN = {'mujoco': 'sim', 'rclpy': 'ros', 'launch': 'ros', 'torch': 'train',
           'rsl_rl': 'train', 'tensordict': 'train', 'dynamixel_sdk': 'drivers',
           'pymavlink': 'drivers', 'serial': 'drivers', 'gymnasium': 'flight', 'viser': 'show',
           'trimesh': 'show', 'pandas': 'show'}


def imports(path):
    """Dotted names that a file imports, those inside functions too, with their line."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'), str(path))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}:{node.lineno}: relative import'
            # `from package import subpackage` names the subpackage only in the alias.
            yield from ((f'{node.module}.{alias.name}', node.lineno) for alias in node.names)


def subpackage_of(path):
    """Return the subpackage that a file of the package belongs to."""
    parts = path.relative_to(SOURCE).with_suffix('').parts
    return parts[0]


def is_below(name, place):
    """Tell whether dotted ``name`` is ``place`` or lies in it."""
    return name == place or name.startswith(place + '.')


FILES = sorted(path for path in SOURCE.rglob('*.py') if path.parent != SOURCE
               or path.stem != '__init__')


@pytest.mark.parametrize('folder', ALLOWED)
def test_imports_point_to_lower_folders_and_special_libraries_stay_in_theirs(folder):
    for path in FILES:
        if subpackage_of(path) != folder:
            continue
        for name, line in imports(path):
            top = name.split('.')[0]
            home = 'ros' if top.endswith(('_msgs', '_srvs')) else KEPT_IN.get(top, folder)
            assert folder == home, f'{path}:{line}: {top} is imported only in {home}/'
            own = name.removeprefix(f'{PACKAGE}.')
            assert own in (name, '__version__') or any(
                is_below(own, place) for place in (folder, *ALLOWED[folder])), \
                f'{path}:{line}: {folder} must not import {own}'


def test_every_folder_has_a_line():
    assert {subpackage_of(path) for path in FILES} == set(ALLOWED)
