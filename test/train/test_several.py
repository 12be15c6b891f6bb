"""Training in several processes, here two on the CPU instead of two GPUs."""

import json
import os
from pathlib import Path
import subprocess
import sys

from learning import ROBOT, small
import pytest

from beetle_omni_ros.control.policy_file import PolicyNetwork
from beetle_omni_ros.train import command
from beetle_omni_ros.train.run_folder import read_parameters
from beetle_omni_ros.train.runner import is_rank_zero, Runner

HERE = Path(__file__).parent


@pytest.fixture(scope='module')
def ranks(tmp_path_factory):
    """Folder, output, and the results of two processes after training together."""
    folder = tmp_path_factory.mktemp('several')
    done = subprocess.run(
        [sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', '2',
         str(HERE / 'several_processes.py'), str(folder)], timeout=120, capture_output=True,
        text=True, check=False, env={**os.environ, 'OMP_NUM_THREADS': '1', 'PYTHONPATH':
                                     os.pathsep.join((str(HERE.parents[1]), str(HERE)))})
    assert done.returncode == 0, done.stderr[-3000:]
    return folder, done.stdout, [json.loads((folder / f'rank{rank}.json').read_text())
                                 for rank in (0, 1)]


def test_all_processes_have_the_same_network_and_their_own_robots(ranks):
    _, _, (first, second) = ranks
    assert first['status'] == second['status'] == 0
    assert first['distributed'] and second['distributed']
    assert first['begin'] == second['begin'] != first['weights']
    assert first['weights'] == second['weights'] and first['rate'] == second['rate']
    assert first['robots'] != second['robots']


def test_the_update_is_not_that_of_one_process_alone(ranks):
    alone = Runner(read_parameters(None, {**command.SMOKE, 'iterations': 1}), ROBOT)
    alone.train()
    weights = [value.detach().double().sum().item() for value in (
        *alone.alg.actor.parameters(), *alone.alg.critic.parameters())]
    assert weights != ranks[2][0]['weights']


def test_the_first_process_alone_writes(ranks):
    folder, output, (first, second) = ranks
    assert first['folder'] == str(folder / 'run') and second['folder'] == 'None'
    names = {path.name for path in (folder / 'run').iterdir()}
    assert {'train.yaml', 'model_1.pt', 'policy.onnx'} <= names and len(names) == 4
    assert output.count('2 x 32 robots on cpu') == output.count('agrees with torch') == 1


def test_all_processes_stop_with_the_first_one(ranks):
    assert [output['iterations'] for output in ranks[2]] == [1, 1]


def test_the_samples_of_all_are_counted(ranks):
    each = command.SMOKE['ppo.robots'] * command.SMOKE['ppo.steps']
    assert ranks[2][0]['samples'] == pytest.approx(2 * each)
    contract = PolicyNetwork(ranks[0] / 'run' / 'policy.onnx', ROBOT).contract
    assert contract.training['samples'] == 2 * each and contract.training['processes'] == 2


def test_one_process_of_torchrun_is_an_ordinary_training(monkeypatch):
    for name in ('WORLD_SIZE', 'RANK', 'LOCAL_RANK'):
        monkeypatch.setenv(name, '1' if name == 'WORLD_SIZE' else '0')
    made = Runner(small(), ROBOT)
    assert not made.is_distributed and is_rank_zero()


def test_each_process_takes_the_gpu_of_its_rank(monkeypatch):
    monkeypatch.setattr(command.torch.cuda, 'is_available', lambda: True)
    monkeypatch.setattr(command.torch.cuda, 'device_count', lambda: 4)
    assert command.choose_device('cuda:2') == 'cuda:2'
    monkeypatch.setenv('LOCAL_RANK', '3')
    assert command.choose_device('auto') == command.choose_device('cuda') == 'cuda:3'
    monkeypatch.setenv('LOCAL_RANK', '4')
    with pytest.raises(command.ParameterError, match='has 4 CUDA devices'):
        command.choose_device('cuda')


def test_several_gpus_are_set_up_by_rsl_rl(monkeypatch):
    # rsl-rl requires its device for each process; the error shows that its own set-up runs.
    monkeypatch.setenv('WORLD_SIZE', '2')
    monkeypatch.setenv('RANK', '1')
    monkeypatch.setenv('LOCAL_RANK', '1')
    made = Runner.__new__(Runner)
    made.device, made.cfg = 'cuda:0', {}
    with pytest.raises(ValueError, match="'cuda:0' does not match .* '1'"):
        made._configure_multi_gpu()
