"""Training loop: schedule, progress, TensorBoard, checkpoints, resume."""

from collections.abc import Callable
from pathlib import Path
import time

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter

from beetle_omni_ros.control.policy_file import robot_hash
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.train import rewards
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import TrainParameters
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
        graphs: whether to capture CUDA graphs and compile; None: on a GPU.
        teacher: checkpoint of a policy to imitate at first.

    Attributes:
        iteration: number of iterations so far; ``trained_seconds`` is their duration.

    """

    def __init__(self, parameters: TrainParameters, robot: RobotParameters,
                 folder: Path | None = None, device: str = 'cpu', graphs: bool | None = None,
                 teacher: Path | None = None):
        self.parameters, self.folder = parameters, folder
        self._robot_hash = robot_hash(robot)
        torch.manual_seed(parameters.seed)
        self.env = TiltableQuadrotorEnv(parameters, robot, device, compiled=graphs)
        self.alg = GraphPpo(self.env, parameters,
                            device.startswith('cuda') if graphs is None else graphs, teacher)
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
