"""Small trainings; without the extra 'train' the module that imports this is skipped."""

import pytest

pytest.importorskip('torch')
pytest.importorskip('rsl_rl')
pytest.importorskip('onnxscript')

import torch

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.train.environment import TiltableQuadrotorEnv
from beetle_omni_ros.train.parameters import read_parameters

torch.set_num_threads(1)    # more threads would be slower on such small batches
ROBOT = RobotParameters.load()
SMALL = {'ppo.robots': 16, 'ppo.steps': 6, 'ppo.epochs': 2, 'ppo.minibatches': 2,
         'network.hidden': [16, 16], 'network.critic': [16, 16],
         'iterations': 4, 'log_every': 1, 'save_every': 2}
# Neither noise nor bias nor disturbance, robots as in the file, latencies of one period.
QUIET = {f'random.{name}': 0.0 for name in (
    'mass_scale', 'inertia_scale', 'centre_of_mass', 'position_bias', 'position_noise',
    'attitude_bias', 'attitude_noise', 'velocity_bias', 'velocity_noise', 'rate_bias',
    'rate_noise', 'tilt_bias', 'tilt_noise', 'force_share', 'strong_share', 'payload_share',
    'push_share', 'carried_share', 'estimated_force_bias', 'estimated_force_noise',
    'estimated_torque_bias', 'estimated_torque_noise')} | {
    'random.velocity_latency': [0.0, 0.0], 'random.tilt_latency': [0.0, 0.0],
    'random.command_latency': [0.01, 0.01], 'random.actuator_spread': [0.0, 0.0],
    'random.thrust_limit': [20.0, 20.0]}


def small(changes=None, **more):
    """Shipped parameters at a tiny size, with changes by dotted names."""
    return read_parameters(None, {**SMALL, **(changes or {}), **more})


def environment(changes=None, robots=64, seed=0, robot=ROBOT, **more):
    """Seeded small environment on the CPU."""
    torch.manual_seed(seed)
    return TiltableQuadrotorEnv(small(changes, **{'ppo.robots': robots, **more}), robot)


def quiet(changes=None, **more):
    """:func:`environment` without randomness, with all episodes at their start."""
    env = environment({**QUIET, **(changes or {})}, **more)
    env.state['age'].zero_()
    return env


def only(stratum):
    """Parameters with all robots in one stratum of initial states."""
    names = ('wound_back', 'level', 'wound', 'mixed', 'hover', 'hold', 'moving')
    return {f'start.{name}': float(name == stratum) for name in names}


def uniform(generator, low, high, *shape):
    """Random tensor in [low, high)."""
    return low + (high - low) * torch.rand(*shape, generator=generator)
