"""A strong external force as a part of gravity."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_policy import drawn

import beetle_omni_ros
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import guidance_of
from beetle_omni_ros.control.gravity import ApparentGravity, LEAST_SCALE
from beetle_omni_ros.control.policy import observed
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT, WEIGHT = RobotParameters.load(), 30.0


def seen_up(gravity):
    """Rotation of the world, from what becomes of a level attitude."""
    state, reference, *_ = drawn()
    return Rotation.from_quat(gravity.seen(state, reference)[0].quaternion) \
        * Rotation.from_quat(state.quaternion).inv()


@pytest.mark.parametrize('seed', range(20))
def test_the_thrust_that_is_needed_points_up_in_the_turned_world(seed):
    force = Rotation.random(random_state=seed).apply([0, 0, 16 + 4 * seed])
    gravity, need = ApparentGravity(WEIGHT), [0, 0, WEIGHT] - force
    gravity.update(force)
    size = np.linalg.norm(need)
    assert np.allclose(seen_up(gravity).apply(need), [0, 0, size])
    assert gravity.scale == pytest.approx(np.clip(size / WEIGHT, LEAST_SCALE, 1))


def test_only_the_attitudes_of_an_observation_are_those_of_the_turned_world():
    state, reference, action, _ = drawn()
    gravity = ApparentGravity(WEIGHT)
    gravity.update(np.array([20.0, -10.0, 55.0]))
    here = np.array(observed(state, reference, action))
    there = np.array(observed(*gravity.seen(state, reference), action))
    attitude = np.zeros(33, dtype=bool)
    attitude[9:21] = True       # two columns of two attitudes
    assert np.allclose(here[~attitude], there[~attitude])
    assert np.allclose(seen_up(gravity).apply(here[attitude].reshape(4, 3)),
                       there[attitude].reshape(4, 3))


def test_a_rising_force_turns_the_world_over_once_and_a_falling_one_back():
    gravity, turns = ApparentGravity(WEIGHT), []
    noise = np.random.default_rng(0).normal(size=(400, 3)) * 0.3
    for size, own in zip(np.r_[np.linspace(0, 60, 200), np.linspace(60, 0, 200)], noise,
                         strict=True):
        gravity.update(np.array([0, 0, size]) + own)
        turns.append(seen_up(gravity).apply([0, 0, 1])[2] < 0)
    assert np.abs(np.diff(turns)).sum() == 2 and not turns[0] and not turns[-1]


def test_a_small_force_is_left_to_the_policy_and_the_share_of_a_larger_one_grows_from_zero():
    gravity, previous = ApparentGravity(WEIGHT), 0.0
    state, reference, *_ = drawn()
    for size in np.linspace(0, 20, 100):
        gravity.update(np.array([size, 0, 0]))
        angle = seen_up(gravity).magnitude()
        assert previous - 1e-9 <= angle < previous + 0.05
        previous = angle
        if size < 5:
            assert gravity.seen(state, reference) == (state, reference) and gravity.scale == 1


def test_the_policy_holds_a_force_of_more_than_twice_its_weight():
    flown = beetle_omni_ros.evaluate(['rl', 'rl_bare'], 'force', quiet=True)
    held = {name: flown[name]['force']['withstood_N'] for name in ('rl', 'rl_bare')}
    assert held['rl_bare'] < 40.0 and held['rl'] >= 70.0


def test_only_a_policy_that_does_not_observe_the_force_has_the_layer():
    layers = {name: guidance_of(registry.find(name).make(ROBOT)) for name in (
        'rl', 'rl_any', 'rl_bare', 'nmpc')}
    assert layers['rl'] == layers['rl_any'] + ', gravity'
    assert layers['rl_bare'] == 'none' and layers['nmpc'] == 'unwinding'
