"""Training loop: schedule, progress, TensorBoard, checkpoints, resume, several processes."""

from collections.abc import Callable
import os
from pathlib import Path
import time

import numpy as np
from rsl_rl.runners import OnPolicyRunner
import torch
from torch.utils.tensorboard import SummaryWriter

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError, RunError
from beetle_omni_ros.train import rewards
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import TrainParameters

SCHEDULED = {'smooth': ('joint_action_rate', 'thrust_action_rate', 'hover_tilt_rate',
                        'hover_thrust_rate'),
             'near': ('near_position', 'near_attitude', 'near_pose'), 'sinking': ('sinking',)}
SCHEDULE_EVERY = 10      # iterations between two changes of the schedule


def rsl_rl_configuration(p: TrainParameters) -> dict:
    """Configuration of rsl-rl's runner for these parameters; its numbers are published."""
    hidden, critic = ([int(size) for size in sizes]
                      for sizes in (p.network.hidden, p.network.critic))
    stds = [float(p.network.tilt_std)] * 4 + [float(p.network.thrust_std)] * 4
    place = 'beetle_omni_ros.train'
    gaussian = {'class_name': 'GaussianDistribution', 'std_type': 'log'}
    return {
        'num_steps_per_env': p.ppo.steps, 'save_interval': p.save_every, 'logger': 'tensorboard',
        'obs_groups': {'actor': ['actor'], 'critic': ['critic']}, 'check_for_nan': False,
        'actor': {'class_name': f'{place}.network:FeatureModel', 'hidden_dims': hidden,
                  'activation': 'elu', 'output_scale': p.network.output_scale,
                  'carry': p.network.carry, 'last_gain': p.network.last_gain,
                  'stds': stds, 'distribution_cfg': gaussian},
        'critic': {'class_name': f'{place}.network:FeatureModel', 'hidden_dims': critic,
                   'activation': 'elu'},
        'algorithm': {'class_name': f'{place}.ppo:GraphPpo', 'num_learning_epochs': p.ppo.epochs,
                      'num_mini_batches': p.ppo.minibatches, 'clip_param': 0.2,
                      'gamma': p.ppo.discount, 'lam': 0.95, 'value_loss_coef': 1.0,
                      'entropy_coef': float(p.schedule.entropy[0]),
                      'learning_rate': p.ppo.learning_rate, 'max_grad_norm': 1.0,
                      'use_clipped_value_loss': False, 'desired_kl': float(p.schedule.kl[0]),
                      'rnd_cfg': None, 'symmetry_cfg': None}}


def is_rank_zero() -> bool:
    """Whether this is the only process, or the first that torchrun started."""
    return int(os.environ.get('RANK', '0')) == 0


class Runner(OnPolicyRunner):
    """
    rsl-rl's runner with a training loop that does not wait for the GPU.

    Under torchrun each process simulates its own ``ppo.robots`` on its own GPU, and rsl-rl's
    update averages gradients and divergence over all processes. Only the process of rank 0
    reports and writes.

    Args:
        parameters: training parameters.
        robot: nominal robot.
        folder: folder of checkpoints and TensorBoard log; None: nothing is written.
        device: torch device.
        graphs: whether to capture CUDA graphs and compile; None: on one GPU.

    Attributes:
        trained_seconds: duration of the iterations so far, including those before a resume.

    """

    def __init__(self, parameters: TrainParameters, robot: RobotParameters,
                 folder: Path | None = None, device: str = 'cpu', graphs: bool | None = None):
        self.parameters, self.folder = parameters, folder if is_rank_zero() else None
        self._robot_hash = robot.hash()
        torch.manual_seed(parameters.seed)
        env = TiltableQuadrotorEnv(parameters, robot, device, compiled=graphs)
        super().__init__(env, rsl_rl_configuration(parameters),
                         str(self.folder) if self.folder else None, device)
        if self.is_distributed:
            # the networks are equal in all processes, the later random numbers are not
            torch.manual_seed(parameters.seed + 1000 * self.gpu_global_rank)
        if graphs is None:
            graphs = torch.device(device).type == 'cuda' and not self.is_distributed
        self.alg.prepare(env, parameters.ppo.learning_rate_limits, graphs)
        self.trained_seconds = 0.0

    def apply_schedule(self, part: float) -> None:
        """Set optimiser and environment to the schedule after a fraction of the iterations."""
        s, env = self.parameters.schedule, self.env
        done = float(np.clip((part - s.begin) / max(s.end - s.begin, 1e-9), 0.0, 1.0))

        def at(name):
            first, last = getattr(s, name)
            return float(first + done * (last - first))

        self.alg.scheduled.copy_(torch.tensor([
            at(name) for name in ('kl', 'entropy', 'tilt_std_limit', 'thrust_std_limit')]))
        env.severity.fill_(at('severity'))
        factors = {term: at(name) for name, terms in SCHEDULED.items() for term in terms}
        env.weights.copy_(env.base_weights * torch.tensor(
            [factors.get(name, 1.0) for name in rewards.TERMS], device=env.device))

    def train(self, progress: Callable[[dict], None] = lambda row: None,
              stop_after: float | None = None) -> None:
        """Run the remaining iterations, or stop after a time [s]; report rows of numbers."""
        p = self.parameters
        writer = SummaryWriter(str(self.folder)) if self.folder else None
        if self.is_distributed:
            self.alg.broadcast_parameters()
        before, began, first = self.trained_seconds, time.monotonic(), \
            self.current_learning_iteration
        for iteration in range(first, p.iterations):
            if iteration % SCHEDULE_EVERY == 0 or iteration == first:
                self.apply_schedule(iteration / p.iterations)
            self.alg.collect()
            if self.is_distributed:
                self.alg.update()
            else:
                self.alg.learn_batch()
            self.current_learning_iteration = done = iteration + 1
            report = done == p.iterations or done % p.log_every == 0
            save = done < p.iterations and done % p.save_every == 0
            if report or save:
                self._check_finite()    # waits for the device
            elapsed = time.monotonic() - began
            self.trained_seconds = before + elapsed
            if save and self.folder:
                self.checkpoint()
            if report:
                row = self._row(elapsed, done - first)
                for name, value in row.items() if writer else ():
                    writer.add_scalar(name if '/' in name else f'train/{name}', value, done)
                progress(row)
                if stop_after is not None and self._stops(elapsed > stop_after):
                    break
        if self.folder:
            self.checkpoint()
        if writer:
            writer.close()

    def checkpoint(self) -> Path:
        """Write ``model_ITERATION.pt`` atomically."""
        path = self.folder / f'model_{self.current_learning_iteration}.pt'
        part = path.with_suffix('.part')
        self.save(str(part), {'seconds': self.trained_seconds, 'robot_hash': self._robot_hash})
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
            self.current_learning_iteration, infos = int(saved['iter']), saved['infos'] or {}
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

    def _stops(self, late):
        """Decision of rank 0 for all, because clocks differ and a lone stop blocks the others."""
        flag = torch.tensor(float(late), device=self.env.device)
        if self.is_distributed:
            torch.distributed.broadcast(flag, src=0)
        return bool(flag)

    def _check_finite(self):
        if not torch.isfinite(self.alg.losses).all():
            raise RunError(
                f'iteration {self.current_learning_iteration}: the loss is not finite; try a '
                'lower ppo.learning_rate, and resume from the last checkpoint'
                + (f' in {self.folder}' if self.folder else ''))

    def _row(self, seconds, iterations):
        tally = self.env.read_tally()
        value, surrogate, entropy, divergence = self.alg.losses.tolist()
        std = self.alg.std.tolist()
        samples = iterations * self.parameters.ppo.steps * self.env.num_envs * self.gpu_world_size
        return {'iteration': self.current_learning_iteration, 'seconds': seconds,
                'samples_per_second': samples / seconds, **tally,
                'value_loss': value, 'surrogate_loss': surrogate, 'entropy': entropy,
                'divergence': divergence, 'learning_rate': float(self.alg.rate),
                'tilt_std': sum(std[:4]) / 4, 'thrust_std': sum(std[4:]) / 4}
