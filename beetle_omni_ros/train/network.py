"""
Actor and critic, rsl-rl's MLP models on features of the raw observation, and their ONNX file.

The features are the target attitude in the body frame, gravity in both frames, sines and cosines
of the tilts, and errors on scales of metres and centimetres. They do not depend on the heading of
the world frame, and are part of the exported graph.
"""

import copy
from dataclasses import replace
from datetime import datetime, timezone
import logging
from pathlib import Path
import warnings

import numpy as np
import onnx
from onnx import numpy_helper
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
import torch

from beetle_omni_ros import __version__
from beetle_omni_ros.control.policy_file import (
    add_checksum,
    INPUT,
    OUTPUT,
    PolicyContract,
    session,
)
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import commit
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.train.parameters import TrainParameters

OPSET = 18
AGREEMENT = 1e-5     # largest difference of torch and onnxruntime, relative to the largest action
PROBES = 256         # compared observations
NEAR = 0.1           # [m or rad] below which the normalised error is linear
# Scales that bring the features to about one.
RATE, FORCE, TORQUE, THRUST, TILT_ACTION, THRUST_ACTION = 0.5, 0.1, 2.0, 0.1, 0.25, 0.1
# Blocks of the observation; the critic has eight rotor columns between tilt and action.
VELOCITY, ANGULAR_VELOCITY, TARGET = slice(0, 3), slice(3, 6), slice(6, 9)
TILT = slice(21, 25)
ACTION, ACTOR_SIZE = slice(25, 33), 33
ROTORS, CRITIC_ACTION, TRIM = slice(25, 33), slice(33, 41), slice(41, 47)
ESTIMATE = slice(47, 53)    # of a policy with memory; then mass, arm and gains of the robot


def _fine(error):
    """Normalised error vector, linear for small errors."""
    return error / torch.sqrt((error * error).sum(-1, keepdim=True) + NEAR ** 2)


# What is not linear in the features. The export replaces these functions.
NOT_LINEAR = (torch.linalg.cross, lambda a, b: (a * b).sum(-1), _fine, torch.sin, torch.cos)


def features(observation: torch.Tensor, not_linear=NOT_LINEAR) -> torch.Tensor:
    """(N, 50) features of (N, 33) observations, or (N, 56) of (N, 39)."""
    shared = _shared(observation, observation[..., ACTION], *not_linear)
    return torch.cat([*shared, *_disturbance(observation[..., ACTOR_SIZE:])], -1)


def critic_features(state: torch.Tensor) -> torch.Tensor:
    """(N, 64) features of the (N, 47) privileged state, or (N, 76) of (N, 59)."""
    shared = _shared(state, state[..., CRITIC_ACTION], *NOT_LINEAR)
    rotors = state[..., ROTORS]
    return torch.cat([*shared, rotors[..., :4], THRUST * rotors[..., 4:],
                      state[..., TRIM] / NEAR, *_disturbance(state[..., ESTIMATE]),
                      state[..., ESTIMATE.stop:]], -1)


def _shared(o, action, cross, dot, fine, sin, cos):
    target, tilt = o[..., TARGET], o[..., TILT]
    x, z = o[..., 9:12], o[..., 12:15]
    x_goal, z_goal = o[..., 15:18], o[..., 18:21]
    y, y_goal = cross(z, x), cross(z_goal, x_goal)
    axes, goals = (x, y, z), (x_goal, y_goal, z_goal)
    relative = [dot(a, g) for a in axes for g in goals]    # R^T R*, row by row
    turn = 0.5 * torch.stack((relative[7] - relative[5], relative[2] - relative[6],
                              relative[3] - relative[1]), -1)
    return [o[..., VELOCITY], RATE * o[..., ANGULAR_VELOCITY], target, fine(target),
            torch.stack(relative, -1), fine(turn),
            torch.stack([a[..., 2] for a in axes], -1),
            torch.stack([g[..., 2] for g in goals], -1),
            tilt, sin(tilt), cos(tilt),
            TILT_ACTION * action[..., :4], THRUST_ACTION * action[..., 4:]]


def _disturbance(block):
    return [FORCE * block[..., :3], TORQUE * block[..., 3:]] if block.shape[-1] else []


class FeatureModel(MLPModel):
    """
    Actor or critic of rsl-rl, on features of its observation.

    The mean action is output_scale * mlp(features) + carry * previous action, the value of the
    critic mlp(features). ``stds`` are initial standard deviations of the actions.
    """

    def __init__(self, obs, obs_groups, obs_set, output_dim, *, output_scale=1.0, carry=0.0,
                 last_gain=None, stds=None, **keywords):
        self.features = features if obs_set == 'actor' else critic_features
        super().__init__(obs, obs_groups, obs_set, output_dim, **keywords)
        self.output_scale, self.carry = output_scale, carry
        if stds:
            with torch.no_grad():
                self.mlp[-1].weight.mul_(last_gain)
                self.mlp[-1].bias.zero_()
                self.distribution.log_std_param.copy_(torch.log(torch.tensor(stds)))

    def mean(self, observation: torch.Tensor) -> torch.Tensor:
        """(N, 8) mean actions of (N, 33 or 39) observations; (N, 1) values of states."""
        out = self.output_scale * self.mlp(self.features(observation))
        return out + self.carry * observation[..., ACTION] if self.carry else out

    def forward(self, obs, masks=None, hidden_state=None, stochastic_output=False):
        """As rsl-rl's model, on features."""
        mean = self.mean(torch.cat([obs[group] for group in self.obs_groups], -1))
        if stochastic_output:
            self.distribution.update(mean)
            return self.distribution.sample()
        return mean

    def _get_latent_dim(self):
        return self.features(torch.zeros(1, self.obs_dim)).shape[-1]


def actor_of(path: Path, like: FeatureModel) -> FeatureModel:
    """Actor of a checkpoint or policy file, with layers of any size; ParameterError if none."""
    try:
        layers = _layers(path, like.output_scale)
        *hidden, out = [len(value) for name, value in layers.items() if name.endswith('bias')]
        actor = copy.deepcopy(like)
        actor.mlp = MLP(like.mlp[0].in_features, out, hidden)
        actor.mlp.load_state_dict(layers)
    except Exception as error:      # torch's errors for a bad file have no common base class
        raise ParameterError(f'{path}: no checkpoint or policy with the same inputs '
                             f'({" ".join(str(error).split())[:160]})') from None
    return actor.to(like.mlp[0].weight.device).requires_grad_(False)


def _layers(path, scale):
    """Weights and biases of the network in a file, first to last, by the names of the network."""
    if path.suffix != '.onnx':
        saved = torch.load(str(path), map_location='cpu', weights_only=True)['actor_state_dict']
        return {name.removeprefix('mlp.'): value for name, value in saved.items()
                if name.startswith('mlp.')}
    graph = onnx.load(path).graph
    arrays = {each.name: torch.tensor(numpy_helper.to_array(each)) for each in graph.initializer}
    # The normalised errors complete the features, see ExportedPolicy; linear layers follow.
    behind = [node.op_type for node in graph.node].index('Div')
    pairs = [[arrays[name] for name in node.input[1:]] for node in graph.node[behind:]
             if node.op_type == 'Gemm']
    (*_, (_, before)), (weight, bias) = pairs[:-1], pairs[-1]
    # the last weights stand beside the carried actions, with the scale of the output
    pairs[-1] = weight[:, :len(before)] / scale, bias / scale
    return {f'{2 * k}.{kind}': value for k, pair in enumerate(pairs)
            for kind, value in zip(('weight', 'bias'), pair, strict=True)}


class ExportedPolicy(torch.nn.Module):
    """
    :meth:`FeatureModel.mean` in few operations, whose number determines the time on one CPU core.

    Axes and products of axes are appended to the observation by two stages of products. All
    features are then one linear function of these numbers, except that errors are normalised and
    angles become sines.
    """

    def __init__(self, actor: FeatureModel):
        super().__init__()
        self.mlp: MLP = copy.deepcopy(actor.mlp).cpu()
        stages, linear = _folded(actor.obs_dim)
        self.stages = [[factor.T.contiguous() for factor in stage] for stage in stages]
        count = linear.shape[1]
        self.offset = torch.zeros(count)
        self.offset[COSINES] = 0.5 * torch.pi       # cosines are sines
        self.angles = torch.zeros(count, actor.obs_dim)
        for block in (SINES, COSINES):
            self.angles[block] = linear[:actor.obs_dim, block].T
            linear[:, block] = 0.0
        self.linear = linear
        self.norms, self.near = torch.zeros(count, count), torch.ones(count)
        for block in FINE:
            self.norms[block, block], self.near[block] = 1.0, NEAR ** 2
        last = self.mlp[-1]
        self.carry = torch.zeros(last.out_features, actor.obs_dim)
        self.carry[:, ACTION] = actor.carry * torch.eye(last.out_features)
        with torch.no_grad():
            last.weight.mul_(actor.output_scale)
            last.bias.mul_(actor.output_scale)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(1, 8) action of a (1, 33 or 39) observation."""
        linear, known = torch.nn.functional.linear, observation
        for left, right in self.stages:
            known = torch.cat((known, linear(known, left) * linear(known, right)), -1)
        sines = torch.sin(linear(observation, self.angles, self.offset))
        features = torch.addmm(sines, known, self.linear)   # of angles: nothing but the sines
        features = features / torch.sqrt(linear(features * features, self.norms, self.near))
        *hidden, last = self.mlp
        for layer in hidden:
            features = layer(features)
        return linear(torch.cat((features, observation), -1),
                      torch.cat((last.weight, self.carry), -1), last.bias)


# Places of the normalised errors and of the sines and cosines of the tilts in the features.
FINE, SINES, COSINES = (slice(9, 12), slice(21, 24)), slice(34, 38), slice(38, 42)
CROSS_PRODUCTS, DOT_PRODUCTS = 12, 27      # of two cross products and nine scalar products


def _folded(size):
    """Left and right matrices of both stages of products, and the matrix of the features."""
    # Features of the rows of a unit matrix are a matrix, if all that is not linear is replaced by
    # a linear function of the results of the stages.
    known = torch.eye(size + CROSS_PRODUCTS + DOT_PRODUCTS)
    products = iter(known[:, size:].split(3, -1))
    crossed, dotted = [], []

    def cross(a, b):
        crossed.extend(((a[:, (1, 2, 0)], b[:, (2, 0, 1)]), (a[:, (2, 0, 1)], b[:, (1, 2, 0)])))
        return next(products) - next(products)

    def dot(a, b):
        dotted.append((a, b))
        return next(products).sum(-1)

    def same(value):
        return value

    linear = features(known[:, :size], (cross, dot, same, same, same))
    return [[torch.cat(factors, -1)[:rows] for factors in zip(*stage)]
            for stage, rows in ((crossed, size), (dotted, size + CROSS_PRODUCTS))], linear


def export_policy(actor: FeatureModel, path: Path, robot: RobotParameters,
                  parameters: TrainParameters, training: dict) -> float:
    """
    Write an actor as ONNX with further facts of its training.

    Returns:
        largest difference of torch and onnxruntime, relative to the largest action; RunError if it
        exceeds ``AGREEMENT``.

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
        contract, training={**parameters.plain(), **training}, commit=commit() or '',
        version=__version__,
        created=datetime.now(timezone.utc).isoformat(timespec='seconds'))
    # The exporter's notes on the origin of nodes contain local paths.
    graph = written.graph
    for noted in (written, graph, *graph.node, *graph.input, *graph.output, *graph.value_info,
                  *written.functions):
        del noted.metadata_props[:]
        noted.doc_string = ''
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
