"""A step: commands and their delays, targets, ends, resets, disturbances."""

from dataclasses import replace

from learning import environment, only, quiet, ROBOT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import torch

from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.sim.parameters import SimulatorParameters
from beetle_omni_ros.sim.simulator import Battery
from beetle_omni_ros.train import rewards
from beetle_omni_ros.train.environment import FORCE_BANDWIDTH, TORQUE_BANDWIDTH
from beetle_omni_ros.train.model import nominal_body, Physics
from beetle_omni_ros.train.parameters import TrainParameters

PERIOD = 0.01


def actions(env, seed, count, size=1.0):
    g = torch.Generator().manual_seed(seed)
    return [size * torch.randn(env.num_envs, 8, generator=g) for _ in range(count)]


def command(env, action):
    return torch.clamp(env.offset + env.scale * action, env._low, env._high)


def held(env, command):
    """State one period later with one command throughout."""
    physics = Physics(env.robot, PERIOD, 4, 'cpu')
    s = env.state
    return physics.advance(s['x'], (command,) * 3, s['delays'][:, :2], s['wrench'], s['body'])


# ---- commands

@pytest.mark.parametrize(('delay', 'late'), [(0.0, 0), (0.02, 2)])
def test_a_command_acts_after_its_delay(delay, late):
    env = quiet({**only('hover'), 'random.command_latency': [delay, delay]})
    given = [env.state['previous'].clone()] * 2
    for action in actions(env, 0, 5):
        given.append(command(env, action))
        expected = held(env, given[-1 - late])
        env.advance(action)
        assert not env.done.any()
        torch.testing.assert_close(env.state['x'], expected)
        wrong = held(env, given[-1 if late else -2])
        assert (wrong[:, model.THRUST] - env.state['x'][:, model.THRUST]).abs().max() > 1e-3


def test_a_delay_of_half_a_period_splits_it():
    env = quiet({**only('hover'), 'random.command_latency': [0.005, 0.005]})
    first, (action,) = env.state['previous'].clone(), actions(env, 1, 1)
    half = Physics(ROBOT, PERIOD / 2, 2, 'cpu')
    s, now = env.state, command(env, action)
    rest = torch.zeros(env.num_envs, 2), s['wrench'], s['body']
    expected = half.advance(half.advance(s['x'], (first,) * 3, *rest), (now,) * 3, *rest)
    env.advance(action)
    torch.testing.assert_close(env.state['x'], expected)


def test_the_thrust_limit_acts_but_is_not_observed():
    env = quiet({**only('hover'), 'random.thrust_limit': [9.0, 9.0], 'random.thrust_sag': 0.0,
                 'random.command_latency': [0.0, 0.0]})
    action = torch.zeros(env.num_envs, 8)
    action[:, 4:] = 12.0
    asked = command(env, action)
    capped = asked.clone()
    capped[:, 4:] = 9.0
    expected = held(env, capped)
    env.advance(action)
    torch.testing.assert_close(env.state['x'], expected)
    torch.testing.assert_close(env.state['previous'], asked)
    torch.testing.assert_close(env.observation[:, 29:33], action[:, 4:])


@pytest.mark.parametrize('charge', [0.9, 0.35])
def test_the_pack_sags_under_load_as_in_the_simulator(charge):
    pack = Battery(replace(ROBOT, rotors=replace(ROBOT.rotors, thrust_max=40.0)),
                   SimulatorParameters.load())
    shipped = TrainParameters.load().random

    def limit(thrust):
        pack.charge = charge
        pack.step(np.full(4, thrust), 1e-6)
        return pack.thrust_limit

    assert shipped.thrust_limit[0] < limit(ROBOT.hover_thrust) < shipped.thrust_limit[1]
    env = quiet({**only('hover'), 'random.thrust_limit': [limit(ROBOT.hover_thrust)] * 2,
                 'random.thrust_sag': shipped.thrust_sag})
    for thrust in (9.0, 11.0, 13.0):
        env.state['x'][:, model.THRUST] = thrust
        np.testing.assert_allclose(env._thrust_limit(), limit(thrust), atol=0.6)
    env.state['x'][:, model.THRUST] = 1.0    # no more than in hover
    np.testing.assert_allclose(env._thrust_limit(), limit(ROBOT.hover_thrust), rtol=1e-6)


# ---- ends


def step_both(one, other, seed=3):
    action = actions(one, seed, 1)[0]
    for env in (one, other):
        torch.manual_seed(seed)
        env.advance(action)


@pytest.mark.parametrize(('first', 'value'), [(0, 30.0), (3, 20.0), (10, 60.0), (3, torch.nan)])
def test_only_a_robot_out_of_bounds_is_reset(first, value):
    one, other = quiet(), quiet()
    other.state['x'][:8, first:first + 3] = value
    other.state['age'].fill_(50.0)
    one.state['age'].fill_(50.0)
    step_both(one, other)
    assert other.done.tolist() == [True] * 8 + [False] * 56 and not one.done.any()
    assert not other.timeout.any()
    for key in one.state:
        torch.testing.assert_close(one.state[key][8:], other.state[key][8:], rtol=0, atol=0)
    torch.testing.assert_close(one.observation[8:], other.observation[8:], rtol=0, atol=0)
    assert not other.state['age'][:8].any() and (other.state['age'][8:] == 51).all()
    assert not other.state['x'][:8, :3].any()
    assert torch.isfinite(other.observation).all() and torch.isfinite(other.critic).all()
    assert torch.isfinite(other.reward).all()


def test_only_a_lost_robot_gets_the_termination_penalty():
    one, other = quiet(), quiet()
    cost = one.cfg.reward.termination * one.cfg.reward.scale
    other.state['age'][:16] = other.max_episode_length - 1
    other.state['x'][8:16, 3:6] = torch.nan
    step_both(one, other)
    assert other.timeout.tolist() == [True] * 8 + [False] * 56
    assert other.done.tolist() == [True] * 16 + [False] * 48
    torch.testing.assert_close(other.reward[8:16], torch.full((8,), cost))
    torch.testing.assert_close(other.reward[:8], one.reward[:8])
    assert not other.state['age'][:16].any()


def test_the_reward_is_the_weighted_sum_of_the_terms():
    env = quiet()
    before = {name: value.clone() for name, value in env.state.items()}
    action = actions(env, 4, 1)[0]
    asked = env.offset + env.scale * action
    x = env.physics.advance(before['x'], (command(env, action), before['previous'],
                                          before['older']), before['delays'][:, :2],
                            before['wrench'], before['body'])
    env.advance(action)
    assert not env.done.any()
    body = Rotation.from_quat(x[:, 6:10].numpy())
    goal = Rotation.from_quat(before['target_attitude'].numpy())
    made = {
        'position_error': (x[:, :3] - before['target_position']).norm(dim=-1),
        'attitude_error': torch.tensor((body.inv() * goal).magnitude(), dtype=torch.float32),
        'speed': x[:, 3:6].norm(dim=-1), 'rate': x[:, 10:13].norm(dim=-1), 'tilt': x[:, 13:17],
        'tilt_rate': x[:, 17:21], 'previous_tilt_rate': before['x'][:, 17:21],
        'thrust': x[:, 21:25], 'tilt_command': asked[:, :4], 'thrust_command': asked[:, 4:],
        'previous_tilt_command': before['previous'][:, :4],
        'previous_thrust_command': before['previous'][:, 4:],
        'z_axis': torch.tensor(body.as_matrix()[:, :, 2], dtype=torch.float32),
        'target_z_axis': torch.tensor(goal.as_matrix()[:, :, 2], dtype=torch.float32),
        'depth': (torch.minimum(before['x'][:, 2], before['target_position'][:, 2])
               - x[:, 2]).clamp(min=0),
        'tilt_limit': ROBOT.joints.position_limit, 'thrust_limit': ROBOT.rotors.thrust_max}
    expected = sum(getattr(env.cfg.reward, name) * term
                   for name, term in rewards.terms(**made).items()) * env.cfg.reward.scale
    torch.testing.assert_close(env.reward, expected, atol=1e-5, rtol=1e-4)


# ---- disturbances

DISTURBED = {'random.force_share': 1.0, 'random.strong_share': 1.0, 'random.payload_share': 1.0,
             'random.push_share': 1.0, 'random.push_period': 0.1}


@pytest.mark.parametrize('severity', [0.0, 1.0])
def test_pushes_change_velocities_by_their_severity(severity):
    env = quiet({**only('hover'), **DISTURBED, 'random.push_period': 0.1}, robots=400)
    env.severity.fill_(severity)
    (action,) = actions(env, 5, 1)
    expected = env.physics.advance(
        env.state['x'], (command(env, action), env.state['previous'], env.state['older']),
        env.state['delays'][:, :2], env.state['wrench'], env.state['body'])
    env.advance(action)
    going = ~env.done
    pushed = ((env.state['x'] - expected)[:, 3:6].abs().max(-1).values > 1e-5)[going]
    assert float(pushed.float().mean()) == pytest.approx(0.1 * severity, abs=0.05)
    assert bool(pushed.any()) == bool(severity)


def test_the_estimate_is_the_motion_that_the_nominal_robot_does_not_explain():
    env = quiet({**only('hold'), 'memory': True, 'random.command_latency': [0.0, 0.0], **{
        f'random.{name}': 0.3 for name in ('mass_scale', 'inertia_scale', 'arm_scale',
                                           'thrust_scale')},
        'random.weak_share': 0.5, 'random.force_share': 1.0}, robots=64,
        robot=replace(ROBOT, multibody=None))
    nominal = torch.tensor(nominal_body(ROBOT)).float().expand(env.num_envs, -1)
    given, s = env.state['previous'].clone(), env.state
    env.state['estimate'].zero_()
    alone = env.physics.advance(s['x'], (given,) * 3, s['delays'][:, :2], 0 * s['wrench'], nominal)
    env.advance((given - env.offset) / env.scale)
    unexplained = env.state['x'] - alone
    inertia = torch.tensor(ROBOT.inertia).float()
    expected = torch.cat((FORCE_BANDWIDTH * ROBOT.mass * unexplained[:, model.VELOCITY],
                          TORQUE_BANDWIDTH * inertia * unexplained[:, model.RATE]), -1)
    assert expected[:, :3].abs().max() > 0.1 and expected[:, 3:].abs().max() > 0.02
    torch.testing.assert_close(env.state['estimate'], expected, atol=2e-3, rtol=0.02)


def test_a_strong_force_comes_and_goes_with_the_targets():
    env = quiet({**only('hover'), 'random.strong_share': 0.5, 'random.force_share': 0.5,
                 'episode.target_time': [0.1, 0.1]}, robots=64)
    env.state['age'].zero_()
    with_it, without = env.state['wrench'].clone(), env.state['other_wrench'].clone()
    strong = (with_it != without).any(-1)
    assert 0 < int(strong.sum()) < env.num_envs
    for expected in (with_it, without, with_it):
        torch.testing.assert_close(env.state['wrench'], expected)
        while not (env.state['target_left'] <= 1).all():
            env.advance((env.state['previous'] - env.offset) / env.scale)
        env.advance((env.state['previous'] - env.offset) / env.scale)


# ---- all of it


def test_extreme_actions_never_give_nan():
    env = environment({'memory': True, **DISTURBED}, robots=256)
    for k, action in enumerate(actions(env, 7, 80, size=20.0)):
        env.advance(action)
        values = (*env.state.values(), env.observation, env.critic, env.reward)
        assert all(torch.isfinite(value).all() for value in values), f'step {k}'
    tally = env.read_tally()
    assert tally['steps'] == 80 * 256 and tally['deaths'] > 0
    assert all(np.isfinite(value) for value in tally.values())
    assert env.read_tally()['deaths'] == 0     # it is reset


def test_the_tally_counts_targets_and_reached_targets():
    env = quiet({**only('hold'), 'episode.target_time': [1.0, 1.0]}, robots=10)
    env.state['target_left'].fill_(1)
    env.state['target_position'].copy_(env.state['x'][:, :3])
    env.state['target_position'][:4, 0] += 0.5
    env.state['target_attitude'].copy_(env.state['x'][:, 6:10])
    env.state['age'].zero_()
    env.advance((env.state['previous'] - env.offset) / env.scale)
    tally = env.read_tally()
    assert tally['targets'] == 10 and tally['success_rate'] == pytest.approx(0.6)
    assert tally['position_error_m'] == pytest.approx(0.2, abs=0.01)
    assert tally['reward'] == pytest.approx(float(env.reward.mean()), rel=1e-4)
