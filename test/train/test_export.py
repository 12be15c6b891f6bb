"""The policy file computes the same as the network, and has all data that a flight needs."""

import copy
from pathlib import Path

from learning import environment, only, ROBOT, small
import numpy as np
import onnx
import pytest
import torch

import beetle_omni_ros
from beetle_omni_ros.control.policy_file import PolicyContract, PolicyNetwork, verify
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.train import network as module
from beetle_omni_ros.train.batch import Draw
from beetle_omni_ros.train.network import actor_of, export_policy, ExportedPolicy
from beetle_omni_ros.train.runner import Runner


def actor(memory=False, carry=0.5, rows=2):
    """A network in which every weight has an effect."""
    parameters = small({'memory': memory, 'network.carry': carry, 'network.hidden': [32, 16],
                        'network.history': rows})
    made = Runner(parameters, ROBOT).alg.actor
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in made.mlp.parameters():
            weight.copy_(0.3 * torch.randn(weight.shape, generator=generator))
    return made, parameters


@pytest.mark.parametrize(('memory', 'carry', 'rows'), [
    (False, 0.5, 0), (False, 0.5, 3), (True, 0.0, 0), (True, 0.0, 8)])
def test_the_file_acts_in_flight_as_the_network_does_in_training(tmp_path, memory, carry, rows):
    network, parameters = actor(memory, carry, rows)
    path = tmp_path / 'policy.onnx'
    assert 0 <= export_policy(network, path, ROBOT, parameters, {}) <= 1e-5
    onboard, size = PolicyNetwork(path, ROBOT), 39 if memory else 33
    env = environment({'memory': memory, 'network.history': rows, **only('moving')}, robots=4)
    expected, found = [], []
    for step in range(2 * rows + 4):
        with torch.no_grad():
            expected.append(network.mean(env.observation)[0].numpy())
        found.append(onboard(env.observation[0, :size].tolist()))
        env.advance(torch.randn(4, 8, generator=torch.Generator().manual_seed(step)))
        assert not env.done[0]
    np.testing.assert_allclose(found, expected, atol=1e-5 * max(np.abs(expected).max(), 1))
    onboard.reset()
    past = env.observation[:, size:]
    with torch.no_grad():
        seen, _ = env._observe(env.state, Draw(torch.rand(4, 40)), torch.ones(4) > 0)
        np.testing.assert_allclose(onboard(seen[0, :size].tolist()), network.mean(seen)[0],
                                   atol=1e-5 * max(np.abs(expected).max(), 1))
    assert not rows or (seen[:, size:] != past).any()
    assert np.abs(np.diff(expected, axis=0)).min(1).max() > 1e-3     # they are not all the same


def test_a_policy_file_is_a_teacher_of_one_with_history(tmp_path):
    teacher, parameters = actor(rows=0)
    export_policy(teacher, tmp_path / 'policy.onnx', ROBOT, parameters, {})
    student, _ = actor(rows=2)
    seen = torch.randn(5, student.obs_dim)
    with torch.no_grad():
        torch.testing.assert_close(actor_of(tmp_path / 'policy.onnx', student).mean(seen),
                                   teacher.mean(seen), atol=1e-4, rtol=1e-5)


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
        seen = torch.full((1, network.obs_dim), 0.1)     # an empty history is the present
        expected = network.mean(seen)[0]
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
