"""The policy file computes the same as the network, and has all data that a flight needs."""

from pathlib import Path

from learning import environment, ROBOT, small
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

import beetle_omni_ros
from beetle_omni_ros.control.policy_file import PolicyContract, PolicyNetwork, verify
from beetle_omni_ros.robot.schema import RunError
from beetle_omni_ros.train import export
from beetle_omni_ros.train.export import export_policy
from beetle_omni_ros.train.network import ExportedPolicy
from beetle_omni_ros.train.runner import Runner

VARIANTS = [(False, 0.5), (False, 0.0), (True, 0.5), (True, 0.0)]


def actor(memory=False, carry=0.5):
    """A network in which every weight has an effect."""
    parameters = small({'memory': memory, 'network.carry': carry, 'network.hidden': [32, 16]})
    made = Runner(parameters, ROBOT).alg.actor
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in made.mlp.parameters():
            weight.copy_(0.3 * torch.randn(weight.shape, generator=generator))
    return made, parameters


def observations(memory, count=64):
    """Observations of simulated robots, and random ones."""
    seen = environment({'memory': memory}, robots=count).observation
    return torch.cat((seen, torch.randn(seen.shape, generator=torch.Generator().manual_seed(1))))


@pytest.mark.parametrize(('memory', 'carry'), VARIANTS)
def test_the_exported_graph_computes_the_mean_of_the_network(memory, carry):
    network, _ = actor(memory, carry)
    lean = ExportedPolicy(network)
    with torch.no_grad():
        for row in observations(memory):
            torch.testing.assert_close(lean(row[None]), network.mean(row[None]), atol=1e-5,
                                       rtol=1e-5)


@pytest.mark.parametrize(('memory', 'carry'), VARIANTS)
def test_torch_and_onnxruntime_agree(tmp_path, memory, carry):
    network, parameters = actor(memory, carry)
    path = tmp_path / 'policy.onnx'
    difference = export_policy(network, path, ROBOT, parameters)
    assert 0 <= difference <= 1e-5
    session = onnxruntime.InferenceSession(path, providers=['CPUExecutionProvider'])
    seen = observations(memory)
    with torch.no_grad():
        expected = network.mean(seen).numpy()
    found = np.concatenate([session.run(['action'], {'observation': row[None].numpy()})[0]
                            for row in seen])
    np.testing.assert_allclose(found, expected, atol=1e-5 * max(np.abs(expected).max(), 1))
    assert np.abs(np.diff(expected, axis=0)).min(1).max() > 1e-3     # they are not all the same


@pytest.mark.parametrize('memory', [False, True])
def test_the_file_is_complete_and_accepted_on_board(tmp_path, memory):
    network, parameters = actor(memory)
    path = tmp_path / 'policy.onnx'
    metrics = {'nominal': {'reached': 1.0, 'U_position_m': 0.013}}
    export_policy(network, path, ROBOT, parameters, {'seconds': 12.5}, metrics)
    entries = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert set(entries) == {*PolicyContract.default(ROBOT).to_metadata(), 'checksum'}
    verify(path.read_bytes())
    contract = PolicyContract.from_metadata(entries)
    assert contract.check(ROBOT) == ''
    assert contract.memory == memory and contract.observation_size == (39 if memory else 33)
    assert contract.metrics == metrics
    assert contract.version == beetle_omni_ros.__version__ and contract.created
    assert contract.training['seconds'] == 12.5
    assert contract.training['random.mass_scale'] == parameters.random.mass_scale
    assert contract.training['ppo.robots'] == parameters.ppo.robots
    assert contract.training['reward.position'] == parameters.reward.position
    action = PolicyNetwork(path, ROBOT)([0.1] * contract.observation_size)
    with torch.no_grad():
        expected = network.mean(torch.full((1, contract.observation_size), 0.1))[0]
    assert action == pytest.approx(expected.tolist(), abs=1e-4)


def test_the_file_contains_no_local_path(tmp_path):
    network, parameters = actor()
    path = tmp_path / 'policy.onnx'
    export_policy(network, path, ROBOT, parameters)
    data = path.read_bytes()
    here = (Path(beetle_omni_ros.__file__).parents[1], Path(torch.__file__).parents[1],
            Path.home(), tmp_path)
    for text in (*map(str, here), 'site-packages', '.py', 'train/network'):
        assert text.encode() not in data, text


@pytest.mark.parametrize('difference', [1e-4, float('nan')])
def test_a_wrong_export_is_removed(tmp_path, monkeypatch, difference):
    network, parameters = actor()
    monkeypatch.setattr(export, 'compare', lambda *_: difference)
    (tmp_path / 'policy.onnx').write_text('the one before')
    with pytest.raises(RunError, match=r'policy.onnx: torch and onnxruntime differ by'):
        export_policy(network, tmp_path / 'policy.onnx', ROBOT, parameters)
    assert [path.name for path in tmp_path.iterdir()] == ['policy.onnx']
    assert (tmp_path / 'policy.onnx').read_text() == 'the one before'


def test_the_comparison_detects_a_difference(tmp_path):
    network, parameters = actor()
    path = tmp_path / 'policy.onnx'
    export_policy(network, path, ROBOT, parameters)
    assert export.compare(network.mean, path, 33) <= 1e-5
    assert export.compare(lambda seen: network.mean(seen) + 0.1, path, 33) > 1e-3


def test_export_does_not_change_the_network(tmp_path):
    network, parameters = actor()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.train()
    export_policy(network, tmp_path / 'policy.onnx', ROBOT, parameters)
    assert network.training
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name])
