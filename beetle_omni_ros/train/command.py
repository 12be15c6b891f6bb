"""`beetle_omni train`: trains a policy from a parameter file and exports it to ONNX."""

from pathlib import Path
import re

from rich.console import Console
import torch
import yaml

from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import nest, ParameterError, parse_yaml, quoted
from beetle_omni_ros.train.network import export_policy
from beetle_omni_ros.train.parameters import read_parameters
from beetle_omni_ros.train.runner import Runner

PARAMETER_FILE, POLICY_FILE = 'train.yaml', 'policy.onnx'
# A run of less than a minute on a CPU that executes every part; the policy learns nothing.
SMOKE = {'iterations': 3, 'log_every': 1, 'save_every': 2, 'ppo.robots': 32, 'ppo.steps': 8,
         'ppo.epochs': 2, 'ppo.minibatches': 2, 'network.hidden': [32, 16, 16],
         'network.critic': [32, 16, 16]}
PROGRESS = ('iteration {iteration}, {seconds:.0f} s, {samples_per_second:.2e} samples/s: reward '
            '{reward:+.4f}, reached {success_rate:.1%} of {targets:.0f} targets, error '
            '{position_error_m:.3f} m and {attitude_error_deg:.1f} deg, lost {deaths:.0f}, std '
            '{tilt_std:.2f} and {thrust_std:.2f}, rate {learning_rate:.0e}')


def choose_device(name: str) -> str:
    """Torch device for a name; 'auto' is a GPU if available."""
    count = torch.cuda.device_count()
    if name == 'cpu' or (name == 'auto' and not count):
        return 'cpu'
    if name != 'auto' and not re.fullmatch(r'cuda(:\d+)?', name):
        raise ParameterError(f"--device '{name}': expected auto, cpu, cuda or cuda:N")
    index = int(name.partition(':')[2] or 0)
    if index >= count:
        raise ParameterError(f"--device '{name}': this machine has {count or 'no'} CUDA "
                             f'device{"s" if count > 1 else ""} that torch {torch.__version__}'
                             ' can use; --device cpu trains slowly anywhere')
    return f'cuda:{index}'


def run_train(*, output: Path | None, config: Path | None = None, robot: Path | None = None,
              changes: dict | None = None, device: str = 'auto', resume: Path | None = None,
              teacher: Path | None = None, smoke: bool = False, stop_after: float | None = None,
              json_path: Path | None = None) -> None:
    """
    Train and export a policy, with the options of `beetle_omni train`.

    ``changes`` maps dotted parameter names to values that override the file.

    Raises:
        ParameterError: unusable input.
        RunError: the loss is not finite, or the exported file is wrong.
        KeyboardInterrupt: raised again after a checkpoint.

    """
    console = Console()
    if output is None and resume is None:
        raise ParameterError('--output: missing; expected a folder for the training')
    where = choose_device(device)
    checkpoint = None
    if resume:
        last = max(_checkpoints(resume), default=(0, None))[1]
        checkpoint = resume if resume.is_file() else last
        if checkpoint is None:
            raise ParameterError(f'--resume {resume}: no model_N.pt there; expected the folder of '
                                 'a training')
        output = output or checkpoint.parent
        saved = checkpoint.parent / PARAMETER_FILE
        config = config or (saved if saved.is_file() else None)
    elif smoke:
        changes = SMOKE | (changes or {})
    parameters = read_parameters(config, changes or {})
    nominal = RobotParameters.load(robot)
    torch.set_float32_matmul_precision('high')
    if smoke:
        torch.set_num_threads(1)    # on a loaded machine several threads wait for each other
    runner = Runner(parameters, nominal, output, where, teacher=teacher)
    if checkpoint:
        runner.resume(checkpoint)
    _make_folder(output, checkpoint)
    (output / PARAMETER_FILE).write_text(yaml.safe_dump(nest(parameters.plain()), sort_keys=False))
    console.print(f'{parameters.ppo.robots} robots on {where}, seed {parameters.seed}, iterations '
                  f'{runner.iteration} to {parameters.iterations}; all files are in {output}',
                  soft_wrap=True)
    try:
        runner.train(lambda row: console.print(PROGRESS.format(**row), soft_wrap=True,
                                               highlight=False), stop_after)
    except KeyboardInterrupt:
        path = runner.checkpoint()
        console.print(f'interrupted; continue with: beetle_omni train --resume {path.parent}',
                      soft_wrap=True)
        raise
    done, path = runner.iteration, output / POLICY_FILE
    difference = export_policy(runner.alg.actor, path, nominal, parameters, {
        'iterations_done': done, 'samples': done * parameters.ppo.steps * parameters.ppo.robots,
        'seconds': round(runner.trained_seconds, 1),
        'device': torch.cuda.get_device_name(where) if where.startswith('cuda') else 'cpu'})
    console.print(f'files: {path}, agrees with torch to {difference:.1e}\nnext:  beetle_omni '
                  f'evaluate --controllers rl --policy {path}', soft_wrap=True)
    write_json(json_path, {'policy': str(path), 'iterations': done,
                           'seconds': runner.trained_seconds, 'onnx_difference': difference})


def _checkpoints(folder):
    """Iterations and paths of the checkpoints in a folder."""
    return [(int(path.stem[6:]), path) for path in folder.glob('model_*.pt')]


def _make_folder(output, checkpoint):
    """Create the folder of a run, unless it has another run's checkpoints."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f'--output {output}: cannot be made ({error.strerror})') from None
    resumed = checkpoint is not None and output.resolve() == checkpoint.parent.resolve()
    if _checkpoints(output) and not resumed:
        raise ParameterError(f'--output {output}: holds the checkpoints of another run; '
                             f'--resume {output} continues it')


def parse_changes(texts: list[str], **others) -> dict:
    """Parse ``key=value`` texts of the command line; add other keys whose value is not None."""
    changes = {}
    for text in texts:
        key, sign, value = text.partition('=')
        if not sign:
            raise ParameterError(f"--set '{text}': expected key=value")
        try:
            changes[key.strip()] = _number(parse_yaml(value))
        except ParameterError as error:
            raise ParameterError(f'--set {quoted(text)}: the value is {error}') from None
    return changes | {key: value for key, value in others.items() if value is not None}


def _number(value):
    """Number of a text such as 1e-3, which is not a number in YAML 1.1."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
