"""The Gymnasium environment flies the stack of `evaluate`."""

from gymnasium.utils.env_checker import check_env
import numpy as np
import pytest

from beetle_omni_ros.control.policy_file import PolicyNetwork
from beetle_omni_ros.flight.gym import FlightEnv
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.resources import share_path


def flown(env, policy, pose, seed=3):
    observation, _ = env.reset(seed=seed, options={'pose': pose})
    rewards, over = [], False
    while not over:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        rewards.append(reward)
        over = terminated or truncated
    return np.array(rewards), terminated, info


@pytest.fixture
def env():
    made = FlightEnv(duration=6.0)
    yield made
    made.close()


@pytest.mark.filterwarnings('ignore::UserWarning')      # recommendations
def test_it_keeps_the_rules_of_gymnasium(env):
    check_env(env, skip_render_check=True, skip_close_check=True)      # raises
    observation, info = env.reset(seed=1)
    assert observation in env.observation_space and observation.shape == (33,)
    assert env.action_space.shape == (8,) and set(info) == {'position_error_m',
                                                            'attitude_error_rad'}


def test_the_shipped_policy_reaches_a_pose(env):
    network = PolicyNetwork(share_path('policies/rl.onnx'), RobotParameters.load())
    rewards, fell, info = flown(env, lambda seen: network(seen.tolist()), [0.3, 0, 1.2, 40, 0, 0])
    assert not fell and len(rewards) == 600
    assert info['position_error_m'] < 0.03 and info['attitude_error_rad'] < 0.03


def test_the_supervisor_ends_an_episode_of_full_thrust(env):
    _, fell, _ = flown(env, lambda seen: env.action_space.high, [0, 0, 1, 0, 0, 0])
    assert fell
