"""Observations of actor and critic for known states, with and without delay and noise."""

from learning import only, quiet, uniform
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import torch

from beetle_omni_ros.control.base import PoseTarget, Reference, State
from beetle_omni_ros.control.guidance import Trimming
from beetle_omni_ros.control.policy import disturbed, observed
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.train import batch
from beetle_omni_ros.train.batch import delayed, extrapolated, sensed

SEEN = {'velocity': slice(0, 3), 'rate': slice(3, 6), 'tilt': slice(21, 25)}


def scattered(env, seed=0):
    """Put the robots and their targets anywhere; returns the state."""
    g, n, s = torch.Generator().manual_seed(seed), env.num_envs, env.state
    s['x'].copy_(torch.cat((
        torch.randn(n, 6, generator=g),
        torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=-1),
        torch.randn(n, 3, generator=g), uniform(g, -3.9, 3.9, n, 4),
        torch.randn(n, 4, generator=g), uniform(g, 0, 20, n, 4)), -1))
    s['previous'].copy_(torch.cat((uniform(g, -3.9, 3.9, n, 4), uniform(g, 0, 20, n, 4)), -1))
    s['target_position'].copy_(torch.randn(n, 3, generator=g))
    s['target_attitude'].copy_(torch.nn.functional.normalize(
        torch.randn(n, 4, generator=g), dim=-1))
    s['estimate'].copy_(torch.randn(n, 6, generator=g))
    return s


def draw(env, seed=1):
    return batch.Draw(torch.rand(env.num_envs, 40, generator=torch.Generator().manual_seed(seed)))


def on_board(env, k):
    """The observation that the controller makes of robot k."""
    s = {name: value[k].double().numpy() for name, value in env.state.items()}
    x = s['x']
    state = State(0.0, x[model.POSITION], x[model.VELOCITY], x[model.QUATERNION], x[model.RATE],
                  x[model.TILT], x[model.TILT_RATE], 0.0)
    zero = np.zeros(3)
    target = Reference(s['target_position'], s['target_attitude'], zero, zero)
    action = (s['previous'] - env.offset.double().numpy()) / env.scale.double().numpy()
    return np.array(observed(state, target, action)
                    + (disturbed(state, s['estimate']) if env.cfg.memory else []))


@pytest.mark.parametrize('memory', [False, True])
def test_without_noise_and_delay_batch_and_controller_observations_agree(memory):
    env = quiet({'memory': memory})
    scattered(env)
    seen, _ = env._observe(env.state, draw(env))
    assert seen.shape == (env.num_envs, 39 if memory else 33)
    expected = np.stack([on_board(env, k) for k in range(env.num_envs)])
    np.testing.assert_allclose(seen, expected, atol=2e-5)


@pytest.mark.parametrize(('delay', 'weights'), [(0.0, [1, 0, 0]), (0.015, [0, 0.5, 0.5])])
@pytest.mark.parametrize('late_one', ['velocity', 'tilt'])
def test_a_delayed_observation_is_a_past_state(delay, weights, late_one):
    env = quiet({**only('moving'), f'random.{late_one}_latency': [delay, delay]}, robots=16)
    g, truth = torch.Generator().manual_seed(2), []
    for _ in range(8):
        env.advance(torch.randn(16, 8, generator=g))
        x = env.state['x']
        back = batch.transpose_product(batch.matrix(x[:, model.QUATERNION]), x[:, model.VELOCITY])
        truth.insert(0, {'velocity': back, 'rate': x[:, model.RATE].clone(),
                         'tilt': x[:, model.TILT].clone()})
    assert not env.done.any()
    for name, places in SEEN.items():
        late_too = (name == 'tilt') == (late_one == 'tilt')
        expected = sum(w * moment[name] for w, moment in zip(weights, truth)) if late_too \
            else truth[0][name]
        torch.testing.assert_close(env.observation[:, places], expected, atol=1e-5, rtol=1e-5)
    assert (truth[0]['tilt'] - truth[1]['tilt']).abs().max() > 0.01


@pytest.mark.parametrize('delay', [0.0, 0.012, 0.025])
def test_extrapolation_removes_the_delay_of_a_ramp_and_reduces_that_of_a_swing(delay):
    t = -0.01 * torch.arange(5)[None, :, None]
    span = torch.full((1, 1), delay)
    ramp = 3.0 - 2.0 * t
    torch.testing.assert_close(extrapolated(ramp, span, span), ramp[:, 0])
    torch.testing.assert_close(extrapolated(ramp, span, 0 * span), delayed(ramp, span))
    swings = torch.stack([torch.sin(2 * torch.pi * 2.0 * t + phase) for phase in
                          torch.linspace(0, 6.2, 40)])[:, 0]
    spans = span.expand(40, 1)
    wrong = (extrapolated(swings, spans, spans) - swings[:, 0]).abs().max()
    assert wrong <= 0.45 * (delayed(swings, spans) - swings[:, 0]).abs().max() + 1e-6


def widths(env, random, seed=1):
    """Errors of the signals of many robots."""
    s = env.state
    position, attitude, velocity, rate, tilt = sensed(random, s, draw(env, seed))
    x = s['x']
    rotation = Rotation.from_quat(x[:, 6:10].numpy())
    wrong = rotation.inv() * Rotation.from_matrix(attitude.double().numpy())
    back = batch.transpose_product(batch.matrix(x[:, 6:10]), x[:, 3:6])
    return {'position': (position - x[:, :3]).numpy(), 'attitude': wrong.as_rotvec(),
            'velocity': (velocity - back).numpy(), 'rate': (rate - x[:, 10:13]).numpy(),
            'tilt': (tilt - x[:, 13:17]).numpy()}


@pytest.mark.parametrize('kind', ['noise', 'bias'])
@pytest.mark.parametrize('name', ['position', 'attitude', 'velocity', 'rate', 'tilt'])
def test_noise_and_bias_fill_their_half_width_in_their_entries_only(name, kind):
    env = quiet({f'random.{name}_{kind}': 0.04, 'random.noise_power': 0.0}, robots=2000)
    for other, error in widths(env, env.cfg.random).items():
        if other == name:
            assert 0.0396 < np.abs(error).max() < 0.0401
            assert np.abs(error.mean(0)).max() < 0.002
            assert error.std(0) == pytest.approx(0.04 / 3 ** 0.5, rel=0.06)
            first, second = (widths(env, env.cfg.random, seed)[name] for seed in (1, 2))
            assert np.allclose(first, second, atol=1e-5) == (kind == 'bias')
        else:
            assert np.abs(error).max() < 1e-5


def test_the_estimate_is_observed_with_its_noise_and_bias():
    env = quiet({'memory': True, 'random.noise_power': 0.0, 'random.estimated_force_noise': 0.3,
                 'random.estimated_torque_bias': 0.2}, robots=2000)
    scattered(env)
    seen, _ = env._observe(env.state, draw(env))
    s = env.state
    force = batch.transpose_product(batch.matrix(s['x'][:, 6:10]), s['estimate'][:, :3])
    assert 0.295 < float((seen[:, 33:36] - force).abs().max()) < 0.3001
    assert 0.195 < float((seen[:, 36:] - s['estimate'][:, 3:]).abs().max()) < 0.2001


def test_the_trimming_of_the_batch_is_that_of_the_controller():
    env = quiet({'episode.trim_share': 0.5})
    s = scattered(env)
    near = torch.arange(env.num_envs) % 3 > 0
    s['x'][near, model.VELOCITY] = 0.05
    s['x'][near, model.RATE] = 0.1
    offset = torch.tensor([0.04, -0.03, 0.05])
    s['x'][near, :3] = (s['target_position'] + offset)[near]
    turn = batch.from_rotation_vector(torch.tensor([[0.02, -0.05, 0.04]]))
    s['x'][near, model.QUATERNION] = batch.product(s['target_attitude'], turn)[near]
    steps = 200
    for _ in range(steps):
        s['trim'] = env._trim(s, s['x'])
    for k in range(env.num_envs):
        x = s['x'][k].double().numpy()
        given = PoseTarget(s['target_position'][k].double().numpy(),
                           s['target_attitude'][k].double().numpy(), 0.0)
        trimming = Trimming()
        for step in range(steps + 1):
            trimming.target(State(0.01 * step, x[:3], x[model.VELOCITY], x[model.QUATERNION],
                                  x[model.RATE], x[model.TILT], x[model.TILT_RATE], 0.0), given)
        expected = s['trimmed'][k, 0].item() * np.array(trimming.position + trimming.rotation)
        np.testing.assert_allclose(s['trim'][k], expected, atol=2e-4)
    assert (s['trim'].norm(dim=-1) > 0.05).sum() > env.num_envs / 5


def test_the_actor_observes_the_target_that_the_trimming_shifts():
    env = quiet({})
    s = scattered(env)
    trim = torch.linspace(-0.05, 0.05, 6).expand(env.num_envs, -1).contiguous()
    s['trim'] = trim
    shifted, _ = env._observe(s, draw(env))
    turn = batch.from_rotation_vector(trim[:, 3:])
    s['target_attitude'] = batch.product(s['target_attitude'], turn)
    s['target_position'] = s['target_position'] + trim[:, :3]
    s['trim'] = torch.zeros_like(trim)
    given, _ = env._observe(s, draw(env))
    torch.testing.assert_close(shifted, given)
