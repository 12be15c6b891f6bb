"""rl_node and its policy: commands, and which policy and controllers may stand by."""

import pytest

from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.ros.graph import controller_nodes

pytest.importorskip('onnx')

from policy_files import write


def test_files_reach_their_nodes_and_a_shipped_policy_that_cannot_fly_is_left_out(
        tmp_path, monkeypatch):
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
