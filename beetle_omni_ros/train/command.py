"""`beetle_omni train`: trains a policy from a parameter file and exports it to ONNX."""

from contextlib import redirect_stdout, suppress
import io
import os
from pathlib import Path

from rich.console import Console
import torch

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.runs.files import check_writable, write_json
from beetle_omni_ros.train.assess import assess
from beetle_omni_ros.train.export import export_policy
from beetle_omni_ros.train.run_folder import (
    last_checkpoint,
    make_folder,
    PARAMETER_FILE,
    read_parameters,
    write_parameters,
)
from beetle_omni_ros.train.runner import is_rank_zero, Runner

POLICY_FILE = 'policy.onnx'
# A run of less than a minute on a CPU that executes every part; the policy learns nothing.
SMOKE = {'iterations': 3, 'log_every': 1, 'save_every': 2, 'ppo.robots': 32, 'ppo.steps': 8,
         'ppo.epochs': 2, 'ppo.minibatches': 2, 'network.hidden': [32, 16, 16]}
ROBOTS, CPU_ROBOTS = 8192, 64            # robots of the final assessment
COLUMNS = (('iteration', 'iteration', '{:.0f}'), ('seconds', 'time s', '{:.0f}'),
           ('samples_per_second', 'samples/s', '{:.2e}'), ('reward', 'reward', '{:+.4f}'),
           ('success_rate', 'reached', '{:.1%}'), ('position_error_m', 'error m', '{:.3f}'),
           ('attitude_error_deg', 'error deg', '{:.1f}'), ('deaths', 'lost', '{:.0f}'),
           ('tilt_std', 'std tilt', '{:.2f}'), ('thrust_std', 'std thrust', '{:.2f}'),
           ('learning_rate', 'rate', '{:.0e}'))

OF_TARGETS = ('success_rate', 'position_error_m', 'attitude_error_deg')  # averages over targets


def choose_device(name: str) -> str:
    """
    Torch device for a name; 'auto' is a GPU if available.

    Raises:
        ParameterError: a requested GPU is not available.

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


def run_train(*, output: Path | None, config: Path | None = None, robot: Path | None = None,
              changes: dict | None = None, device: str = 'auto', resume: Path | None = None,
              smoke: bool = False, stop_after: float | None = None,
              json_path: Path | None = None, console: Console | None = None) -> dict:
    """
    Train, assess and export a policy.

    Arguments are the options of `beetle_omni train`; ``changes`` maps dotted parameter names to
    values that override the file.

    Returns:
        ``policy`` (path), ``iterations``, ``seconds``, ``metrics`` by conditions.

    Raises:
        ParameterError: unusable input, one line.
        RunError: the loss is not finite, or the exported file is wrong; one line.
        KeyboardInterrupt: raised again after a checkpoint.

    """
    console = console or Console(quiet=not is_rank_zero())
    check_writable(json_path)
    if output is None and resume is None:
        raise ParameterError('--output: missing; expected a folder for the training')
    where = choose_device(device)
    checkpoint = last_checkpoint(resume) if resume else None
    output = output or checkpoint.parent
    if checkpoint and config is None and (checkpoint.parent / PARAMETER_FILE).is_file():
        config = checkpoint.parent / PARAMETER_FILE
    changes = {**(SMOKE if smoke and not checkpoint else {}), **(changes or {})}
    parameters = read_parameters(config, changes)
    nominal = RobotParameters.load(robot)
    new = is_rank_zero() and make_folder(output, checkpoint)
    torch.set_float32_matmul_precision('high')
    if smoke:
        torch.set_num_threads(1)    # on a loaded machine several threads wait for each other
    try:
        with redirect_stdout(io.StringIO()):     # rsl-rl prints its models
            runner = Runner(parameters, nominal, output, where)
        if checkpoint:
            runner.resume(checkpoint)
    except BaseException:
        if new:
            with suppress(OSError):     # not empty
                output.rmdir()
        raise
    if is_rank_zero():
        write_parameters(parameters, output / PARAMETER_FILE)
    processes = f'{runner.gpu_world_size} x ' if runner.is_distributed else ''
    console.print(f'{processes}{parameters.ppo.robots} robots on {where}, seed '
                  f'{parameters.seed}, iterations {runner.current_learning_iteration} to '
                  f'{parameters.iterations}; all files are in {output}', soft_wrap=True)
    try:
        runner.train(ProgressTable(console), stop_after)
        runner.close()
        return _finish(runner, nominal, output, where, smoke, json_path, console) \
            if is_rank_zero() else {}
    except KeyboardInterrupt:
        if is_rank_zero():
            path = runner.checkpoint()
            console.print(f'interrupted; continue with: beetle_omni train --resume {path.parent}',
                          soft_wrap=True)
        raise
    except FloatingPointError as error:
        raise RunError(str(error)) from None


def _finish(runner, robot, output, device, smoke, json_path, console):
    """Assess, export, report."""
    parameters, actor = runner.parameters, runner.alg.actor
    robots, segments = (ROBOTS, 2) if device.startswith('cuda') else (CPU_ROBOTS, 1)
    metrics = {name: assess(actor.mean, parameters, robot, device, name, robots, segments)
               for name in ('nominal', 'published', 'measured')} if not smoke else {}
    path = output / POLICY_FILE
    training = {'iterations_done': runner.current_learning_iteration,
                'samples': runner.current_learning_iteration * parameters.ppo.steps
                * parameters.ppo.robots * runner.gpu_world_size,
                'seconds': round(runner.trained_seconds, 1), 'processes': runner.gpu_world_size,
                'device': torch.cuda.get_device_name(device) if device.startswith('cuda')
                else 'cpu'}
    difference = export_policy(actor, path, robot, parameters, training, metrics)
    for name, values in metrics.items():
        console.print(f'{name}, training environment: ' + ', '.join(
            f'{key} {value:.4g}' for key, value in values.items()), soft_wrap=True)
    console.print(f'{path}: agrees with torch to {difference:.1e}; fly it with beetle_omni '
                  f'evaluate --controllers rl --policy {path} --task random100', soft_wrap=True)
    result = {'policy': str(path), 'iterations': runner.current_learning_iteration,
              'seconds': runner.trained_seconds, 'metrics': metrics, 'onnx_difference': difference}
    write_json(json_path, result)
    return result


class ProgressTable:
    """Prints progress as rows of a table, with a header every ``EVERY`` rows."""

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
        cells = ['–' if key in OF_TARGETS and not row['targets'] else pattern.format(row[key])
                 for key, _, pattern in COLUMNS]
        self._console.print(' '.join(map(str.rjust, cells, widths)), soft_wrap=True,
                            highlight=False)
