"""Processes of the launch file by its arguments, with launch replaced; their discovery."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import stat
import sys
from types import ModuleType

import pytest
import yaml

from beetle_omni_ros.nodes import graph
from beetle_omni_ros.nodes.graph import BRIDGES
from beetle_omni_ros.robot.resources import share_path


class Recorded:
    """Stand-in for any class of launch, which stores its arguments."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs


@pytest.fixture
def bringup(monkeypatch):
    """Load the launch file against stand-ins for the modules of launch."""
    classes = {'launch': ['LaunchDescription'],
               'launch.actions': ['DeclareLaunchArgument', 'ExecuteProcess', 'OpaqueFunction'],
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

    module.start = start
    return module


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
    direct, = given_to(bringup.start(actuators='direct', robot_file='a.yaml',
                                     plant_file='b.yaml'))
    assert 'actuators' not in direct['sim_node']
    assert [direct[name]['robot_file'] for name in ('sim_node', 'ekf_node')] == [
        'b.yaml', 'a.yaml']


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
