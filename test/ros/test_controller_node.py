"""Nodes of registered controllers: by name, by class, their files, which may stand by."""

from pathlib import Path

import pytest
from rclpy.parameter import Parameter

from beetle_omni_ros.control import registry
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.ros import graph
from beetle_omni_ros.ros.graph import controller_nodes
from beetle_omni_ros.ros.nodes import supervisor_node
from beetle_omni_ros.ros.runner import maker

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
OWN, OBSERVER = (f'{EXAMPLES}/own_controller.py:PoseController',
                 f'{EXAMPLES}/own_component.py:WrenchObserver')


def test_the_supervisor_selects_among_the_listed_controllers(make):
    node = make(supervisor_node, f"controllers:=['nmpc','{OWN}']", 'controller:=pose_controller')

    def put(name, value):
        return node.set_parameters([Parameter(name, value=value)])[0]

    assert node.component.supervisor.active == 'pose_controller'
    assert put('controller', 'nmpc').successful and node.component.supervisor.active == 'nmpc'
    refused = put('controller', 'rl')
    assert not refused.successful and 'nmpc, pose_controller' in refused.reason
    assert node.component.supervisor.active == 'nmpc' and not put('takeoff_height', 2.0).successful


def test_an_active_controller_outside_the_supervisors_list_is_refused(make):
    with pytest.raises(ParameterError, match="'controller': expected one of nmpc, rl, found 'x'"):
        make(supervisor_node, 'controller:=x')


def test_the_plan_of_a_graph_with_another_controller(tmp_path):
    nodes, _ = graph.plan(OWN, actuators='direct', bag='/b', task='hover')
    known = ['pose_controller', *registry.STANDING_BY]
    assert nodes['pose_controller_node'] == {'controller': OWN}
    assert nodes['supervisor_node']['controller'] == 'pose_controller'
    for name in ('supervisor_node', 'recorder_node'):
        assert nodes[name]['controllers'] == known
    command = graph.commands(nodes, tmp_path)[graph.COMPOSED]
    assert OWN in command and 'ekf_node' in command
    alone, _ = graph.plan(OWN, actuators='direct', standby=False)
    assert list(alone) == ['ekf_node', 'pose_controller_node', 'supervisor_node', 'sim_node']


def test_a_component_of_others_is_a_node_with_its_topics(make):
    node = make(maker(OBSERVER))
    assert '/observer/force' in {one.topic_name for one in node.publishers}
    assert {'/command', '/odom', '/imu/data_raw'} <= {one.topic_name for one in node.subscriptions}
    assert node.get_name() == node.component.name == 'wrench_observer_node'


def test_files_reach_their_nodes_and_a_shipped_policy_that_cannot_fly_is_left_out(
        tmp_path, monkeypatch):
    pytest.importorskip('onnx')
    from policy_files import write
    policy = str(write(tmp_path / 'policy.onnx'))
    other = {'robot_file': str(share_path('params/robot_weak_and_heavy.yaml'))}
    nmpc = tmp_path / 'nmpc.yaml'
    nmpc.write_text('limits: {velocity: 2.0}\n')
    nodes, _ = controller_nodes('nmpc', {}, policy=policy, nmpc=str(nmpc))
    assert list(nodes) == ['nmpc_node', 'rl_node']
    assert nodes['nmpc_node'] == {'nmpc_file': str(nmpc)}
    nodes, _ = controller_nodes('nmpc', other, policy=policy)
    assert nodes['rl_node'] == {**other, 'policy': policy}
    # A policy that the user names is refused, also on standby, instead of being left out.
    for active, robot, file, reason in (
            ('rl', {}, 'none.onnx', 'no such file'), ('nmpc', {}, 'none.onnx', 'no such file'),
            ('nmpc', {}, nmpc, 'checksum')):
        with pytest.raises(ParameterError, match=reason):
            controller_nodes(active, robot, policy=str(tmp_path / file))
    with pytest.raises(ParameterError, match="--policy .*: for the controller 'rl', which does"):
        controller_nodes('nmpc', {}, policy=policy, standby=False)
    monkeypatch.setattr('beetle_omni_ros.ros.graph.unfit', lambda *_: 'no onnxruntime')
    assert controller_nodes('nmpc', {}) == ({'nmpc_node': {}}, {'rl': 'no onnxruntime'})
