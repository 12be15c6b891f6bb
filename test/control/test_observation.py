"""The observation against an independent formula, and its invariances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import Reference, State
from beetle_omni_ros.control.observation import blocks, observation, size


def drawn(seed):
    """Random state, reference, previous action and disturbance (10,)."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(2, random_state=seed).as_quat()
    state = State(0.0, rng.normal(size=3), rng.normal(size=3), turns[0], rng.normal(size=3),
                  rng.normal(size=4), rng.normal(size=4), 0.0)
    reference = Reference(rng.normal(size=3), turns[1], rng.normal(size=3), rng.normal(size=3))
    return state, reference, rng.normal(size=8).tolist(), rng.normal(size=10)


def named(values, memory=True):
    """Block name -> numbers."""
    table = blocks(memory)
    assert len(values) == size(table)
    ends = np.cumsum([block.size for block in table])
    return {block.name: values[end - block.size:end] for block, end in zip(table, ends)}


@pytest.mark.parametrize('seed', range(20))
def test_each_block_contains_the_quantity_of_its_name(seed):
    state, reference, previous, disturbance = drawn(seed)
    seen = named(observation(state, reference, previous, disturbance))
    body, goal = Rotation.from_quat(state.quaternion), Rotation.from_quat(reference.quaternion)
    to_body = body.inv()
    expected = {
        'velocity': to_body.apply(state.velocity - reference.velocity),
        'angular_velocity': state.angular_velocity
        - to_body.apply(goal.apply(reference.angular_velocity)),
        'target_position': to_body.apply(reference.position - state.position),
        'attitude': np.r_[body.apply([1, 0, 0]), body.apply([0, 0, 1])],
        'target_attitude': np.r_[goal.apply([1, 0, 0]), goal.apply([0, 0, 1])],
        'tilt': state.tilt, 'previous_action': previous,
        'disturbance_force': to_body.apply(disturbance[:3]),
        'disturbance_torque': disturbance[3:6]}
    assert set(seen) == set(expected)
    for name, values in expected.items():
        assert np.allclose(seen[name], values, atol=1e-12), name


def test_observation_sizes_with_and_without_memory():
    state, reference, previous, disturbance = drawn(0)
    assert observation(state, reference, previous).shape == (33,)
    assert observation(state, reference, previous, disturbance).shape == (39,)


@pytest.mark.parametrize('seed', range(5))
def test_the_sign_of_a_quaternion_changes_nothing(seed):
    state, reference, previous, disturbance = drawn(seed)
    mirrored = State(*(-value if name == 'quaternion' else value
                       for name, value in vars(state).items()))
    opposite = Reference(reference.position, -reference.quaternion, reference.velocity,
                         reference.angular_velocity)
    assert np.array_equal(observation(state, reference, previous, disturbance),
                          observation(mirrored, opposite, previous, disturbance))


def moved(turn, shift, state, reference, disturbance):
    """The same flight with a turned and shifted world frame."""
    def turned(quaternion):
        return (turn * Rotation.from_quat(quaternion)).as_quat()
    return (State(0.0, turn.apply(state.position) + shift, turn.apply(state.velocity),
                  turned(state.quaternion), state.angular_velocity, state.tilt,
                  state.tilt_velocity, 0.0),
            Reference(turn.apply(reference.position) + shift, turned(reference.quaternion),
                      turn.apply(reference.velocity), reference.angular_velocity),
            np.r_[turn.apply(disturbance[:3]), disturbance[3:]])


@pytest.mark.parametrize('seed', range(5))
def test_position_and_heading_of_the_world_frame_affect_attitude_entries_only(seed):
    state, reference, previous, disturbance = drawn(seed)
    turn = Rotation.random(random_state=100 + seed)
    here = named(observation(state, reference, previous, disturbance))
    there_state, there_reference, there_disturbance = moved(
        turn, np.array([3.0, -2.0, 1.0]), state, reference, disturbance)
    there = named(observation(there_state, there_reference, previous, there_disturbance))
    for name, values in here.items():
        if 'attitude' not in name:
            assert np.allclose(there[name], values, atol=1e-12), name
        else:
            assert np.allclose(there[name], turn.apply(values.reshape(2, 3)).ravel(), atol=1e-12)


@pytest.mark.parametrize('seed', range(5))
def test_heading_does_not_change_the_vertical_components_of_axes(seed):
    state, reference, previous, disturbance = drawn(seed)
    turn = Rotation.from_rotvec([0, 0, 1.7])
    here = named(observation(state, reference, previous, disturbance))
    there_state, there_reference, there_disturbance = moved(turn, np.zeros(3), state, reference,
                                                            disturbance)
    there = named(observation(there_state, there_reference, previous, there_disturbance))
    for name in ('attitude', 'target_attitude'):
        assert np.allclose(there[name][[2, 5]], here[name][[2, 5]], atol=1e-12)


def test_perfect_tracking_gives_zero_error_entries():
    state, reference, previous, _ = drawn(3)
    reference = Reference(state.position, state.quaternion, state.velocity,
                          state.angular_velocity)
    seen = named(observation(state, reference, previous), memory=False)
    for name in ('velocity', 'angular_velocity', 'target_position'):
        assert np.allclose(seen[name], 0, atol=1e-12)
    assert np.allclose(seen['attitude'], seen['target_attitude'], atol=1e-12)
