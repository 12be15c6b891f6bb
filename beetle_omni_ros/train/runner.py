"""`beetle_omni train`: schedule, progress, TensorBoard, checkpoints, resume, export."""

from collections.abc import Callable
from pathlib import Path
import re
import time

import numpy as np
from rich.console import Console
import torch
from torch.utils.tensorboard import SummaryWriter
import yaml

from beetle_omni_ros.control.policy_file import robot_hash
from beetle_omni_ros.model.files import write_json
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import nest, ParameterError, parse_yaml, quoted, RunError
from beetle_omni_ros.train import rewards
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.network import export_policy
from beetle_omni_ros.train.parameters import read_parameters, TrainParameters
from beetle_omni_ros.train.ppo import GraphPpo

SCHEDULED = {'smooth': ('joint_action_rate', 'thrust_action_rate', 'hover_tilt_rate',
                        'hover_thrust_rate'),
             'near': ('near_position', 'near_attitude', 'near_pose'), 'sinking': ('sinking',)}
SCHEDULE_EVERY = 10      # iterations between two changes of the schedule


class Runner:
    """
    The training loop, which does not wait for the GPU.

    Args:
        parameters: training parameters.
        robot: nominal robot.
        folder: of checkpoints and TensorBoard log; None: nothing is written.
        device: torch device.
        teacher: checkpoint of a policy to imitate at first.

    Attributes:
        iteration: number of iterations so far; ``trained_seconds`` is their duration.

    """

    def __init__(self, parameters: TrainParameters, robot: RobotParameters,
                 folder: Path | None = None, device: str = 'cpu',
                 teacher: Path | None = None):
        self.parameters, self.folder = parameters, folder
        self._robot_hash = robot_hash(robot)
        torch.manual_seed(parameters.seed)
        self.env = TiltableQuadrotorEnv(parameters, robot, device)
        self.alg = GraphPpo(self.env, parameters, teacher)
        self.iteration, self.trained_seconds = 0, 0.0

    def apply_schedule(self, part: float) -> None:
        """Set optimiser and environment to the schedule after a fraction of the iterations."""
        s, env = self.parameters.schedule, self.env
        done = float(np.clip((part - s.begin) / max(s.end - s.begin, 1e-9), 0.0, 1.0))

        def at(name):
            first, last = getattr(s, name)
            return float(first + done * (last - first))

        self.alg.scheduled.copy_(torch.tensor([
            at(name) for name in (
                'kl', 'entropy', 'imitation', 'tilt_std_limit', 'thrust_std_limit')]))
        env.severity.fill_(at('severity'))
        factors = {term: at(name) for name, terms in SCHEDULED.items() for term in terms}
        env.weights.copy_(env.base_weights * torch.tensor(
            [factors.get(name, 1.0) for name in rewards.TERMS], device=env.device))

    def train(self, progress: Callable[[dict], None] = lambda row: None,
              stop_after: float | None = None) -> None:
        """Run the remaining iterations, or stop after a time [s]; report rows of numbers."""
        p = self.parameters
        writer = SummaryWriter(str(self.folder)) if self.folder else None
        before, began, first = self.trained_seconds, time.monotonic(), self.iteration
        for iteration in range(first, p.iterations):
            if iteration % SCHEDULE_EVERY == 0 or iteration == first:
                self.apply_schedule(iteration / p.iterations)
            self.alg.collect()
            self.alg.learn_batch()
            self.iteration = done = iteration + 1
            report = done == p.iterations or done % p.log_every == 0
            save = done < p.iterations and done % p.save_every == 0
            # waits for the device
            if (report or save) and not torch.isfinite(self.alg.losses).all():
                raise RunError(f'iteration {done}: the loss is not finite; try a lower '
                               'ppo.learning_rate, and resume from the last checkpoint')
            elapsed = time.monotonic() - began
            self.trained_seconds = before + elapsed
            if save and self.folder:
                self.checkpoint()
            if report:
                row = self._row(elapsed, done - first)
                for name, value in row.items() if writer else ():
                    writer.add_scalar(name if '/' in name else f'train/{name}', value, done)
                progress(row)
                if stop_after is not None and elapsed > stop_after:
                    break
        if self.folder:
            self.checkpoint()
        if writer:
            writer.close()

    def checkpoint(self) -> Path:
        """Write ``model_ITERATION.pt`` atomically."""
        path = self.folder / f'model_{self.iteration}.pt'
        part = path.with_suffix('.part')
        torch.save({**self.alg.save(), 'iter': self.iteration, 'infos': {
            'seconds': self.trained_seconds, 'robot_hash': self._robot_hash}}, part)
        part.replace(path)
        return path

    def resume(self, path: Path) -> None:
        """Continue from a checkpoint; ParameterError if it is another network's or robot's."""
        try:
            saved = torch.load(str(path), map_location=str(self.env.device), weights_only=True)
            group, ours = (optimizer['param_groups'][0] for optimizer in (
                saved['optimizer_state_dict'], self.alg.optimizer.state_dict()))
            rate = float(group['lr'])
            # these keys depend on the device, not on the training
            group.update({key: ours[key] for key in ('capturable', 'fused', 'foreach')})
            self.alg.load(saved, None, True)
            self.iteration, infos = int(saved['iter']), saved['infos'] or {}
        except Exception as error:      # torch's errors for a bad file have no common base class
            text = ' '.join(str(error).split())
            raise ParameterError(f'{path}: no checkpoint that fits this training '
                                 f'({text[:160]})') from None
        found = infos.get('robot_hash', self._robot_hash)
        if found != self._robot_hash:
            raise ParameterError(f'{path}: trained for another robot ({found}, this is '
                                 f'{self._robot_hash}); give its file with --robot')
        self.trained_seconds = float(infos.get('seconds', 0.0))
        self.alg.set_rate(rate)

    def _row(self, seconds, iterations):
        tally = self.env.read_tally()
        value, surrogate, entropy, divergence = self.alg.losses.tolist()
        std = self.alg.std.tolist()
        samples = iterations * self.parameters.ppo.steps * self.env.num_envs
        return {'iteration': self.iteration, 'seconds': seconds,
                'samples_per_second': samples / seconds, **tally,
                'value_loss': value, 'surrogate_loss': surrogate, 'entropy': entropy,
                'divergence': divergence, 'learning_rate': float(self.alg.rate),
                'tilt_std': sum(std[:4]) / 4, 'thrust_std': sum(std[4:]) / 4}


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
    if where.startswith('cuda'):
        torch.cuda.set_device(where)    # Triton launches its kernels on the present device
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
