"""
rsl-rl's PPO, with update and rollout as CUDA graphs.

rsl-rl's loop launches about ten thousand small kernels in an iteration and waits for the device
after each minibatch, so that the GPU is mostly idle. Here nothing waits, and the learning rate
adapts on the device. On other devices the same code runs uncaptured.
"""

from collections.abc import Callable
from math import log, pi
from pathlib import Path

from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
import torch
from torch import nn

from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.network import actor_of, FeatureModel
from beetle_omni_ros.train.parameters import TrainParameters

LEARNING_RATE_STEP = 1.5     # factor of rsl-rl's adaptation
ADAM_EPSILON = 1e-8          # published


class GraphPpo(PPO):
    """
    rsl-rl's PPO; :meth:`collect` and :meth:`learn_batch` run as captured graphs on a GPU.

    With a ``teacher``, a student of any size also minimises the divergence from its actions
    ("kickstarting", Schmitt et al. 2018). One of the same size begins with its weights.

    Attributes:
        scheduled: (5,) on the device: desired KL, weights of the entropy and of the divergence
            from the teacher, bounds of the standard deviations of tilt and thrust actions.

    """

    def __init__(self, env: TiltableQuadrotorEnv, parameters: TrainParameters,
                 teacher: Path | None = None):
        network, p = parameters.network, parameters.ppo
        graphs = env.device.type == 'cuda'
        groups, seen = {'actor': ['actor'], 'critic': ['critic']}, env.get_observations()
        actor = FeatureModel(
            seen, groups, 'actor', env.num_actions, output_scale=network.output_scale,
            carry=network.carry, last_gain=network.last_gain,
            stds=[network.tilt_std] * 4 + [network.thrust_std] * 4,
            hidden_dims=[int(size) for size in network.hidden],
            distribution_cfg={'class_name': 'GaussianDistribution', 'std_type': 'log'})
        critic = FeatureModel(seen, groups, 'critic', 1,
                              hidden_dims=[int(size) for size in network.critic])
        storage = RolloutStorage('rl', env.num_envs, p.steps, seen, [env.num_actions], env.device)
        super().__init__(     # the numbers are published
            actor, critic, storage, num_learning_epochs=p.epochs, num_mini_batches=p.minibatches,
            clip_param=0.2, gamma=p.discount, lam=0.95, value_loss_coef=1.0, max_grad_norm=1.0,
            learning_rate=p.learning_rate, use_clipped_value_loss=False, device=env.device)
        self.env, self._graphs = env, graphs
        self._limits = tuple(float(limit) for limit in p.learning_rate_limits)
        self.rate = torch.tensor(p.learning_rate, device=self.device)
        self.optimizer = torch.optim.Adam(
            [*self.actor.parameters(), *self.critic.parameters()],
            lr=self.rate if graphs else p.learning_rate, eps=ADAM_EPSILON,
            capturable=graphs, fused=graphs or None)
        self.teacher = teacher and actor_of(teacher, self.actor)
        if self.teacher and str(self.teacher.mlp) == str(self.actor.mlp):
            self.actor.mlp.load_state_dict(self.teacher.mlp.state_dict())
        self.scheduled = torch.zeros(5, device=self.device)
        self._loss, self._mean = (torch.compile(function, dynamic=False) if graphs else function
                                  for function in (self._losses, self.actor.mean))
        shape = (p.steps, env.num_envs)
        storage.distribution_params = tuple(
            torch.zeros(*shape, env.num_actions, device=self.device) for _ in range(2))
        self.losses = torch.zeros(4, device=self.device)
        self._order = torch.arange(shape[0] * shape[1], device=self.device)
        self._replay: dict[str, Callable] = {}

    @property
    def std(self) -> torch.Tensor:
        """(8,) standard deviations of the actions."""
        return torch.exp(self.actor.distribution.log_std_param.detach())

    def collect(self) -> None:
        """Run one rollout into the storage, with advantages and returns."""
        self._run('collect', self._collect)

    def learn_batch(self) -> None:
        """Run all epochs over the storage; average losses are in :attr:`losses`."""
        count = self._order.numel()
        self._order.copy_(torch.randperm(count, device=self.device))
        self._run('learn', self._learn)

    def set_rate(self, rate: float) -> None:
        """Set the learning rate."""
        self.rate.fill_(rate)
        self.optimizer.param_groups[0]['lr'] = self.rate if self._graphs else rate

    def _run(self, name, function):
        if name not in self._replay:
            self._replay[name] = self._captured(function) if self._graphs else function
        self._replay[name]()

    def _captured(self, function):
        """Run once to initialise compilers and workspaces, then record."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            function()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            function()
        return graph.replay

    @torch.no_grad()
    def _collect(self):
        s, env, std = self.storage, self.env, self.std
        for t in range(s.num_transitions_per_env):
            mean = self._mean(env.observation)
            action = mean + std * torch.randn_like(mean)
            s.observations['actor'][t].copy_(env.observation)
            s.observations['critic'][t].copy_(env.critic)
            s.actions[t].copy_(action)
            s.distribution_params[0][t].copy_(mean)
            env.advance(action)
            s.rewards[t, :, 0].copy_(env.reward)
            s.dones[t, :, 0].copy_(env.done)
            # for rsl-rl's bootstrap at a time limit; overwritten by the advantages below
            s.advantages[t, :, 0].copy_(env.timeout)
        s.distribution_params[1].copy_(std.expand_as(s.distribution_params[1]))
        s.actions_log_prob.copy_(log_probability(
            s.actions, s.distribution_params[0], std)[..., None])
        s.values.copy_(self.critic.mean(s.observations['critic'].flatten(0, 1)).view_as(s.values))
        s.rewards.add_(self.gamma * s.values * s.advantages)
        self._returns(self.critic.mean(env.critic))

    def _returns(self, last):
        """Generalised advantage estimation (Schulman et al. 2016)."""
        s = self.storage
        alive = 1.0 - s.dones.float()
        following = torch.cat((s.values[1:], last[None]))
        delta = s.rewards + alive * self.gamma * following - s.values
        advantage = torch.zeros_like(last)
        for t in reversed(range(s.num_transitions_per_env)):
            advantage = delta[t] + alive[t] * (self.gamma * self.lam) * advantage
            s.advantages[t].copy_(advantage)
        s.returns.copy_(s.advantages + s.values)
        s.advantages.copy_((s.advantages - s.advantages.mean()) / (s.advantages.std() + 1e-8))

    def _learn(self):
        s, order = self.storage, self._order
        columns = [s.observations['actor'], s.observations['critic'], s.actions,
                   s.distribution_params[0], s.actions_log_prob, s.advantages, s.returns]
        shuffled = [column.flatten(0, 1)[order] for column in columns]
        old_std = s.distribution_params[1][0, 0].clone()
        size = order.numel() // self.num_mini_batches
        self.losses.zero_()
        for _ in range(self.num_learning_epochs):
            for k in range(self.num_mini_batches):
                self._step([column[k * size:(k + 1) * size] for column in shuffled], old_std)
        self.losses.div_(self.num_learning_epochs * self.num_mini_batches)
        with torch.no_grad():       # limit the standard deviations, which rsl-rl does not
            log_std = self.actor.distribution.log_std_param
            limits = self.scheduled[3:].repeat_interleave(4)
            log_std.copy_(torch.minimum(log_std, torch.log(limits)))

    def _step(self, batch, old_std):
        self.optimizer.zero_grad(set_to_none=True)
        loss, parts = self._loss(*batch, old_std)
        loss.backward()
        nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
        nn.utils.clip_grad_norm_(self.critic.parameters(), self.max_grad_norm)
        self._adapt(parts[3])
        self.optimizer.step()
        self.losses.add_(parts)

    def _losses(self, observation, state, action, old_mean, old_log, advantage, returns, old_std):
        """The loss and (4,) value loss, surrogate, entropy, divergence."""
        log_std = self.actor.distribution.log_std_param
        mean, std = self.actor.mean(observation), torch.exp(log_std)
        ratio = torch.exp(log_probability(action, mean, std) - old_log[:, 0])
        clipped = ratio.clamp(1 - self.clip_param, 1 + self.clip_param)
        surrogate = torch.maximum(-advantage[:, 0] * ratio, -advantage[:, 0] * clipped).mean()
        value = (returns - self.critic.mean(state)).pow(2).mean()
        entropy = (log_std + 0.5 * (1 + log(2 * pi))).sum()
        divergence = (torch.log(std / old_std) + (old_std ** 2 + (old_mean - mean) ** 2)
                      / (2 * std ** 2) - 0.5).sum(-1).mean()
        loss = surrogate + self.value_loss_coef * value - self.scheduled[1] * entropy
        if self.teacher is not None:
            apart = (mean - self.teacher.mean(observation)) / std.detach()
            loss = loss + self.scheduled[2] * 0.5 * (apart ** 2).sum(-1).mean()
        return loss, torch.stack((value, surrogate, entropy, divergence)).detach()

    def _adapt(self, divergence):
        """Adapt the learning rate to the divergence of the update, as rsl-rl does."""
        desired, low, high = self.scheduled[0], *self._limits
        factor = torch.where(divergence > 2 * desired, 1 / LEARNING_RATE_STEP, torch.where(
            (divergence < desired / 2) & (divergence > 0), LEARNING_RATE_STEP, 1.0))
        self.rate.copy_((self.rate * factor).clamp(low, high))
        if not self._graphs:
            self.optimizer.param_groups[0]['lr'] = float(self.rate)


def log_probability(action: torch.Tensor, mean: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
    """(...,) log density of (..., 8) actions under a diagonal Gaussian."""
    return -(0.5 * ((action - mean) / std) ** 2 + torch.log(std) + 0.5 * log(2 * pi)).sum(-1)
