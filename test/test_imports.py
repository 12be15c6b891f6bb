"""Imports point one way, and heavy or special libraries stay in their subpackage."""

import ast
from pathlib import Path
import sys

import pytest

from beetle_omni_ros.robot.resources import PACKAGE

SOURCE = Path(sys.modules[PACKAGE].__file__).parent

# Subpackage -> permitted imports of the package beside itself. A new one needs a line here.
ALLOWED = {
    'robot': (),
    'start': (),
    'pages': ('robot',),
    'control': ('robot',),
    'estimation': ('robot',),
    'drivers': ('robot',),
    'sim': ('robot', 'drivers.mavlink'),     # framing of the emulated board
    'safety': ('robot', 'control.base', 'control.registry'),
    'messages': ('robot', 'control.base', 'control.registry'),
    'runs': ('robot', 'control.base', 'control.registry', 'pages', 'messages'),
    'stack': ('robot', 'control.base', 'control.hover', 'control.registry', 'estimation',
              'drivers', 'sim', 'safety', 'runs', 'messages'),
    'evaluation': ('robot', 'control', 'stack', 'sim', 'runs', 'messages'),
    'faults': ('robot', 'pages', 'control', 'sim', 'safety', 'runs', 'evaluation', 'stack'),
    'comparison': ('robot', 'pages', 'control', 'runs', 'evaluation'),
    'identify': ('robot', 'pages', 'runs', 'messages'),
    'bringup': ('robot', 'drivers', 'runs.files', 'messages.values'),
    'drive': ('robot',),
    'view': ('robot', 'control.base', 'pages', 'runs', 'messages'),
    'nodes': ('robot', 'control', 'estimation', 'sim', 'safety', 'runs', 'drivers', 'drive',
              'messages', 'view', 'bringup.findings', 'stack'),
    'train': ('robot', 'control.guidance', 'control.policy_file', 'runs.files'),
    'cli': ('robot', 'pages', 'control', 'estimation', 'sim', 'safety', 'runs', 'evaluation',
            'comparison', 'faults', 'nodes', 'train', 'identify', 'bringup', 'view'),
}

# Library -> the only subpackage that imports it.
KEPT_IN = {'mujoco': 'sim', 'rclpy': 'nodes', 'launch': 'nodes', 'torch': 'train',
           'rsl_rl': 'train', 'tensordict': 'train', 'dynamixel_sdk': 'drivers',
           'pymavlink': 'drivers', 'serial': 'drivers', 'viser': 'view', 'trimesh': 'view'}


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
            home = 'nodes' if top.endswith(('_msgs', '_srvs')) else KEPT_IN.get(top, folder)
            assert folder == home, f'{path}:{line}: {top} is imported only in {home}/'
            own = name.removeprefix(f'{PACKAGE}.')
            assert own in (name, '__version__') or any(
                is_below(own, place) for place in (folder, *ALLOWED[folder])), \
                f'{path}:{line}: {folder} must not import {own}'


def test_every_folder_has_a_line():
    assert {subpackage_of(path) for path in FILES} == set(ALLOWED)
