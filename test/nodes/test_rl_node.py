"""rl_node and its policy: commands, and which policy and controllers may stand by."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes.graph import controller_nodes
from beetle_omni_ros.nodes.runner import maker
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import JointReading
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

pytest.importorskip('onnx')

from policy_files import write

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def test_the_node_publishes_the_commands_of_the_policy(make, tmp_path):
    policy = write(tmp_path / 'policy.onnx', hidden=(32, 16), seed=5)
    node, sent = make(maker('rl_node'), f'policy:={policy}'), []
    node._publisher = SimpleNamespace(publish=sent.append)
    controller = PolicyController(RobotParameters.load(), replace(
        PolicyParameters.load(), policy=str(policy)))
    target = PoseTarget(np.array([0.2, 0.0, 1.5]), LEVEL, 0.9)
    node._on_target(target, np.nan)
    for k in range(10):
        odom = Odom(1.0 + 0.01 * k, np.array([0.0, 0.1 * k, 1.0]), np.array([0.1, 0.2, -0.3]),
                    np.array([0.5, 0.5, 0.5, 0.5]), np.array([0.3, 0.0, -0.1]))
        joints = JointReading(odom.stamp, np.array([0.1, -0.2, 0.3, 0.0]), np.zeros(4))
        node._on_joints(joints)
        node._on_odom(odom)
        expected = controller.step(State.join(odom, joints, None), target)
        assert np.allclose(sent[k].tilt, expected.tilt)
        assert np.allclose(sent[k].thrust, expected.thrust)
    assert node._controller_status()[2]['policy'] == 'rl'


def test_files_reach_their_nodes_and_an_unusable_policy_is_not_on_standby(tmp_path):
    policy = str(write(tmp_path / 'policy.onnx'))
    other = {'robot_file': str(share_path('params/robot_weak_and_heavy.yaml'))}
    nmpc = tmp_path / 'nmpc.yaml'
    nmpc.write_text('limits: {tilt_rate_share: 0.5}\n')
    nodes, _ = controller_nodes('nmpc', {}, policy=policy, nmpc=str(nmpc))
    assert list(nodes) == ['nmpc_node', 'rl_node']
    assert nodes['nmpc_node'] == {'nmpc_file': str(nmpc)}
    nodes, reason = controller_nodes('nmpc', other, policy=policy)
    assert list(nodes) == ['nmpc_node'] and 'mass' in reason['rl']
    nodes, reason = controller_nodes('nmpc', other, policy=policy, allow_other_robot=True)
    assert nodes['rl_node'] == {**other, 'policy': policy, 'allow_other_robot': True}
    with pytest.raises(ParameterError, match='no such file'):
        controller_nodes('rl', {}, policy=str(tmp_path / 'none.onnx'))
