"""`beetle_omni train`: from a parameter file to an ONNX policy."""

from __future__ import annotations

from contextlib import redirect_stdout
import io
import os
from pathlib import Path
import re
import time

import numpy as np
from rich.console import Console
import torch
import yaml

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import bind, flatten, nest, ParameterError
from beetle_omni_ros.runs.json_file import write_json
from beetle_omni_ros.train.assess import assess
from beetle_omni_ros.train.export import export_policy
from beetle_omni_ros.train.parameters import TrainParameters
from beetle_omni_ros.train.runner import Runner

PARAMETER_FILE, POLICY_FILE = 'train.yaml', 'policy.onnx'
# A run that shows within a minute on a CPU that everything fits together; it learns nothing.
SMOKE = {'iterations': 3, 'log_every': 1, 'save_every': 2, 'ppo.robots': 32, 'ppo.steps': 8,
         'ppo.epochs': 2, 'ppo.minibatches': 2, 'network.hidden': [32, 16, 16]}
ROBOTS, CPU_ROBOTS = 1024, 64            # of the final assessment
COLUMNS = (('iteration', 'iteration', '{:.0f}'), ('seconds', 'time s', '{:.0f}'),
           ('samples_per_second', 'samples/s', '{:.2e}'), ('reward', 'reward', '{:+.4f}'),
           ('success_rate', 'reached', '{:.1%}'), ('position_error_m', 'error m', '{:.3f}'),
           ('attitude_error_deg', 'error deg', '{:.1f}'), ('deaths', 'lost', '{:.0f}'),
           ('tilt_std', 'std tilt', '{:.2f}'), ('thrust_std', 'std thrust', '{:.2f}'),
           ('learning_rate', 'rate', '{:.0e}'))


def choose_device(name: str) -> str:
    """
    The torch device of a name; 'auto' takes a GPU where there is one.

    Raises:
        ParameterError: a GPU is asked for where there is none.

    """
    local = os.environ.get('LOCAL_RANK')
    if name == 'auto':
        name = 'cuda' if torch.cuda.is_available() else 'cpu'
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ParameterError(f"--device '{name}': expected auto, cpu, cuda or cuda:N") from None
    if device.type not in ('cpu', 'cuda'):
        raise ParameterError(f"--device '{name}': expected auto, cpu, cuda or cuda:N")
    if device.type == 'cuda':
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        index = int(local) if local is not None else device.index or 0
        if index >= count:
            raise ParameterError(f"--device '{name}': this machine has {count or 'no'} CUDA "
                                 f'device{"s" if count > 1 else ""} that torch {torch.__version__}'
                                 ' can use; --device cpu trains slowly anywhere')
        return f'cuda:{index}'
    return 'cpu'


def read_parameters(file: Path | None, changes: dict) -> TrainParameters:
    """
    A parameter file with single values replaced.

    Args:
        file: YAML; None: the shipped one.
        changes: dotted name -> value.

    Raises:
        ParameterError: file or value unusable.

    """
    parameters = TrainParameters.load(file)
    flat = {name: value for name, _, _, value in flatten(parameters)}
    for key, value in changes.items():
        if key not in flat:
            raise ParameterError(f'--set {key}: unknown; keys are those of params/train.yaml, '
                                 'e.g. ppo.robots')
        flat[key] = value
    return bind(TrainParameters, nest(flat), '--set' if changes else str(file or ''))


def write_parameters(parameters: TrainParameters, path: Path) -> None:
    """Dump as YAML that ``--config`` reads."""
    flat = {name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, _, _, value in flatten(parameters)}
    path.write_text(yaml.safe_dump(nest(flat), sort_keys=False))


def last_checkpoint(folder: Path) -> Path:
    """
    The newest checkpoint of a run.

    Raises:
        ParameterError: there is none.

    """
    if folder.is_file():
        return folder
    numbered = {int(match[1]): path for path in folder.glob('model_*.pt')
                if (match := re.fullmatch(r'model_(\d+)\.pt', path.name))}
    if not numbered:
        raise ParameterError(f'--resume {folder}: no checkpoint model_N.pt there')
    return numbered[max(numbered)]


def run_train(*, output: Path, config: Path | None = None, robot: Path | None = None,
              changes: dict | None = None, device: str = 'auto', resume: Path | None = None,
              smoke: bool = False, stop_after: float | None = None,
              json_path: Path | None = None, console: Console | None = None) -> dict:
    """
    Train, assess, export.

    Args:
        output: folder for parameters, checkpoints, TensorBoard log and policy.onnx.
        config: parameter file; default the shipped one, with ``resume`` that of the run.
        robot: robot file.
        changes: dotted parameter name -> value, over the file.
        device: 'auto', 'cpu', 'cuda' or 'cuda:N'.
        resume: a run's folder, or a checkpoint.
        smoke: tiny sizes, to see that everything fits together.
        stop_after: seconds of training after which it stops early.
        json_path: file for the results.
        console: where to print.

    Returns:
        ``policy`` (path), ``iterations``, ``seconds``, ``metrics`` by conditions.

    Raises:
        ParameterError: unusable input, one line.
        KeyboardInterrupt: after a checkpoint was written.

    """
    console = console or Console()
    where = choose_device(device)
    checkpoint = last_checkpoint(resume) if resume else None
    if checkpoint and config is None and (checkpoint.parent / PARAMETER_FILE).is_file():
        config = checkpoint.parent / PARAMETER_FILE
    changes = {**(SMOKE if smoke and not checkpoint else {}), **(changes or {})}
    parameters = read_parameters(config, changes)
    believed = RobotParameters.load(robot)
    output.mkdir(parents=True, exist_ok=True)
    torch.set_float32_matmul_precision('high')
    with redirect_stdout(io.StringIO()):     # rsl-rl prints its models
        runner = Runner(parameters, believed, output, where)
    if checkpoint:
        runner.resume(checkpoint)
    first = runner.is_distributed is False or runner.gpu_global_rank == 0
    if first:
        write_parameters(parameters, output / PARAMETER_FILE)
        console.print(f'{parameters.ppo.robots} robots on {where}, seed {parameters.seed}, '
                      f'iterations {runner.current_learning_iteration} to '
                      f'{parameters.iterations}; everything lands in {output}')
    began = time.monotonic()
    try:
        runner.train(Rows(console), stop_after)
    except KeyboardInterrupt:
        path = runner.checkpoint()
        console.print(f'interrupted; go on with: beetle_omni train --resume {path.parent}')
        raise
    if not first:
        return {}
    return _finish(runner, believed, output, where, time.monotonic() - began, smoke, json_path,
                   console)


def _finish(runner, robot, output, device, seconds, smoke, json_path, console):
    """Assess, export, report."""
    parameters, actor = runner.parameters, runner.alg.actor
    robots, segments = (ROBOTS, 2) if device.startswith('cuda') else (CPU_ROBOTS, 1)
    metrics = {name: assess(actor.mean, parameters, robot, device, name, robots, segments)
               for name in ('nominal', 'published')} if not smoke else {}
    path = output / POLICY_FILE
    training = {'iterations_done': runner.current_learning_iteration,
                'samples': runner.current_learning_iteration * parameters.ppo.steps
                * parameters.ppo.robots, 'seconds': round(seconds, 1), 'device': _model(device)}
    difference = export_policy(actor, path, robot, parameters, training, metrics)
    for name, values in metrics.items():
        console.print(f'{name}, training environment: ' + ', '.join(
            f'{key} {value:.4g}' for key, value in values.items()))
    console.print(f'{path}: agrees with torch to {difference:.1e}; fly it with beetle_omni '
                  f'evaluate --controllers rl --policy {path} --task random100')
    result = {'policy': str(path), 'iterations': runner.current_learning_iteration,
              'seconds': seconds, 'metrics': metrics, 'onnx_difference': difference}
    if json_path:
        write_json(json_path, result)
    return result


def _model(device):
    return torch.cuda.get_device_name(device) if device.startswith('cuda') else 'cpu'


class Rows:
    """Prints progress as rows of a table, with the header now and then."""

    EVERY = 20

    def __init__(self, console: Console):
        self._console, self._count = console, 0

    def __call__(self, row: dict) -> None:
        """Print one row."""
        widths = [max(len(title), 9) for _, title, _ in COLUMNS]
        if self._count % self.EVERY == 0:
            self._console.print(' '.join(title.rjust(width) for (_, title, _), width
                                         in zip(COLUMNS, widths)), style='bold', soft_wrap=True)
        self._count += 1
        self._console.print(' '.join(pattern.format(row[key]).rjust(width)
                                     for (key, _, pattern), width in zip(COLUMNS, widths)),
                            soft_wrap=True, highlight=False)


def parse_changes(texts: list[str]) -> dict:
    """
    ``key=value`` texts of the command line, values as YAML.

    Raises:
        ParameterError: no '=' or no YAML.

    """
    changes = {}
    for text in texts:
        key, sign, value = text.partition('=')
        if not sign:
            raise ParameterError(f"--set '{text}': expected key=value")
        try:
            changes[key.strip()] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise ParameterError(f"--set '{text}': the value is not valid YAML") from None
    return changes


