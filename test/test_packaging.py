"""The metadata for colcon, pip, ros2 and rosdep are complete and consistent."""

from importlib import import_module
import importlib.util
from pathlib import Path
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
from test_imports import imports

import beetle_omni_ros
from beetle_omni_ros import start
from beetle_omni_ros.model.resources import PACKAGE, share_path

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = ElementTree.parse(ROOT / 'package.xml').getroot()
HAS_ROS = importlib.util.find_spec('rclpy') is not None

# Import name -> distribution on PyPI, where they differ; import name -> rosdep key.
DISTRIBUTION = {'yaml': 'pyyaml', 'serial': 'pyserial', 'dynamixel_sdk': 'dynamixel-sdk',
                'rsl_rl': 'rsl-rl-lib', 'PIL': 'pillow', 'rerun': 'rerun-sdk'}
KEY = {'yaml': 'python3-yaml', 'mcap': 'mcap-ros2-support', 'casadi': 'casadi-pip',
       'serial': 'python3-serial', 'PIL': 'python3-pil'}


@pytest.fixture(scope='module')
def setup_arguments():
    """Keyword arguments of setuptools in setup.py."""
    code = ('import json, runpy, setuptools; setuptools.setup = '
            'lambda **given: print(json.dumps(given)); runpy.run_path("setup.py")')
    pytest.importorskip('setuptools')
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=True, timeout=60,
                          capture_output=True, text=True)
    import json
    return json.loads(done.stdout)


def third_party_imports():
    """Top-level modules that the package imports, without its own and Python's."""
    found = {name.split('.')[0] for path in (ROOT / PACKAGE).rglob('*.py')
             for name, _ in imports(path)}
    return sorted(found - set(sys.stdlib_module_names) - {PACKAGE})


def is_ros(module):
    """Whether a module is part of ROS."""
    return module in ('rclpy', 'launch', 'ament_index_python',
                      'builtin_interfaces') or module.endswith(('_msgs', '_srvs', '_interfaces'))


def dependencies(*tags):
    """Names under ``tags`` in package.xml."""
    return {entry.text for tag in tags for entry in MANIFEST.findall(tag)}


def test_name_version_and_licence_agree_everywhere(setup_arguments):
    assert MANIFEST.find('name').text == setup_arguments['name'] == PACKAGE
    assert MANIFEST.find('version').text == beetle_omni_ros.__version__
    assert f'\nversion: {beetle_omni_ros.__version__}\n' in (ROOT / 'CITATION.cff').read_text()
    assert setup_arguments['version'] == beetle_omni_ros.__version__
    assert MANIFEST.find('license').text == setup_arguments['license'] == 'BSD-3-Clause'
    assert (ROOT / MANIFEST.find('license').get('file')).is_file()


def test_every_executable_has_its_function(setup_arguments):
    scripts = setup_arguments['entry_points']['console_scripts']
    assert scripts
    for script in scripts:
        _, target = (part.strip() for part in script.split('='))
        module, function = target.split(':')
        program, = getattr(import_module(module), function).args
        if program == start.TOOL:
            assert callable(import_module(f'{PACKAGE}.cli').main), script
        elif HAS_ROS and program != 'composed':     # which names its nodes
            assert callable(import_module(f'{PACKAGE}.ros.runner').maker(program)), script


def test_every_folder_of_code_is_installed(setup_arguments):
    folders = {path.parent.relative_to(ROOT).as_posix().replace('/', '.')
               for path in (ROOT / PACKAGE).rglob('*.py')}
    assert folders == set(setup_arguments['packages'])


def test_data_files_are_in_the_folders_of_ros(setup_arguments):
    installed = {f'{folder}/{Path(file).name}': ROOT / file
                 for folder, files in setup_arguments['data_files'] for file in files}
    assert all(path.is_file() for path in installed.values())
    assert f'share/ament_index/resource_index/packages/{PACKAGE}' in installed
    expected = [ROOT / 'package.xml', *(ROOT / 'params').glob('*.yaml'),
                *(ROOT / 'launch').glob('*.launch.py'), *(ROOT / 'description').glob('*.urdf')]
    assert len(expected) > 3
    for path in expected:
        target = f'share/{PACKAGE}/{path.relative_to(ROOT).as_posix()}'
        assert installed.get(target) == path, f'{target}: not installed'


def test_every_import_is_a_declared_requirement(setup_arguments):
    extras = setup_arguments['extras_require']
    lines = [*setup_arguments['install_requires'], *(line for extra in (
        'hardware', 'train', 'gym', 'notebook', 'rerun') for line in extras[extra])]
    declared = {re.split(r'[\[<>=~;! ]', line)[0] for line in lines}
    keys = dependencies('exec_depend', 'depend')
    without_key = re.search('No key exists for (.*?):', (ROOT / 'package.xml').read_text(),
                            re.DOTALL).group(1)
    for module in third_party_imports():
        if is_ros(module):
            assert module in keys, f'{module}: not in package.xml'
            continue
        assert DISTRIBUTION.get(module, module) in declared, f'{module}: not in setup.py'
        if module not in ('torch', 'tensordict', 'onnx', 'rsl_rl', 'gymnasium', 'pandas', 'rerun'):
            candidates = {KEY.get(module), f'python3-{module}', f'python3-{module}-pip', module}
            assert keys & candidates or module in without_key, f'{module}: no rosdep key'


def test_every_requirement_states_the_oldest_version(setup_arguments):
    for line in setup_arguments['install_requires']:
        # the form that .ci/oldest reads
        assert 'python_version' in line or re.fullmatch(r'[a-z0-9-]+>=[0-9.]+(,<[0-9.]+)?', line)


def parameter_classes():
    """Shipped parameter file -> the class of its reference."""
    spec = importlib.util.spec_from_file_location('reference', ROOT / 'docs/generate_reference.py')
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    shipped = {path.name for path in (ROOT / 'params').glob('*.yaml')}
    shipped.remove('faults.yaml')       # a list of docs/faults.md, no parameters
    robots = {name for name in shipped if name.startswith('robot_')}    # without a table
    assert shipped - robots == set(reference.FILES) - robots
    places = {name: reference.FILES.get(name, reference.FILES['robot.yaml'])[0].split(':')
              for name in shipped}
    return {name: getattr(import_module(f'{PACKAGE}.{module}'), kind)
            for name, (module, kind) in places.items()}


def test_each_parameter_file_is_read_by_the_class_of_its_reference():
    for name, kind in parameter_classes().items():
        assert isinstance(kind.load(share_path(f'params/{name}')), kind)


def test_a_checkout_has_precedence_over_an_installation(tmp_path, monkeypatch):
    other = tmp_path / 'share' / PACKAGE
    (other / 'params').mkdir(parents=True)
    (other / 'package.xml').touch()
    (other / 'params' / 'robot.yaml').touch()
    (other / 'params' / 'elsewhere.yaml').touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    assert share_path('params/robot.yaml') == ROOT / 'params' / 'robot.yaml'
    assert share_path('params/elsewhere.yaml') == other / 'params' / 'elsewhere.yaml'
    with pytest.raises(FileNotFoundError, match='nowhere.yaml'):
        share_path('params/nowhere.yaml')
