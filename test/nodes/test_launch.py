"""Processes of the launch file by its arguments; launch itself is replaced."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import stat
import sys
from types import ModuleType

import pytest

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


def test_the_bridges_have_their_own_process(bringup):
    process, bridges = (one.kwargs['cmd'] for one in bringup.start(seed='7', namespace='/robot1'))
    assert bridges[4:6] == list(BRIDGES) and bridges[-2:] == ['-r', '__ns:=/robot1']
    assert process[4:process.index('--ros-args')] == [
        'ekf_node', 'nmpc_node', 'rl_node', 'supervisor_node', 'sim_node']
    assert 'sim_node:seed:=7' in process


def given_to(processes):
    """Name -> parameters of the nodes of all processes, as texts."""
    found = {}
    for process in processes:
        words = process.kwargs['cmd']
        names = words[4:words.index('--ros-args')]
        found |= {name: {} for name in names}
        for word in (after for flag, after in zip(words, words[1:]) if flag == '-p'):
            node, key, value = word.replace(':=', ':', 1).split(':', 2)
            found[node][key] = value
    return found


def test_simulator_and_bridges_meet_at_the_same_ports_in_a_private_folder(bringup):
    nodes = given_to(bringup.start())
    assert nodes['sim_node']['actuators'] == 'emulated'
    assert nodes['sim_node']['servo_port'] == nodes['joint_bridge_node']['port']
    assert nodes['sim_node']['board_port'] == nodes['rotor_bridge_node']['port']
    assert nodes['joint_bridge_node']['autostart'] == 'activate'
    folder = Path(nodes['sim_node']['servo_port']).parent
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    direct = given_to(bringup.start(actuators='direct', robot_file='a.yaml',
                                    plant_file='b.yaml'))
    assert not set(BRIDGES) & set(direct) and 'actuators' not in direct['sim_node']
    assert [direct[name]['robot_file'] for name in ('sim_node', 'ekf_node')] == [
        'b.yaml', 'a.yaml']
