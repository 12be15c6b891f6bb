"""The captured arithmetic of PPO agrees with rsl-rl and with textbooks."""

from learning import ROBOT, small
import numpy as np
import pytest
from rsl_rl.algorithms import PPO
import torch
from torch.distributions import kl_divergence, Normal

from beetle_omni_ros.train.network import BoundedGaussian
from beetle_omni_ros.train.ppo import log_probability
from beetle_omni_ros.train.runner import Runner


def runner(seed=0, **changes):
    """A small training, its schedule at the beginning."""
    made = Runner(small({**{'seed': seed}, **changes}), ROBOT)
    made.apply_schedule(0.0)
    return made


def randomised(made, seed=0):
    """Give the last layers weights, so that actions depend on observations."""
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for model in (made.alg.actor, made.alg.critic):
            weight = model.mlp[-1].weight
            weight.copy_(0.2 * torch.randn(weight.shape, generator=g))
    return made


def rollout_of_rsl_rl(made):
    """Collect samples like OnPolicyRunner.learn."""
    alg, observations = made.alg, made.env.get_observations()
    with torch.inference_mode():
        for _ in range(made.parameters.ppo.steps):
            observations, rewards, dones, extras = made.env.step(alg.act(observations.clone()))
            alg.process_env_step(observations, rewards, dones, extras)
        alg.compute_returns(observations)
    return alg.storage


def test_the_rollout_equals_that_of_rsl_rl():
    rollouts = []
    for collect in (lambda made: made.alg.collect(), rollout_of_rsl_rl):
        made = randomised(runner(**{'ppo.steps': 12}))
        made.env.state['age'][::3] = made.env.max_episode_length - 4     # ends on the way
        made.env.state['x'][1, 3:6] = 100.0
        torch.manual_seed(5)
        collect(made)
        rollouts.append(made.alg.storage)
    ours, theirs = rollouts
    assert ours.dones.sum() > 3
    for name in ('actions', 'rewards', 'values', 'actions_log_prob', 'returns', 'advantages'):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), atol=2e-5,
                                   rtol=1e-4, msg=lambda text, name=name: f'{name}: {text}')
    assert torch.equal(ours.dones, theirs.dones)
    for group in ('actor', 'critic'):
        torch.testing.assert_close(ours.observations[group], theirs.observations[group],
                                   atol=1e-5, rtol=1e-5)
    for a, b in zip(ours.distribution_params, theirs.distribution_params):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def test_advantages_are_generalised_advantage_estimates():
    made = runner()
    s, g = made.alg.storage, torch.Generator().manual_seed(1)
    steps, robots = s.rewards.shape[:2]
    s.rewards.copy_(torch.randn(s.rewards.shape, generator=g))
    s.values.copy_(torch.randn(s.values.shape, generator=g))
    s.dones.copy_(torch.rand(s.dones.shape, generator=g) < 0.3)
    last = torch.randn(robots, 1, generator=g)
    made.alg._returns(last)
    discount, trace = made.parameters.ppo.discount, made.parameters.ppo.trace
    expected = np.zeros((steps, robots))
    for robot in range(robots):
        for begin in range(steps):      # the sum of discounted errors, written out
            factor = 1.0
            for t in range(begin, steps):
                done = bool(s.dones[t, robot, 0])
                after = 0.0 if done else float(
                    last[robot, 0] if t + 1 == steps else s.values[t + 1, robot, 0])
                expected[begin, robot] += factor * (
                    float(s.rewards[t, robot, 0]) + discount * after
                    - float(s.values[t, robot, 0]))
                if done:
                    break
                factor *= discount * trace
    np.testing.assert_allclose((s.returns - s.values)[..., 0], expected, atol=1e-5)
    normal = (expected - expected.mean()) / expected.std(ddof=1)
    np.testing.assert_allclose(s.advantages[..., 0], normal, atol=1e-4)


def test_densities_entropy_and_divergence_are_those_of_torch():
    made = randomised(runner())
    made.alg.collect()
    s, alg = made.alg.storage, made.alg
    actions, mean = s.actions.flatten(0, 1), s.distribution_params[0].flatten(0, 1)
    old = alg.std.clone()
    expected = Normal(mean, old).log_prob(actions).sum(-1)
    torch.testing.assert_close(log_probability(actions, mean, old), expected)
    torch.testing.assert_close(s.actions_log_prob.flatten(), expected)
    with torch.no_grad():
        alg.actor.distribution.log_std_param.add_(0.1 * torch.arange(8.0) - 0.3)
        alg.actor.mlp[-1].bias.add_(0.05)
    columns = [s.observations['actor'], s.observations['critic'], s.actions,
               s.distribution_params[0], s.actions_log_prob, s.advantages, s.returns]
    loss, parts = alg._losses(*(column.flatten(0, 1) for column in columns), old)
    new_mean = alg.actor.mean(s.observations['actor'].flatten(0, 1))
    new = Normal(new_mean, alg.std)
    torch.testing.assert_close(parts[2], new.entropy().sum(-1).mean())
    divergence = kl_divergence(Normal(mean, old), new).sum(-1).mean()
    torch.testing.assert_close(parts[3], divergence.detach())
    assert float(parts[3]) > 0.05
    torch.testing.assert_close(loss.detach(), parts[1] + alg.value_loss_coef * parts[0]
                               - alg.scheduled[1] * parts[2])


@pytest.mark.parametrize('schedule', ['adaptive', 'fixed'])
def test_one_update_equals_that_of_rsl_rl(schedule, monkeypatch):
    results = []
    for own in (False, True):
        made = randomised(runner(**{
            'ppo.epochs': 3, 'ppo.minibatches': 4, 'ppo.steps': 8,
            'ppo.learning_rate_limits': [1e-5, 1e-2], 'schedule.entropy': [5e-3, 0.0]}))
        alg = made.alg
        if schedule == 'fixed':
            alg.schedule = 'fixed'
            monkeypatch.setattr(type(alg), '_adapt', lambda self, divergence: None)
        alg.collect()
        alg.scheduled[2:] = 100.0       # no bound, which rsl-rl lacks
        torch.manual_seed(7)
        if own:
            losses = PPO.update(alg)
            found = [losses['value'], losses['surrogate'], losses['entropy']]
            rate = alg.learning_rate
        else:
            alg.desired_kl, alg.entropy_coef = alg.scheduled[:2].tolist()
            alg.learn_batch()
            found, rate = alg.losses[:3].tolist(), alg.optimizer.param_groups[0]['lr']
        results.append((found, rate, [p.detach().clone() for p in (
            *alg.actor.parameters(), *alg.critic.parameters())]))
    (ours, our_rate, our_weights), (theirs, their_rate, their_weights) = results
    assert ours == pytest.approx(theirs, rel=1e-4, abs=1e-6)
    assert our_rate == pytest.approx(their_rate, rel=1e-6)
    if schedule == 'adaptive':
        assert our_rate != small().ppo.learning_rate
    for a, b in zip(our_weights, their_weights):
        torch.testing.assert_close(a, b, atol=2e-5, rtol=1e-3)


def test_rsl_rls_update_is_used_with_the_knobs():
    made = randomised(runner(**{'schedule.tilt_std_limit': [0.3, 0.1]}))
    made.alg.collect()
    made.alg.scheduled[:2] = torch.tensor([0.02, 0.003])
    made.alg.update()
    assert (made.alg.desired_kl, made.alg.entropy_coef) == pytest.approx((0.02, 0.003))
    assert (made.alg.std[:4] <= 0.3 + 1e-6).all()
    assert float(made.alg.rate) == pytest.approx(made.alg.optimizer.param_groups[0]['lr'])
    assert torch.isfinite(made.alg.losses).all() and made.alg.losses[0] > 0


def test_the_learning_rate_follows_the_divergence_within_its_limits():
    alg = runner(**{'ppo.learning_rate_limits': [1e-4, 2e-3]}).alg
    desired = float(alg.scheduled[0])
    for divergence, factor in ((3 * desired, 1 / 1.5), (desired, 1.0), (0.3 * desired, 1.5),
                               (0.0, 1.0)):
        alg.set_rate(1e-3)
        alg._adapt(torch.tensor(divergence))
        assert alg.optimizer.param_groups[0]['lr'] == pytest.approx(factor * 1e-3)
    for divergence, limit in ((1e3, 1e-4), (1e-9, 2e-3)):
        for _ in range(20):
            alg._adapt(torch.tensor(divergence))
        assert float(alg.rate) == pytest.approx(limit)


def test_gradients_are_clipped_for_actor_and_critic_apart(monkeypatch):
    made = randomised(runner(**{'ppo.gradient_norm': 1e-3}))
    made.alg.collect()
    norms = []
    monkeypatch.setattr(made.alg.optimizer, 'step', lambda: norms.append([
        torch.stack([p.grad.norm() for p in model.parameters()]).norm()
        for model in (made.alg.actor, made.alg.critic)]))
    made.alg.learn_batch()
    assert norms and np.max(norms) <= 1e-3 * (1 + 1e-4) and np.max(norms) > 0.9e-3


def test_the_standard_deviations_have_an_upper_bound_only():
    gaussian = BoundedGaussian(8, [0.5] * 4 + [2.0] * 4)
    np.testing.assert_allclose(torch.exp(gaussian.log_std_param.detach()), [0.5] * 4 + [2.0] * 4,
                               rtol=1e-6)
    gaussian.bound(torch.tensor([0.3] * 4 + [3.0] * 4))
    np.testing.assert_allclose(torch.exp(gaussian.log_std_param.detach()), [0.3] * 4 + [2.0] * 4,
                               rtol=1e-6)
    assert gaussian.log_std_param.requires_grad


def test_repeated_updates_fit_the_same_batch():
    made = runner(**{'ppo.robots': 64, 'ppo.steps': 16, 'ppo.epochs': 4, 'network.hidden': [32]})
    made.alg.collect()
    losses = []
    for _ in range(15):
        made.alg.learn_batch()
        losses.append(made.alg.losses.clone())
    assert losses[-1][0] < 0.5 * losses[0][0]     # the critic converges to the returns
    assert losses[-1][1] < losses[0][1]           # the actor prefers actions with larger returns
