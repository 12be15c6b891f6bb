"""The training loop: schedule, rows, checkpoints, resume, stop conditions."""

from dataclasses import replace

from learning import ROBOT, small
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
import torch

from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.train import rewards
from beetle_omni_ros.train.runner import Runner


def runner(folder=None, robot=ROBOT, **changes):
    return Runner(small(changes), robot, folder)


def parameters_of(made):
    return {name: value.clone() for model in (made.alg.actor, made.alg.critic)
            for name, value in model.state_dict(prefix=type(model).__name__ + '.').items()}


def assert_same_state(one, other):
    """Assert equal weights, optimiser state and counters."""
    for name, value in parameters_of(one).items():
        torch.testing.assert_close(value, parameters_of(other)[name], rtol=0, atol=0)
    ours, theirs = one.alg.optimizer.state_dict(), other.alg.optimizer.state_dict()
    assert ours['state'].keys() == theirs['state'].keys() and ours['state']
    for key, entries in ours['state'].items():
        for name, value in entries.items():
            torch.testing.assert_close(value, theirs['state'][key][name], rtol=0, atol=0)
    assert float(one.alg.rate) == float(other.alg.rate)
    assert ours['param_groups'][0]['lr'] == pytest.approx(theirs['param_groups'][0]['lr'])


def test_the_schedule_is_linear_between_its_ends():
    made = runner(**{'schedule.begin': 0.25, 'schedule.end': 0.75, 'schedule.kl': [0.01, 0.005],
                     'schedule.entropy': [4e-4, 0.0], 'schedule.tilt_std_limit': [0.8, 0.2],
                     'schedule.thrust_std_limit': [3.0, 1.0], 'schedule.severity': [0.0, 1.0],
                     'schedule.smooth': [0.1, 1.0], 'schedule.near': [0.5, 1.0],
                     'schedule.sinking': [0.1, 1.0]})
    reward = made.parameters.reward
    for part, knobs, severity, smooth, near in (
            (0.1, [0.01, 4e-4, 1.0, 0.8, 3.0], 0.0, 0.1, 0.5),
            (0.5, [0.0075, 2e-4, 0.5, 0.5, 2.0], 0.5, 0.55, 0.75),
            (1.0, [0.005, 0.0, 0.0, 0.2, 1.0], 1.0, 1.0, 1.0)):
        made.apply_schedule(part)
        np.testing.assert_allclose(made.alg.scheduled, knobs, rtol=1e-6)
        assert float(made.env._starts.severity) == pytest.approx(severity)
        weights = dict(zip(rewards.TERMS, made.env.weights.tolist()))
        for name, factor in (('hover_tilt_rate', smooth), ('sinking', smooth),
                             ('near_pose', near), ('position', 1.0)):
            assert weights[name] == pytest.approx(
                factor * getattr(reward, name) * reward.scale, rel=1e-5), name


def test_rows_and_checkpoints_appear_at_their_intervals_with_finite_numbers(tmp_path):
    rows = []
    runner(tmp_path, iterations=5, log_every=2, save_every=3).train(rows.append)
    assert {path.name for path in tmp_path.glob('model_*')} == {'model_3.pt', 'model_5.pt'}
    assert [row['iteration'] for row in rows] == [2, 4, 5]
    for row in rows:
        assert all(np.isfinite(value) for value in row.values())
        assert {'reward', 'success_rate', 'value_loss', 'learning_rate'} <= set(row)
        assert {f'reward/{name}' for name in rewards.TERMS} <= set(row)
    assert rows[0]['steps'] == 2 * 16 * 6
    events = EventAccumulator(str(tmp_path)).Reload()
    assert {'train/reward', 'reward/position'} <= set(events.Tags()['scalars'])
    assert [(event.step, event.value) for event in events.Scalars('train/value_loss')] == [
        (row['iteration'], pytest.approx(row['value_loss'])) for row in rows]


def test_the_same_seed_trains_the_same_network():
    trained = []
    for seed in (3, 3, 4):
        made = runner(seed=seed, iterations=2)
        made.train()
        trained.append(parameters_of(made))
    first, second, other = trained
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_a_resumed_training_has_the_state_of_the_interrupted_one(tmp_path):
    made = runner(tmp_path, iterations=4)
    calls = []

    def interrupt():
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return collect()

    collect, made.alg.collect = made.alg.collect, interrupt
    with pytest.raises(KeyboardInterrupt):
        made.train()
    path = made.checkpoint()
    assert path.name == 'model_2.pt'
    other = runner(tmp_path, iterations=4, seed=9)
    other.resume(path)
    assert other.iteration == 2
    assert other.trained_seconds == made.trained_seconds > 0
    assert_same_state(made, other)
    rows = []
    other.train(rows.append)
    assert [row['iteration'] for row in rows] == [3, 4]
    assert other.trained_seconds > made.trained_seconds


def test_a_checkpoint_of_a_captured_training_continues_without_capture(tmp_path):
    made = runner(tmp_path, iterations=1)
    made.train()
    path = tmp_path / 'model_1.pt'
    saved = torch.load(path)
    for group in saved['optimizer_state_dict']['param_groups']:
        # as in the optimiser with CUDA graphs
        group.update(capturable=True, fused=True, lr=torch.tensor(float(group['lr'])))
    torch.save(saved, path)
    other = runner(iterations=2)
    other.resume(path)
    other.train()
    assert other.iteration == 2
    group = other.alg.optimizer.param_groups[0]
    assert isinstance(group['lr'], float) and not group['capturable'] and not group['fused']


@pytest.mark.parametrize('how', ['truncated', 'another file of torch', 'another network'])
def test_an_unusable_checkpoint_is_refused_in_one_line(tmp_path, how):
    changes = {'network.hidden': [24, 16]} if how == 'another network' else {}
    path = runner(tmp_path, **changes).checkpoint()
    if how == 'truncated':
        path.write_bytes(path.read_bytes()[:9999])
    elif how == 'another file of torch':
        torch.save({'weights': torch.zeros(3)}, path)
    with pytest.raises(ParameterError) as raised:
        runner().resume(path)
    assert str(raised.value).startswith(f'{path}: no checkpoint that fits')
    assert '\n' not in str(raised.value)


def test_a_checkpoint_of_another_robot_is_refused(tmp_path):
    path = runner(tmp_path, robot=replace(ROBOT, mass=3.2)).checkpoint()
    with pytest.raises(ParameterError, match='another robot .* --robot'):
        runner().resume(path)


def test_a_loss_that_is_not_finite_stops_the_training_before_it_is_saved(tmp_path):
    made = runner(tmp_path, iterations=2000, log_every=1000, save_every=3)
    learn = made.alg.learn_batch

    def poisoned():
        learn()
        if made.iteration == 4:
            made.alg.losses.fill_(torch.nan)
            made.alg.learn_batch = lambda: None

    made.alg.learn_batch = poisoned
    with pytest.raises(RunError, match=r'iteration \d: the loss is not finite'):
        made.train()
    assert {path.name for path in tmp_path.glob('model_*')} == {'model_3.pt'}
