"""
Actor and critic: rsl-rl's MLP models on features of the raw observation.

The features are functions of the 33 (or 39) numbers alone and part of the exported graph, so
that the interface stays the raw observation: target attitude seen from the body, direction of
gravity in both frames, sines and cosines of the tilts, errors on a scale of centimetres as
well as metres. None of them depends on the heading of the world's axes.
"""

from __future__ import annotations

import copy

from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from rsl_rl.modules.distribution import GaussianDistribution
import torch

NEAR = 0.1           # [m or rad] below which an error's fine feature is linear
# Scales that bring the features to about one.
RATE, FORCE, TORQUE, THRUST, TILT_ACTION, THRUST_ACTION = 0.5, 0.1, 2.0, 0.1, 0.25, 0.1
# Blocks of the observation; the critic has eight rotor columns between tilt and action.
VELOCITY, ANGULAR_VELOCITY, TARGET = slice(0, 3), slice(3, 6), slice(6, 9)
ATTITUDE, TARGET_ATTITUDE, TILT = slice(9, 15), slice(15, 21), slice(21, 25)
ACTION, ACTOR_SIZE = slice(25, 33), 33
ROTORS, CRITIC_ACTION, CRITIC_SIZE = slice(25, 33), slice(33, 41), 41


def features(observation: torch.Tensor) -> torch.Tensor:
    """(N, 50) features of (N, 33) observations, or (N, 56) of (N, 39)."""
    shared = _shared(observation, observation[..., ACTION])
    return torch.cat([*shared, *_disturbance(observation[..., ACTOR_SIZE:])], -1)


def critic_features(state: torch.Tensor) -> torch.Tensor:
    """(N, 58) features of the (N, 41) privileged state, or (N, 64) of (N, 47)."""
    shared = _shared(state, state[..., CRITIC_ACTION])
    rotors = state[..., ROTORS]
    return torch.cat([*shared, rotors[..., :4], THRUST * rotors[..., 4:],
                      *_disturbance(state[..., CRITIC_SIZE:])], -1)


def _shared(o, action):
    target, tilt = o[..., TARGET], o[..., TILT]
    x, z = o[..., 9:12], o[..., 12:15]
    x_goal, z_goal = o[..., 15:18], o[..., 18:21]
    y, y_goal = torch.linalg.cross(z, x), torch.linalg.cross(z_goal, x_goal)
    axes, goals = (x, y, z), (x_goal, y_goal, z_goal)
    relative = [(a * g).sum(-1) for a in axes for g in goals]    # R^T R*, row by row
    turn = 0.5 * torch.stack((relative[7] - relative[5], relative[2] - relative[6],
                              relative[3] - relative[1]), -1)
    return [o[..., VELOCITY], RATE * o[..., ANGULAR_VELOCITY], target, _fine(target),
            torch.stack(relative, -1), _fine(turn),
            torch.stack([a[..., 2] for a in axes], -1),
            torch.stack([g[..., 2] for g in goals], -1),
            tilt, torch.sin(tilt), torch.cos(tilt),
            TILT_ACTION * action[..., :4], THRUST_ACTION * action[..., 4:]]


def _fine(error):
    """The direction of an error, going to zero linearly where it is small."""
    return error / torch.sqrt((error * error).sum(-1, keepdim=True) + NEAR ** 2)


def _disturbance(block):
    return [FORCE * block[..., :3], TORQUE * block[..., 3:]] if block.shape[-1] else []


class ActorModel(MLPModel):
    """
    Raw observation to the mean action: scale * mlp(features) + carry * previous action.

    Args:
        output_scale: action for each unit of the last layer.
        carry: part of the previous action that the output is added to.
        last_gain: initial gain of the last layer.

    """

    def __init__(self, obs, obs_groups, obs_set, output_dim, *, output_scale: float, carry: float,
                 last_gain: float, **keywords):
        super().__init__(obs, obs_groups, obs_set, output_dim, **keywords)
        self.output_scale, self.carry = output_scale, carry
        with torch.no_grad():
            self.mlp[-1].weight.mul_(last_gain)
            self.mlp[-1].bias.zero_()

    def mean(self, observation: torch.Tensor) -> torch.Tensor:
        """(N, 8) mean actions of (N, 33 or 39) observations."""
        out = self.output_scale * self.mlp(features(observation))
        return out + self.carry * observation[..., ACTION] if self.carry else out

    def forward(self, obs, masks=None, hidden_state=None, stochastic_output=False):
        """As rsl-rl's model, with the features in front."""
        mean = self.mean(torch.cat([obs[group] for group in self.obs_groups], -1))
        if stochastic_output:
            self.distribution.update(mean)
            return self.distribution.sample()
        return mean

    def _get_latent_dim(self):
        return features(torch.zeros(1, self.obs_dim)).shape[-1]


class CriticModel(MLPModel):
    """Privileged state to its value."""

    def value(self, state: torch.Tensor) -> torch.Tensor:
        """(N, 1) values of (N, 41 or 47) states."""
        return self.mlp(critic_features(state))

    def forward(self, obs, masks=None, hidden_state=None, stochastic_output=False):
        """As rsl-rl's model, with the features in front."""
        return self.value(torch.cat([obs[group] for group in self.obs_groups], -1))

    def _get_latent_dim(self):
        return critic_features(torch.zeros(1, self.obs_dim)).shape[-1]


class BoundedGaussian(GaussianDistribution):
    """Gaussian with one standard deviation for each action, bounded from above by a schedule."""

    def __init__(self, output_dim: int, stds: list[float]):
        super().__init__(output_dim, std_type='log')
        with torch.no_grad():
            self.log_std_param.copy_(torch.log(torch.tensor(stds)))

    def bound(self, limits: torch.Tensor) -> None:
        """Bring the standard deviations down to (8,) ``limits``."""
        with torch.no_grad():
            self.log_std_param.copy_(torch.minimum(self.log_std_param, torch.log(limits)))


class ExportedPolicy(torch.nn.Module):
    """
    What the ONNX file holds: raw observation in, mean action out, in few operations.

    The same function as :meth:`ActorModel.mean`, written for a single observation on one core:
    features in groups that share an operation, all scales folded into the first and the last
    layer. On board it takes half the time of the original.
    """

    def __init__(self, actor: ActorModel):
        super().__init__()
        self.carry = actor.carry
        self.mlp: MLP = copy.deepcopy(actor.mlp).cpu()
        sizes = dict(BLOCKS[:len(BLOCKS) if actor.obs_dim > ACTOR_SIZE else -2])
        first = dict(zip(sizes, torch.arange(sum(sizes.values())).split(list(sizes.values()))))
        order = torch.cat([first[name] for name in GROUPED if name in first])
        scale = torch.cat([torch.full((size,), SCALES.get(name, 1.0))
                           for name, size in sizes.items()])
        with torch.no_grad():
            weight = self.mlp[0].weight * scale
            self.mlp[0].weight.copy_(weight[:, order])
            self.mlp[-1].weight.mul_(actor.output_scale)
            self.mlp[-1].bias.mul_(actor.output_scale)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(1, 8) action of a (1, 33 or 39) observation."""
        out = self.mlp(grouped_features(observation))
        return out + self.carry * observation[:, ACTION] if self.carry else out


# Blocks of :func:`features` with their sizes, and the order in which the exported graph makes
# them, without the scales.
BLOCKS = (('velocity', 3), ('rate', 3), ('target', 3), ('target_fine', 3), ('relative', 9),
          ('turn_fine', 3), ('up', 3), ('target_up', 3), ('tilt', 4), ('sine', 4), ('cosine', 4),
          ('tilt_action', 4), ('thrust_action', 4), ('force', 3), ('torque', 3))
GROUPED = ('velocity', 'rate', 'target', 'target_fine', 'turn_fine', 'relative', 'up',
           'target_up', 'sine', 'cosine', 'tilt', 'tilt_action', 'thrust_action', 'force',
           'torque')
SCALES = {'rate': RATE, 'tilt_action': TILT_ACTION, 'thrust_action': THRUST_ACTION,
          'force': FORCE, 'torque': TORQUE}


def grouped_features(o: torch.Tensor) -> torch.Tensor:
    """(1, 50 or 56) features of one observation, unscaled, in the order ``GROUPED``."""
    def take(values, *places):
        return torch.index_select(values, -1, torch.tensor(places))

    # y = z x x of body and target, entry by entry: both axes rotated once and twice
    y = take(o, 13, 14, 12, 19, 20, 18) * take(o, 11, 9, 10, 17, 15, 16) \
        - take(o, 14, 12, 13, 20, 18, 19) * take(o, 10, 11, 9, 16, 17, 15)
    axes = torch.cat((o[:, ATTITUDE], o[:, TARGET_ATTITUDE], y), -1)    # x z, x* z*, y y*
    body = take(axes, 0, 1, 2, 12, 13, 14, 3, 4, 5).reshape(3, 3)
    goal = take(axes, 6, 15, 9, 7, 16, 10, 8, 17, 11).reshape(3, 3)
    relative = (body @ goal).reshape(1, 9)
    turn = 0.5 * (take(relative, 7, 2, 3) - take(relative, 5, 6, 1))
    errors = torch.cat((o[:, TARGET], turn), 0)
    up = take(axes, 2, 14, 5, 8, 17, 11)
    tilt = o[:, TILT]
    return torch.cat((o[:, :9], _fine(errors).reshape(1, 6), relative, up, torch.sin(tilt),
                      torch.cos(tilt), o[:, 21:]), -1)
