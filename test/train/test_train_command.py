"""`beetle_omni train`: a smoke run, resume, one-line refusals."""

import json
from pathlib import Path
import shutil

import learning  # noqa: F401
import numpy as np
import pytest
from test_cli import refused

from beetle_omni_ros import cli
from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.train import runner
from beetle_omni_ros.train.parameters import read_parameters, TrainParameters
from beetle_omni_ros.train.ppo import GraphPpo

ROBOT = RobotParameters.load()
TINY = ['--smoke', '--device', 'cpu', '--set', 'ppo.robots=8', '--set', 'ppo.steps=4']


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """A finished smoke run."""
    folder = tmp_path_factory.mktemp('train') / 'run'
    assert cli.main(['train', '--smoke', '--device', 'cpu', '--output', str(folder), '--seed',
                     '5', '--json', str(folder.parent / 'result.json')]) == 0
    return folder


def test_a_run_writes_all_documented_files(run):
    names = {path.name for path in run.iterdir()}
    assert {'train.yaml', 'policy.onnx', 'model_2.pt', 'model_3.pt'} <= names
    assert any(name.startswith('events.out.tfevents') for name in names)
    assert not any(name.endswith('.part') for name in names)
    result = json.loads((run.parent / 'result.json').read_text())
    assert result['policy'] == str(run / 'policy.onnx') and result['iterations'] == 3
    assert result['onnx_difference'] <= 1e-5 and result['seconds'] > 0
    expected = read_parameters(None, {**runner.SMOKE, 'seed': 5})
    assert TrainParameters.load(run / 'train.yaml').plain() == expected.plain()


def test_the_shipped_parameters_are_the_defaults():
    assert TrainParameters.load().plain() == TrainParameters().plain()


def test_the_policy_of_a_run_flies(run):
    controller = PolicyController(ROBOT, PolicyParameters(policy=str(run / 'policy.onnx')))
    assert controller.contract.training['seed'] == 5
    assert controller.contract.training['iterations_done'] == 3
    level = np.array([0.0, 0.0, 0.0, 1.0])
    state = State(0.0, np.array([0.0, 0.0, 1.0]), np.zeros(3), level, np.zeros(3), np.zeros(4),
                  np.zeros(4), 0.0)
    given = controller.step(state, PoseTarget(np.array([0.5, 0.0, 1.2]), level))
    assert np.isfinite(given.tilt).all() and np.isfinite(given.thrust).all()


def test_a_run_continues_from_its_last_checkpoint(run, tmp_path, capsys):
    shutil.copytree(run, tmp_path / 'run')
    (tmp_path / 'run' / 'policy.onnx').unlink()
    assert cli.main(['train', '--resume', str(tmp_path / 'run'), '--device', 'cpu', '--set',
                     'iterations=4']) == 0
    printed = capsys.readouterr().out
    assert 'seed 5, iterations 3 to 4' in printed
    assert (tmp_path / 'run' / 'model_4.pt').is_file()
    assert (tmp_path / 'run' / 'policy.onnx').is_file()
    assert TrainParameters.load(tmp_path / 'run' / 'train.yaml').iterations == 4


def test_an_interrupted_run_keeps_its_state(tmp_path, capsys, monkeypatch):
    method, calls = GraphPpo.learn_batch, []

    def interrupt(self):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return method(self)

    monkeypatch.setattr(GraphPpo, 'learn_batch', interrupt)
    folder = tmp_path / 'run'
    capsys.readouterr()
    assert cli.main(['train', *TINY, '--output', str(folder)]) == 130
    printed = capsys.readouterr()
    assert printed.err.strip() in ('', 'beetle_omni: error: interrupted')
    assert f'continue with: beetle_omni train --resume {folder}' in printed.out
    assert [path.name for path in folder.glob('model_*')] == ['model_1.pt']
    assert not (folder / 'policy.onnx').exists()


@pytest.mark.parametrize(('arguments', 'named'), [
    ('', '--output: missing'), ('--output OUT --device tpu', "--device 'tpu': expected"),
    ('--output OUT --set ppo.robtos=4', "ppo.robtos: unknown key; did you mean 'ppo.robots'?"),
    ('--output OUT --set iterations', 'expected key=value'),
    ('--output OUT --set iterations=[1', 'not valid YAML'),
    ('--output OUT --set iterations=many', 'expected an integer'),
    ('--output OUT --seed -1', '--seed'), ('--output OUT --stop-after -1', '--stop-after'),
    ('--output OUT --config none.yaml', 'none.yaml'),
    ('--output OUT --robot none.yaml', 'none.yaml'),
    ('--output OUT --json no/folder.json', 'folder.json'),
    ('--resume nowhere', '--resume nowhere: no model_N.pt there'),
    ('--output file', '--output file')])
def test_unusable_input_is_refused_before_any_file_is_written(capsys, tmp_path, monkeypatch,
                                                              arguments, named):
    monkeypatch.chdir(tmp_path)
    Path('file').touch()
    assert named in refused(capsys, 'train', '--smoke', '--device', 'cpu', *arguments.split())
    assert [path.name for path in tmp_path.iterdir()] == ['file']


def test_another_run_is_not_overwritten(capsys, run):
    before = sorted(run.iterdir())
    line = refused(capsys, 'train', *TINY, '--output', run)
    assert 'holds the checkpoints of another run' in line and f'--resume {run}' in line
    assert sorted(run.iterdir()) == before
