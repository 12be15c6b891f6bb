"""
Actor and critic, rsl-rl's MLP models on features of the raw observation, and their ONNX file.

The features are functions of the 33 (or 39) observed numbers and part of the exported graph. The
interface is therefore the raw observation. The features are the target attitude in the body
frame, gravity in both frames, sines and cosines of the tilts, and errors on scales of metres and
centimetres. They do not depend on the heading of the world frame.
"""

import copy
from dataclasses import replace
from datetime import datetime, timezone
import logging
from pathlib import Path
import subprocess
import warnings

import numpy as np
import onnx
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from rsl_rl.modules.distribution import GaussianDistribution
import torch

from beetle_omni_ros import __version__
from beetle_omni_ros.control.policy_file import (
    add_checksum,
    INPUT,
    OUTPUT,
    PolicyContract,
    session,
)
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import RunError
from beetle_omni_ros.train.parameters import TrainParameters

OPSET = 18
AGREEMENT = 1e-5     # largest difference of torch and onnxruntime, relative to the largest action
PROBES = 256         # compared observations
NEAR = 0.1           # [m or rad] below which the normalised error is linear
# Scales that bring the features to about one.
RATE, FORCE, TORQUE, THRUST, TILT_ACTION, THRUST_ACTION = 0.5, 0.1, 2.0, 0.1, 0.25, 0.1
# Blocks of the observation; the critic has eight rotor columns between tilt and action.
VELOCITY, ANGULAR_VELOCITY, TARGET = slice(0, 3), slice(3, 6), slice(6, 9)
ATTITUDES, TILT = slice(9, 21), slice(21, 25)     # of body and target; joints
ACTION, ACTOR_SIZE = slice(25, 33), 33
ROTORS, CRITIC_ACTION, TRIM, CRITIC_SIZE = slice(25, 33), slice(33, 41), slice(41, 47), 47


def features(observation: torch.Tensor) -> torch.Tensor:
    """(N, 50) features of (N, 33) observations, or (N, 56) of (N, 39)."""
    shared = _shared(observation, observation[..., ACTION])
    return torch.cat([*shared, *_disturbance(observation[..., ACTOR_SIZE:])], -1)


def critic_features(state: torch.Tensor) -> torch.Tensor:
    """(N, 64) features of the (N, 47) privileged state, or (N, 70) of (N, 53)."""
    shared = _shared(state, state[..., CRITIC_ACTION])
    rotors = state[..., ROTORS]
    return torch.cat([*shared, rotors[..., :4], THRUST * rotors[..., 4:],
                      state[..., TRIM] / NEAR, *_disturbance(state[..., CRITIC_SIZE:])], -1)


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
    """Normalised error vector, linear for small errors."""
    return error / torch.sqrt((error * error).sum(-1, keepdim=True) + NEAR ** 2)


def _disturbance(block):
    return [FORCE * block[..., :3], TORQUE * block[..., 3:]] if block.shape[-1] else []


class ActorModel(MLPModel):
    """Actor with the mean action output_scale * mlp(features) + carry * previous action."""

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
        """As rsl-rl's model, on features."""
        mean = self.mean(torch.cat([obs[group] for group in self.obs_groups], -1))
        if stochastic_output:
            self.distribution.update(mean)
            return self.distribution.sample()
        return mean

    def _get_latent_dim(self):
        return features(torch.zeros(1, self.obs_dim)).shape[-1]


class CriticModel(MLPModel):
    """Critic: value of the privileged state."""

    def value(self, state: torch.Tensor) -> torch.Tensor:
        """(N, 1) values of (N, 47 or 53) states."""
        return self.mlp(critic_features(state))

    def forward(self, obs, masks=None, hidden_state=None, stochastic_output=False):
        """As rsl-rl's model, on features."""
        return self.value(torch.cat([obs[group] for group in self.obs_groups], -1))

    def _get_latent_dim(self):
        return critic_features(torch.zeros(1, self.obs_dim)).shape[-1]


class BoundedGaussian(GaussianDistribution):
    """Gaussian with a standard deviation for each action and an upper bound from the schedule."""

    def __init__(self, output_dim: int, stds: list[float]):
        super().__init__(output_dim, std_type='log')
        with torch.no_grad():
            self.log_std_param.copy_(torch.log(torch.tensor(stds)))

    def bound(self, limits: torch.Tensor) -> None:
        """Limit the standard deviations to (8,) ``limits``."""
        with torch.no_grad():
            self.log_std_param.copy_(torch.minimum(self.log_std_param, torch.log(limits)))


class ExportedPolicy(torch.nn.Module):
    """
    Network of the ONNX file, from the raw observation to the mean action in few operations.

    The function is that of :meth:`ActorModel.mean`, written for a single observation on one CPU
    core, where the number of operations determines the time. All linear operations between two
    products, with their scales and the previous action, are therefore one constant matrix.
    """

    def __init__(self, actor: ActorModel):
        super().__init__()
        size = actor.obs_dim
        self.mlp: MLP = copy.deepcopy(actor.mlp).cpu()
        known = size + len(CROSSED[0])
        # matrices of linear functions of rows
        left, right = _factors(torch.eye(known))
        self.register_buffer('left', left)
        self.register_buffer('right', right)
        self.register_buffer('linear', _linear(torch.eye(known + left.shape[1])).T)
        self.splits = [self.linear.shape[0] - 14, 6, 8]
        self.register_buffer('offset', torch.zeros(self.linear.shape[0]))
        self.offset[-4:] = 0.5 * torch.pi       # cosines are sines
        self.register_buffer('norms', torch.block_diag(torch.ones(3, 3), torch.ones(3, 3)))
        self.register_buffer('near', torch.full((6,), NEAR ** 2))
        last = self.mlp[-1]
        self.register_buffer('carry', torch.zeros(last.out_features, size))
        self.carry[:, ACTION] = actor.carry * torch.eye(last.out_features)
        sizes = dict(BLOCKS[:len(BLOCKS) if size > ACTOR_SIZE else -2])
        first = dict(zip(sizes, torch.arange(sum(sizes.values())).split(list(sizes.values()))))
        order = torch.cat([first[name] for name in sizes if name not in NOT_LINEAR]
                          + [first[name] for name in NOT_LINEAR])
        with torch.no_grad():
            self.mlp[0].weight.copy_(self.mlp[0].weight[:, order])
            last.weight.mul_(actor.output_scale)
            last.bias.mul_(actor.output_scale)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(1, 8) action of a (1, 33 or 39) observation."""
        first, second = (torch.index_select(observation, -1, torch.tensor(places))
                         for places in CROSSED)
        known = torch.cat((observation, first * second), -1)
        known = torch.cat((known, (known @ self.left) * (known @ self.right)), -1)
        features, errors, angles = torch.nn.functional.linear(
            known, self.linear, self.offset).split(self.splits, -1)
        norms = torch.sqrt(torch.nn.functional.linear(errors * errors, self.norms, self.near))
        features = torch.cat((features, errors / norms, torch.sin(angles)), -1)
        *hidden, last = self.mlp
        for layer in hidden:
            features = layer(features)
        return torch.nn.functional.linear(torch.cat((features, observation), -1),
                                          torch.cat((last.weight, self.carry), -1), last.bias)


# Blocks of :func:`features` with their sizes, and the blocks at the end of the exported graph.
BLOCKS = (('velocity', 3), ('rate', 3), ('target', 3), ('target_fine', 3), ('relative', 9),
          ('turn_fine', 3), ('up', 3), ('target_up', 3), ('tilt', 4), ('sine', 4), ('cosine', 4),
          ('tilt_action', 4), ('thrust_action', 4), ('force', 3), ('torque', 3))
NOT_LINEAR = ('target_fine', 'turn_fine', 'sine', 'cosine')
# Indices of the observation whose products are y = z x x of body and target. The first six
# products have a positive sign.
CROSSED = ((13, 14, 12, 19, 20, 18, 14, 12, 13, 20, 18, 19),
           (11, 9, 10, 17, 15, 16, 10, 11, 9, 16, 17, 15))


def _axes(known):
    """Axes of body and target from the observation and the subsequent products."""
    x, z, x_goal, z_goal = known[:, ATTITUDES].split(3, -1)
    y, y_goal = (known[:, -12:-6] - known[:, -6:]).split(3, -1)
    return (x, y, z), (x_goal, y_goal, z_goal)


def _factors(known):
    """Left and right factors of the products of the body's axes with the target's axes."""
    body, goals = _axes(known)
    return (torch.cat([axis for axis in body for _ in goals], -1),
            torch.cat([goal for _ in body for goal in goals], -1))


def _linear(known):
    """Features that are linear in observation and products, errors (6) and angles (8)."""
    o, products = known[:, :-27], known[:, -27:]
    body, goals = _axes(o)
    relative = products.reshape(-1, 9, 3).sum(-1)
    turn = 0.5 * (relative[:, (7, 2, 3)] - relative[:, (5, 6, 1)])
    target, tilt, action = o[:, TARGET], o[:, TILT], o[:, ACTION]
    return torch.cat((
        o[:, VELOCITY], RATE * o[:, ANGULAR_VELOCITY], target, relative,
        *(axis[:, 2:] for axis in (*body, *goals)), tilt,
        TILT_ACTION * action[:, :4], THRUST_ACTION * action[:, 4:],
        *_disturbance(o[:, ACTOR_SIZE:-12]), target, turn, tilt, tilt), -1)


def export_policy(actor: ActorModel, path: Path, robot: RobotParameters,
                  parameters: TrainParameters, training: dict | None = None,
                  metrics: dict | None = None) -> float:
    """
    Write an actor as ONNX with further facts of its training, and compare the file with it.

    Returns:
        largest difference of torch and onnxruntime, relative to the largest action.

    Raises:
        RunError: the difference exceeds ``AGREEMENT``.

    """
    actor = copy.deepcopy(actor).cpu().eval()
    network, size = ExportedPolicy(actor).eval(), actor.obs_dim
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        logging.getLogger('torch.onnx').setLevel(logging.ERROR)
        program = torch.onnx.export(
            network, (torch.zeros(1, size),), input_names=[INPUT], output_names=[OUTPUT],
            opset_version=OPSET, dynamo=True, verbose=False)
    written = program.model_proto
    contract = PolicyContract.default(robot, parameters.memory)
    contract = replace(
        contract, training={**parameters.plain(), **(training or {})}, metrics=metrics or {},
        commit=_commit(), version=__version__,
        created=datetime.now(timezone.utc).isoformat(timespec='seconds'))
    _strip_paths(written)
    for key, value in contract.to_metadata().items():
        written.metadata_props.add(key=key, value=value)
    part = path.with_suffix('.part')
    onnx.save(written, str(part))
    add_checksum(part)
    difference = _difference(actor.mean, part, size)
    if not difference <= AGREEMENT:
        part.unlink()
        raise RunError(f'{path}: torch and onnxruntime differ by {difference:.2g}, more than '
                       f'{AGREEMENT:g}')
    part.replace(path)
    return difference


def _difference(mean, path, size):
    """Largest relative difference of torch and onnxruntime on random observations."""
    network = session(path.read_bytes())
    probes = torch.randn(PROBES, size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = mean(probes).numpy()
    found = np.concatenate([network.run([OUTPUT], {INPUT: row[None].numpy()})[0]
                            for row in probes])
    return float(np.abs(found - expected).max() / max(np.abs(expected).max(), 1.0))


def _strip_paths(proto):
    """Remove the exporter's notes on the origin of nodes, because they contain local paths."""
    for part in (proto, proto.graph, *proto.graph.node, *proto.graph.input, *proto.graph.output,
                 *proto.graph.value_info, *proto.functions):
        del part.metadata_props[:]
        part.doc_string = ''


def _commit() -> str:
    """Commit of the working tree of this package, '' outside of one."""
    try:
        done = subprocess.run(['git', 'describe', '--always', '--dirty', '--abbrev=12'],
                              cwd=Path(__file__).parent, capture_output=True, text=True,
                              timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return ''
    return done.stdout.strip()
