"""Processes of the launch file by its arguments, with launch replaced; their discovery."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import shutil
import stat
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.ros import graph
from beetle_omni_ros.ros.graph import BRIDGES


class Recorded:
    """Stand-in for any class of launch, which stores its arguments."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs


@pytest.fixture
def bringup(monkeypatch):
    """Load the launch file against stand-ins for the modules of launch."""
    classes = {'launch': ['LaunchDescription'],
               'launch.actions': ['DeclareLaunchArgument', 'ExecuteProcess', 'OpaqueFunction',
                                  'Shutdown'],
               'launch.substitutions': ['LaunchConfiguration']}
    for name, members in classes.items():
        module = ModuleType(name)
        for member in members:
            setattr(module, member, type(member, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setenv(graph.RANGE, 'LOCALHOST')        # put back afterwards
    monkeypatch.setattr(graph, 'unfit', lambda *_: '')    # a compatible policy exists
    spec = spec_from_file_location('bringup', share_path('launch/bringup.launch.py'))
    module = module_from_spec(spec)
    spec.loader.exec_module(module)

    def start(**arguments):
        declared = module.generate_launch_description().args[0][:-1]
        given = {d.args[0]: d.kwargs['default_value'] for d in declared}
        assert set(arguments) <= set(given)
        given.update(arguments)
        monkeypatch.setattr(module.LaunchConfiguration, 'perform',
                            lambda self, context: given[self.args[0]], raising=False)
        return module.actions(None)

    module.start, module.at_exit = start, []
    monkeypatch.setattr(module, 'atexit', SimpleNamespace(
        register=lambda *call: module.at_exit.append(call)))
    yield module
    for _, folder, _ in module.at_exit:
        shutil.rmtree(folder, ignore_errors=True)


def given_to(processes):
    """Name -> parameters of the nodes of each process."""
    found = []
    for process in processes:
        words = process.kwargs['cmd']
        names = words[4:words.index('--ros-args')]
        stored = yaml.safe_load(Path(words[words.index('--params-file') + 1]).read_text())
        found.append({name: stored[f'/**/{name}']['ros__parameters'] for name in names})
    return found


def test_the_bridges_have_their_own_process(bringup):
    processes = bringup.start(seed='7', namespace='/robot1')
    assert all(one.kwargs['cmd'][-2:] == ['-r', '__ns:=/robot1'] for one in processes)
    nodes, bridges = given_to(processes)
    assert list(bridges) == list(BRIDGES) and nodes['sim_node']['seed'] == 7
    assert list(nodes) == ['ekf_node', 'nmpc_node', 'rl_node', 'supervisor_node', 'sim_node']


def test_simulator_and_bridges_meet_at_the_same_ports_in_a_private_folder(bringup):
    nodes, bridges = given_to(bringup.start())
    nodes |= bridges
    assert nodes['sim_node']['actuators'] == 'emulated'
    assert nodes['sim_node']['servo_port'] == nodes['joint_bridge_node']['port']
    assert nodes['sim_node']['board_port'] == nodes['rotor_bridge_node']['port']
    assert nodes['joint_bridge_node']['autostart'] == 'activate'
    folder = Path(nodes['sim_node']['servo_port']).parent
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    files = [str(share_path(f'params/{name}.yaml')) for name in ('robot', 'robot_measured')]
    direct, = given_to(bringup.start(actuators='direct', robot_file=files[0], plant_file=files[1]))
    assert 'actuators' not in direct['sim_node']
    assert [direct[name]['robot_file'] for name in ('ekf_node', 'sim_node')] == files


@pytest.mark.parametrize('argument, value, expected', [
    ('seed', 'abc', 'a whole number from 0 to 2147483647'), ('seed', '-1', 'a whole number'),
    ('seed', '2147483648', 'a whole number'), ('policy', '/nope.onnx', 'no such file'),
    ('params_file', '/nope.yaml', 'no such file'), ('robot_file', '/nope.yaml', 'no such file'),
    ('plant_file', '/nope.yaml', 'no such file')])
def test_an_unusable_argument_is_refused_by_its_name(bringup, argument, value, expected):
    with pytest.raises(ParameterError, match=f'^{argument}:={value}: (expected )?{expected}'):
        bringup.start(**{argument: value})


def test_a_parameter_file_overrides_the_arguments_in_every_process(bringup, tmp_path):
    file = tmp_path / 'mine.yaml'
    file.touch()
    for process in bringup.start(params_file=str(file), namespace='robot1'):
        words = process.kwargs['cmd']
        assert [words[k + 1] for k, word in enumerate(words) if word == '--params-file'][1:] == [
            str(file)]


@pytest.mark.parametrize('endings, shuts_down, status', [
    ([('composed', 2), ('bridges', 0)], [True, False], 2),      # a bag that exists
    ([('bridges', 2), ('composed', 0)], [True, False], 2),
    ([('bridges', -9), ('composed', 0)], [False, True], 137),   # the nodes land first
    ([('composed', 0), ('bridges', 0)], [True, False], 0)])
def test_the_launch_ends_with_the_status_of_what_failed_first(bringup, monkeypatch, endings,
                                                              shuts_down, status):
    processes = {one.kwargs['name']: one for one in bringup.start()}
    assert list(processes) == ['composed', 'bridges']
    context, reached, left = SimpleNamespace(is_shutdown=False), [], []
    for name, code in endings:
        action = processes[name].kwargs['on_exit'](SimpleNamespace(returncode=code), context)
        reached.append(action is not None)
        context.is_shutdown |= reached[-1]
    assert reached == shuts_down
    monkeypatch.setattr(bringup.os, '_exit', left.append)
    (function, folder, codes), = bringup.at_exit
    function(folder, codes)
    assert left == [status] * bool(status) and not Path(folder).exists()


def test_a_launch_with_a_bag_that_exists_ends_with_the_status_of_the_nodes(ros_domain, tmp_path):
    pytest.importorskip('launch.actions')       # of ROS; not on PyPI
    script = ('import sys\n'
              'from launch import LaunchService\n'
              'from launch.actions import IncludeLaunchDescription\n'
              'from launch.launch_description_sources import PythonLaunchDescriptionSource\n'
              'service = LaunchService()\n'
              'service.include_launch_description(IncludeLaunchDescription(\n'
              '    PythonLaunchDescriptionSource(sys.argv[1]),\n'
              '    launch_arguments=[("record", sys.argv[2])]))\n'
              'sys.exit(service.run())\n')
    done = subprocess.run([sys.executable, '-c', script, share_path('launch/bringup.launch.py'),
                           tmp_path], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert '[composed-1] recorder_node: error: ' in done.stdout and 'exists already' in done.stdout


@pytest.mark.parametrize('given, holds', [
    ({}, 'LOCALHOST'), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, 'SUBNET'),
    ({'ROS_STATIC_PEERS': '192.168.1.2'}, None), ({'ROS_LOCALHOST_ONLY': '0'}, None)])
def test_the_users_setting_has_precedence(given, holds):
    graph.confine(given)
    assert given.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == holds


def test_two_reserved_domains_differ(monkeypatch):
    with graph.reserved_domain() as first:
        monkeypatch.setattr(graph, '_starts', iter([graph.DOMAINS.index(first)]))
        with graph.reserved_domain() as second:
            assert second != first
