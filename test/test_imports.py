"""Imports point one way, and heavy or special libraries stay in their subpackage."""

import ast
from pathlib import Path
import subprocess
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
    'sim': ('robot',),
    'safety': ('robot', 'control.base', 'control.registry'),
    'messages': ('robot', 'control.base', 'control.registry'),
    'runs': ('robot', 'control.base', 'control.registry', 'pages', 'messages'),
    'evaluation': ('robot', 'control', 'estimation', 'sim', 'safety', 'runs', 'messages'),
    'faults': ('robot', 'pages', 'control', 'estimation', 'sim', 'safety', 'runs', 'evaluation',
               'comparison.fingerprint'),
    'film': ('robot', 'pages', 'control.base', 'runs', 'sim'),
    'comparison': ('robot', 'pages', 'control', 'runs', 'evaluation'),
    'identify': ('robot', 'pages', 'runs', 'messages'),
    'bringup': ('robot', 'drivers', 'runs.json_file'),
    'drive': ('robot',),
    'view': ('robot', 'control.base', 'runs', 'messages'),
    'nodes': ('robot', 'control', 'estimation', 'sim', 'safety', 'runs', 'drivers', 'drive',
              'messages', 'view', 'bringup.graph'),
    'train': ('robot', 'control.observation', 'control.onnx_runtime', 'control.policy_file',
              'control.policy_checksum', 'runs.json_file'),
    'cli': ('robot', 'control', 'estimation', 'sim', 'safety', 'runs', 'evaluation', 'comparison',
            'faults', 'film', 'nodes', 'train', 'identify', 'bringup', 'view'),
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


def test_no_parameter_file_is_read_by_an_import():
    # Such a file, when it is broken, would fail every command in place of those that need it.
    code = """if True:
        import contextlib, importlib, sys
        def refuse(event, given):
            if event == 'open' and str(given[0]).endswith('.yaml'):
                raise RuntimeError(f'{given[0]} is read by an import')
        sys.addaudithook(refuse)
        for name in sys.argv[1:]:
            with contextlib.suppress(ModuleNotFoundError):      # without some extra
                importlib.import_module(name)"""
    names = ['.'.join((PACKAGE, *path.relative_to(SOURCE).with_suffix('').parts))
             for path in FILES if subpackage_of(path) not in ('nodes', 'train', 'start')]
    done = subprocess.run([sys.executable, '-c', code, *names], capture_output=True, text=True,
                          timeout=100)
    assert done.returncode == 0, done.stderr


def forbidden_imports(subpackage, names):
    """List the package's own names that ``subpackage`` must not import."""
    own = [name.removeprefix(PACKAGE + '.') for name in names if name.startswith(PACKAGE + '.')]
    legal = (subpackage, *ALLOWED[subpackage])
    return [name for name in own if name != '__version__'
            and not any(is_below(name, place) for place in legal)]


@pytest.mark.parametrize('path', FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_a_subpackage_imports_only_lower_subpackages(path):
    subpackage = subpackage_of(path)
    assert subpackage in ALLOWED, f'{path}: subpackage {subpackage} has no line in ALLOWED'
    wrong = forbidden_imports(subpackage, [name for name, _ in imports(path)])
    assert not wrong, f'{path}: {subpackage} must not import {wrong}'


@pytest.mark.parametrize('path', FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_special_libraries_are_imported_in_their_subpackage_only(path):
    subpackage = subpackage_of(path)
    for name, line in imports(path):
        top = name.split('.')[0]
        home = 'nodes' if top.endswith(('_msgs', '_srvs')) else KEPT_IN.get(top, subpackage)
        assert subpackage == home, f'{path}:{line}: {top} is imported only in {home}/'


def test_the_import_rule_detects_violations():
    assert forbidden_imports('control', [f'{PACKAGE}.sim.plant.Plant']) == ['sim.plant.Plant']
    assert forbidden_imports('safety', [f'{PACKAGE}.control.nmpc.NmpcController'])
    assert forbidden_imports('runs', [f'{PACKAGE}.estimation'])
    assert not forbidden_imports('safety', [f'{PACKAGE}.control.base.Command', 'numpy'])
    assert not forbidden_imports('nodes', [f'{PACKAGE}.sim.simulator.Simulator'])
