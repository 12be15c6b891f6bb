"""The captured arithmetic of PPO agrees with rsl-rl and with textbooks."""

from learning import ROBOT, small
import pytest
from rsl_rl.algorithms import PPO
import torch

from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.train.network import actor_of, export_policy
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
    alg, env = made.alg, made.env
    observations = env.get_observations()
    with torch.inference_mode():
        for _ in range(made.parameters.ppo.steps):
            env.advance(alg.act(observations.clone()))
            observations = env.get_observations()
            alg.process_env_step(observations, env.reward, env.done,
                                 {'time_outs': env.timeout.float()})
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


def test_one_update_equals_that_of_rsl_rl():
    results = []
    for own in (False, True):
        made = randomised(runner(**{
            'ppo.epochs': 3, 'ppo.minibatches': 4, 'ppo.steps': 8,
            'ppo.learning_rate_limits': [1e-5, 1e-2], 'schedule.entropy': [5e-3, 0.0]}))
        alg = made.alg
        alg.collect()
        alg.scheduled[2:] = 100.0       # no bound, which rsl-rl lacks
        torch.manual_seed(7)
        if own:
            alg.desired_kl, alg.entropy_coef = alg.scheduled[:2].tolist()
            losses = PPO.update(alg)
            found = [losses['value'], losses['surrogate'], losses['entropy']]
            rate = alg.learning_rate
        else:
            alg.learn_batch()
            found, rate = alg.losses[:3].tolist(), alg.optimizer.param_groups[0]['lr']
        results.append((found, rate, [p.detach().clone() for p in (
            *alg.actor.parameters(), *alg.critic.parameters())]))
    (ours, our_rate, our_weights), (theirs, their_rate, their_weights) = results
    assert ours == pytest.approx(theirs, rel=1e-4, abs=1e-6)
    assert our_rate == pytest.approx(their_rate, rel=1e-6)
    assert our_rate != small().ppo.learning_rate
    for a, b in zip(our_weights, their_weights):
        torch.testing.assert_close(a, b, atol=2e-5, rtol=1e-3)


def test_the_learning_rate_keeps_its_limits():
    alg = runner(**{'ppo.learning_rate_limits': [1e-4, 2e-3]}).alg
    for divergence, limit in ((1e3, 1e-4), (1e-9, 2e-3)):
        for _ in range(20):
            alg._adapt(torch.tensor(divergence))
        assert float(alg.rate) == pytest.approx(limit)


def test_a_smaller_student_approaches_its_teacher(tmp_path):
    teacher = randomised(Runner(small({'network.hidden': [24, 20]}), ROBOT, tmp_path), seed=3)
    student = Runner(small({'network.hidden': [32]}), ROBOT, teacher=teacher.checkpoint()).alg
    student.collect()
    student.scheduled.copy_(torch.tensor([1e3, 0.0, 1.0, 9.0, 9.0]))
    student.storage.advantages.zero_()      # nothing else is to be learnt
    seen = student.storage.observations['actor'].flatten(0, 1)

    @torch.no_grad()
    def apart():
        return float((student.actor.mean(seen) - teacher.alg.actor.mean(seen)).norm())

    before = apart()
    for _ in range(40):
        student.learn_batch()
    assert apart() < 0.5 * before


def test_a_policy_file_teaches_what_its_checkpoint_does(tmp_path):
    teacher = randomised(Runner(small({'network.hidden': [24, 20]}), ROBOT, tmp_path), seed=3)
    actor, policy = teacher.alg.actor, tmp_path / 'policy.onnx'
    with torch.no_grad():       # the exporter leaves out what is zero
        actor.mlp[-1].bias.fill_(0.1)
    export_policy(actor, policy, ROBOT, teacher.parameters, {})
    seen = torch.randn(50, 33, generator=torch.Generator().manual_seed(1))
    for path in (teacher.checkpoint(), policy):
        read = actor_of(path, Runner(small(), ROBOT).alg.actor)
        torch.testing.assert_close(read.mean(seen), actor.mean(seen), rtol=1e-5, atol=1e-5)


def test_a_student_of_the_same_size_begins_with_its_teacher(tmp_path):
    teacher = randomised(Runner(small(), ROBOT, tmp_path), seed=3)
    student = Runner(small({'seed': 5}), ROBOT, teacher=teacher.checkpoint()).alg.actor
    seen = torch.randn(50, 33, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(student.mean(seen), teacher.alg.actor.mean(seen))


def test_a_teacher_with_other_inputs_is_refused(tmp_path):
    teacher = Runner(small({'memory': True}), ROBOT, tmp_path).checkpoint()
    with pytest.raises(ParameterError, match='no checkpoint or policy with the same inputs'):
        Runner(small(), ROBOT, teacher=teacher)
