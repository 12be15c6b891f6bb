"""The policy file computes the same as the network, and has all data that a flight needs."""

import copy
from pathlib import Path

from learning import environment, ROBOT, small
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

import beetle_omni_ros
from beetle_omni_ros.control.policy_file import PolicyContract, PolicyNetwork, verify
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.train import network as module
from beetle_omni_ros.train.network import export_policy, ExportedPolicy
from beetle_omni_ros.train.runner import Runner


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


@pytest.mark.parametrize(('memory', 'carry'), [(False, 0.5), (True, 0.0)])
def test_torch_and_onnxruntime_agree(tmp_path, memory, carry):
    network, parameters = actor(memory, carry)
    path = tmp_path / 'policy.onnx'
    difference = export_policy(network, path, ROBOT, parameters, {})
    assert 0 <= difference <= 1e-5
    session = onnxruntime.InferenceSession(path, providers=['CPUExecutionProvider'])
    seen = observations(memory)
    with torch.no_grad():
        expected = network.mean(seen).numpy()
    found = np.concatenate([session.run(['action'], {'observation': row[None].numpy()})[0]
                            for row in seen])
    np.testing.assert_allclose(found, expected, atol=1e-5 * max(np.abs(expected).max(), 1))
    assert np.abs(np.diff(expected, axis=0)).min(1).max() > 1e-3     # they are not all the same


def test_the_file_is_complete_accepted_on_board_and_contains_no_local_path(tmp_path):
    network, parameters = actor(memory=True)
    path = tmp_path / 'policy.onnx'
    export_policy(network, path, ROBOT, parameters, {'seconds': 12.5})
    entries = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert set(entries) == {*PolicyContract.default(ROBOT).to_metadata(), 'checksum'}
    verify(path.read_bytes())
    contract = PolicyContract.from_metadata(entries)
    assert contract.check(ROBOT) == ''
    assert contract.memory and contract.observation_size == 39
    assert contract.version == beetle_omni_ros.__version__ and contract.created
    assert contract.training['seconds'] == 12.5
    assert contract.training['random.mass_scale'] == parameters.random.mass_scale
    action = PolicyNetwork(path, ROBOT)([0.1] * contract.observation_size)
    with torch.no_grad():
        expected = network.mean(torch.full((1, contract.observation_size), 0.1))[0]
    assert action == pytest.approx(expected.tolist(), abs=1e-4)
    for text in (str(Path(beetle_omni_ros.__file__).parents[1]), str(Path.home()), str(tmp_path),
                 'site-packages', '.py', 'train/network'):
        assert text.encode() not in path.read_bytes(), text


def test_a_wrong_export_is_detected_and_removed(tmp_path, monkeypatch):
    network, parameters = actor()
    wrong = copy.deepcopy(network)
    with torch.no_grad():
        wrong.mlp[-1].bias.add_(0.01)
    monkeypatch.setattr(module, 'ExportedPolicy', lambda _: ExportedPolicy(wrong))
    (tmp_path / 'policy.onnx').write_text('the one before')
    with pytest.raises(RunError, match=r'policy.onnx: torch and onnxruntime differ by'):
        export_policy(network, tmp_path / 'policy.onnx', ROBOT, parameters, {})
    assert [path.read_text() for path in tmp_path.iterdir()] == ['the one before']
