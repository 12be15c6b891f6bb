"""Training in several processes, here two on the CPU instead of two GPUs."""

import json
import os
from pathlib import Path
import subprocess
import sys

from learning import ROBOT
import pytest

from beetle_omni_ros.control.policy_file import PolicyNetwork
from beetle_omni_ros.train import command

HERE = Path(__file__).parent


def test_two_processes_train_one_network_with_their_own_robots(tmp_path):
    done = subprocess.run(
        [sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node', '2',
         str(HERE / 'several_processes.py'), str(tmp_path)], timeout=120, capture_output=True,
        text=True, check=False, env={**os.environ, 'OMP_NUM_THREADS': '1', 'PYTHONPATH':
                                     os.pathsep.join((str(HERE.parents[1]), str(HERE)))})
    assert done.returncode == 0, done.stderr[-3000:]
    first, second = (json.loads((tmp_path / f'rank{rank}.json').read_text()) for rank in (0, 1))
    for name, value in (('status', 0), ('iterations', 1), ('begin', second['begin']),
                        ('weights', second['weights']), ('rate', second['rate'])):
        assert first[name] == second[name] == value, name
    assert first['begin'] != first['weights'] and first['robots'] != second['robots']
    # the first process alone writes
    assert first['folder'] == str(tmp_path / 'run') and second['folder'] == 'None'
    names = {path.name for path in (tmp_path / 'run').iterdir()}
    assert {'train.yaml', 'model_1.pt', 'policy.onnx'} <= names and len(names) == 4
    assert done.stdout.count('2 x 32 robots on cpu') == done.stdout.count('agrees with torch') == 1
    training = PolicyNetwork(tmp_path / 'run' / 'policy.onnx', ROBOT).contract.training
    assert training['samples'] == 2 * command.SMOKE['ppo.robots'] * command.SMOKE['ppo.steps']


def test_each_process_takes_the_gpu_of_its_rank(monkeypatch):
    monkeypatch.setattr(command.torch.cuda, 'device_count', lambda: 4)
    assert command.choose_device('cuda:2') == 'cuda:2'
    monkeypatch.setenv('LOCAL_RANK', '3')
    assert command.choose_device('auto') == command.choose_device('cuda') == 'cuda:3'
    monkeypatch.setenv('LOCAL_RANK', '4')
    with pytest.raises(command.ParameterError, match='has 4 CUDA devices'):
        command.choose_device('cuda')
