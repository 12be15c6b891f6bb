"""Missed situations are stored, repeated unchanged, and dropped when reached."""

from learning import only, quiet
import pytest
import torch

from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.train import batch
from beetle_omni_ros.train.starts import Replays

COUNT = 8


def states(seed=0, count=COUNT):
    g = torch.Generator().manual_seed(seed)
    return {'x': torch.randn(count, 3, generator=g), 'age': torch.rand(count, generator=g),
            'past': torch.randn(count, 2, 2, generator=g),
            'target_left': torch.rand(count, generator=g)}


def flags(**rows):
    """Ends of a step: name -> rows in which they hold."""
    result = {name: torch.zeros(COUNT, dtype=torch.bool) for name in ('due', 'done', 'missed')}
    for name, places in rows.items():
        result[name][places] = True
    return result


def step(replays, s, new, fresh, ends, numbers=None):
    numbers, after = torch.full((COUNT, 3), 0.5) if numbers is None else numbers, dict(new)
    replays.step(s, after, fresh, ends, batch.Draw(numbers))
    return after


def store():
    """A store of which row 2 holds a situation, and that situation."""
    first = states()
    replays = Replays(first, 1.0, 800)
    s = step(replays, first, states(1), states(2), flags(due=[2, 3], missed=[2]))
    return replays, s, first


def test_samples_cover_the_stored_situations_only():
    replays, s, _ = store()
    s['filled'] = torch.tensor([0.0, 1, 0, 0, 1, 1, 0, 0])
    numbers = torch.full((COUNT, 3), 0.0)
    numbers[:, 1] = torch.arange(COUNT) / COUNT
    after = step(replays, s, states(3), states(4), flags(done=list(range(COUNT))), numbers)
    assert after['source'].tolist() == [1, 1, 1, 4, 4, 4, 5, 5]


@pytest.mark.parametrize(('missed', 'chance', 'left'), [
    (False, 0.45, 0), (False, 0.55, 1), (True, 0.05, 0), (True, 0.15, 1)])
def test_reached_situations_are_dropped_before_missed_ones(missed, chance, left):
    replays, s, first = store()
    s = step(replays, s, states(3), states(4), flags(done=[0]))
    numbers = torch.full((COUNT, 3), chance)
    ends = flags(due=[0], missed=[0] if missed else [])
    after = step(replays, s, states(5), states(6), ends, numbers)
    assert after['filled'][2] == left
    # a replay is not stored a second time
    assert after['filled'][0] == 0 and after['source'][0] == -1


def test_the_environment_replays_missed_situations():
    env = quiet({**only('hover'), 'episode.replay_share': 0.9, 'episode.hold_targets': 0.0,
                 'episode.target_time': [1.0, 1.0], 'episode.duration': 2.0,
                 'episode.rate_limit': 200.0, 'episode.velocity_limit': 100.0,
                 'episode.position_limit': 100.0}, robots=16)
    initial = {name: value.clone() for name, value in env.state.items()}
    still = torch.zeros(16, 8)
    for _ in range(99):
        env.advance(still)
        assert not env.state['filled'].any()
    env.advance(still)
    missed = env.state['filled'] > 0
    assert missed.any()
    kept = env._replays.unpacked(env.state['stored'])
    for name in ('x', 'target_attitude', 'body', 'delays', 'bias'):
        torch.testing.assert_close(kept[name][missed], initial[name][missed])
    while not (env.state['source'] >= 0).any():
        assert env.state['age'].max() < 199.5
        kept = env._replays.unpacked(env.state['stored'].clone())
        env.advance(still)
    again = env.state['source'] >= 0
    place = env.state['source'][again].long()
    for name in ('x', 'target_position', 'target_attitude', 'body', 'delays', 'bias'):
        torch.testing.assert_close(env.state[name][again], kept[name][place])
    assert (env.state['target_left'][again] == 100).all()


def test_disturbed_robots_are_not_stored():
    env = quiet({**only('hover'), 'episode.target_time': [1.0, 1.0]}, robots=16)
    env.state['target_left'].fill_(1.0)
    env.state['x'][:, model.POSITION] += 1.0
    env.state['disturbed'][:7] = 1.0
    env.advance(torch.zeros(16, 8))
    assert env.state['filled'].tolist() == [0.0] * 7 + [1.0] * 9


def test_a_large_loss_of_height_counts_as_missed():
    env = quiet({**only('hold'), 'episode.target_time': [1.0, 1.0]}, robots=4)
    env.state['target_position'].copy_(env.state['x'][:, model.POSITION])
    env.state['deepest'][1] = 0.5
    env.state['target_left'].fill_(1.0)
    env.advance((env.state['previous'] - env.offset) / env.scale)
    assert env.state['filled'].tolist() == [0, 1, 0, 0]
    assert not env.state['deepest'].any()
