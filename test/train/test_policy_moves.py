"""The benchmark of rare losses of height flies."""

import importlib.util
from pathlib import Path

from learning import ROBOT
import numpy as np

from beetle_omni_ros.control.policy import PolicyParameters
from beetle_omni_ros.control.policy_file import find

FILE = Path(__file__).resolve().parents[2] / 'benchmarks' / 'policy_moves.py'


def test_hovering_robots_hold_their_target(monkeypatch):
    spec = importlib.util.spec_from_file_location('policy_moves', FILE)
    moves = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(moves)
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
