"""Each reward term for prescribed states; the published ones against the paper's table."""

import learning  # noqa: F401
import numpy as np
import pytest
import torch

from beetle_omni_ros.train import rewards
from beetle_omni_ros.train.parameters import RewardWeights, TrainParameters

TILT_LIMIT, THRUST_LIMIT, HOVER = 3.96, 20.0, 7.2


def moment(**changes):
    """State of one level robot at rest at its target, as arrays."""
    four, up = np.zeros((1, 4)), np.array([[0.0, 0.0, 1.0]])
    values = {
        **dict.fromkeys(('position_error', 'attitude_error', 'speed', 'rate', 'depth'),
                        np.zeros(1)),
        **dict.fromkeys(('tilt', 'tilt_rate', 'previous_tilt_rate', 'tilt_command',
                         'previous_tilt_command'), four),
        **dict.fromkeys(('thrust', 'thrust_command', 'previous_thrust_command'), four + HOVER),
        'z_axis': up, 'target_z_axis': up,
        **{key: np.atleast_1d(np.asarray(value, dtype=float)) for key, value in changes.items()}}
    rows = max(len(value) for value in values.values())
    values = {key: torch.tensor(np.broadcast_to(value, (rows, *value.shape[1:])).copy())
              for key, value in values.items()}
    return {**values, 'tilt_limit': TILT_LIMIT, 'thrust_limit': THRUST_LIMIT}


def moments(count, seed):
    """Random states over the whole range, many of them close to the target."""
    rng = np.random.default_rng(seed)
    near = rng.choice([0.01, 0.05, 1.0], (count, 1))[:, 0]

    def axis():
        value = rng.normal(size=(count, 3))
        return value / np.linalg.norm(value, axis=1, keepdims=True)

    return moment(
        position_error=near * rng.uniform(0, 6, count), attitude_error=near * rng.uniform(
            0, np.pi, count), speed=near * rng.uniform(0, 6, count),
        rate=near * rng.uniform(0, 10, count), tilt=rng.uniform(-4, 4, (count, 4)),
        tilt_rate=rng.uniform(-10, 10, (count, 4)),
        previous_tilt_rate=rng.uniform(-10, 10, (count, 4)),
        thrust=rng.uniform(0, 20, (count, 4)), tilt_command=rng.uniform(-6, 6, (count, 4)),
        thrust_command=rng.uniform(-5, 25, (count, 4)),
        previous_tilt_command=rng.uniform(-4, 4, (count, 4)),
        previous_thrust_command=rng.uniform(0, 20, (count, 4)), z_axis=axis(),
        target_z_axis=axis(), depth=rng.uniform(0, 3, count))


def published(m):
    """The table of the publication, for one robot at a time; m: name -> numbers."""
    p, th, v, w = m['position_error'], m['attitude_error'], m['speed'], m['rate']
    q, f = m['tilt_command'], m['thrust_command']
    at_position = p < 0.02 and v < 0.02
    at_pose = at_position and th < 0.05 and w < 0.02
    exceeding = [max(x - THRUST_LIMIT, 0, -x) for x in f]
    return {
        'position': np.tanh(p / 0.6),
        'pose': (1 - np.tanh(th / 2)) * (1 - np.tanh(p / 2)),
        'reach_position': at_position and np.exp(-p / 0.02) + np.exp(-v / 0.02),
        'reach_pose': at_pose and np.exp(-p / 0.02) + np.exp(-v / 0.02)
        + np.exp(-2 * th / 0.05) + np.exp(-2 * w / 0.02),
        'linear_velocity': np.expm1(0.6 * min(v, 4.0)) ** 2,
        'angular_velocity': np.expm1(0.4 * min(w, 6.0)) ** 2,
        'joint_limit': sum((abs(x) - TILT_LIMIT) * (abs(x) > TILT_LIMIT) for x in q),
        'thrust_limit': sum(x ** 2 for x in exceeding),
        'joint_action_rate': sum((a - b) ** 2 for a, b in zip(q, m['previous_tilt_command'])),
        'thrust_action_rate': sum((a - b) ** 2 for a, b in zip(f, m['previous_thrust_command'])),
        'thrust_power': sum(x ** 2 for x in m['thrust']),
        'joint_acceleration': sum(
            (a - b) ** 2 for a, b in zip(m['tilt_rate'], m['previous_tilt_rate'])),
        'z_axis_align': np.linalg.norm(m['z_axis'] - m['target_z_axis']) > 1.5,
        'thrust_allocation': sum((x - sum(f) / 4) ** 2 for x in f) * m['z_axis'][2] ** 2,
    }


def test_the_published_terms_are_those_of_the_table():
    made = moments(400, 0)
    rows = [{key: value[k].numpy() for key, value in made.items()
             if torch.is_tensor(value)} for k in range(400)]
    expected, found = [published(row) for row in rows], rewards.terms(**made)
    for name in expected[0]:
        ours = found[name].double().numpy()
        theirs = np.array([float(row[name]) for row in expected])
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12, err_msg=name)
        assert theirs.any() or name == 'reach_pose', f'{name}: never anything but zero'


def test_at_rest_at_the_target_only_thrust_is_penalised():
    at_target = moment()
    costs = {name: float(term) for name, term in rewards.terms(**at_target).items()
             if getattr(RewardWeights(), name) < 0}
    assert costs.pop('thrust_power') == pytest.approx(4 * HOVER ** 2)
    assert set(costs.values()) == {0.0}


def test_at_rest_at_the_target_every_bonus_is_the_largest_and_falls_with_distance():
    best = {'pose': 1, 'reach_position': 2, 'reach_pose': 4, 'near_position': 1,
            'near_attitude': 1, 'near_pose': 1, 'exact_pose': 1}
    near, far = (rewards.terms(**moment(position_error=distance, attitude_error=distance))
                 for distance in (0.0, 0.015))
    assert {name: float(near[name]) for name in best} == best
    assert all(float(far[name]) < value for name, value in best.items())
    assert set(best) == {name for name in rewards.TERMS if getattr(RewardWeights(), name) > 0}


def test_command_changes_count_at_the_target_only():
    found = rewards.terms(**moment(position_error=[0.0, 1.0], tilt_command=np.full((2, 4), 0.1),
                                 thrust_command=np.full((2, 4), 9.0)))
    for name in ('hover_tilt_rate', 'hover_thrust_rate'):
        here, there = found[name]
        assert here > 0 and there < 1e-3 * here


def test_a_loss_of_height_costs_less_than_a_termination():
    p = TrainParameters.load()
    deepest = float(rewards.terms(**moment(depth=1e3))['sinking'])
    assert -p.reward.sinking * deepest / (1 - p.ppo.discount) < -p.reward.termination


def test_every_weight_has_a_term_and_every_term_a_weight():
    assert tuple(rewards.terms(**moment())) == rewards.TERMS
