"""The benchmark of rare losses of height: batches, counts, guidance."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('onnx')
pytest.importorskip('torch')

from beetle_omni_ros.control.policy import PolicyParameters
from beetle_omni_ros.control.policy_file import find, PolicyNetwork
from beetle_omni_ros.robot.parameters import RobotParameters

FILE = Path(__file__).resolve().parents[2] / 'benchmarks' / 'policy_moves.py'
ROBOT = RobotParameters.load()


@pytest.fixture(scope='module')
def moves():
    spec = importlib.util.spec_from_file_location('policy_moves', FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize('name', ['rl', 'rl_memory'])
def test_batched_and_single_observations_give_equal_actions(moves, name):
    path = find(f'policies/{name}.onnx')
    network = PolicyNetwork(path, ROBOT)
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(5, network.contract.observation_size)).astype(np.float32)
    expected = [network(row.tolist()) for row in rows]
    np.testing.assert_allclose(moves.Batched(path)(rows), expected, rtol=1e-4, atol=1e-4)


def test_a_lost_robot_counts_as_lost_only(moves):
    flown = {name: np.array([[value, 9.0], [value, 9.0]]) for name, value in (
        ('U_position', 0.01), ('U_attitude', 0.01), ('L_position', 0.02), ('L_attitude', 0.02),
        ('depth', 0.3), ('lowest', 0.25))}
    flown['U_attitude'][1, 0] = 0.2     # 11 degrees
    totals = moves.summary({**flown, 'lost': np.array([False, True])})
    assert totals['moves'] == 2 and totals['robots_lost'] == 1 and totals['missed'] == 1
    assert totals['deeper_than_0.25_m'] == 2 and totals['deeper_than_0.4_m'] == 0
    assert totals['below_0.3_m'] == 2 and totals['L_position_m'] == pytest.approx(0.02)


def test_hovering_robots_hold_their_target(moves, monkeypatch):
    monkeypatch.setattr(moves, 'SEGMENT', 30)
    monkeypatch.setattr(moves, 'ON_THE_WAY', (0, 15))
    monkeypatch.setattr(moves, 'AT_TARGET', (15, 30))
    poses = np.tile([0.5, -0.5, 1.2, 0.0, 0.0, 0.0], (16, 1))
    monkeypatch.setattr(moves, 'random_poses', lambda count, seed: poses[:count])
    env = moves.environment(4, 'nominal', False, ROBOT)
    env.state['x'][:, 6:10] = env.state['x'].new_tensor([0.0, 0.0, 0.0, 1.0])
    env.state['x'][:, 13:17] = 0.0
    env.state['previous'][:, :4] = 0.0
    parameters = PolicyParameters.load()
    flown = moves.fly(moves.Fleet(env, parameters, ROBOT.tilt_axes),
                      moves.Batched(find(parameters.policy)), 2, 0)
    assert flown['depth'].shape == (2, 4) and not flown['lost'].any()
    assert flown['U_position'].max() < 0.05 and flown['U_attitude'].max() < 0.1
    assert np.abs(flown['lowest'] - 1.2).max() < 0.05
