"""The metrics of the assessment, for prescribed states with known metrics."""

import itertools

from learning import QUIET, ROBOT, small
import numpy as np
import pytest
import torch

from beetle_omni_ros.control.policy_file import PolicyContract
from beetle_omni_ros.train import assess as module
from beetle_omni_ros.train import batch
from beetle_omni_ros.train.assess import assess, conditions
from beetle_omni_ros.train.parameters import RandomParameters

HOLD = torch.zeros(1, 8)


class Held:
    """Replacement of the environment: each robot has an offset from its present target."""

    offset, lost = None, None

    def __init__(self, parameters, robot, device, compiled):
        count = self.num_envs = parameters.ppo.robots
        self.cfg, self.device, self.step = parameters, device, 0
        self.observation, self.done = torch.zeros(count, 33), torch.zeros(count, dtype=torch.bool)
        self.scale = torch.tensor(PolicyContract.default(robot).action_scale).float()
        self.state = {'x': torch.zeros(count, 25), 'previous': torch.zeros(count, 8),
                      'age': torch.zeros(count), 'target_left': torch.zeros(count),
                      'target_position': torch.randn(count, 3), 'floor': torch.zeros(count, 1),
                      'target_attitude': torch.nn.functional.normalize(torch.randn(count, 4))}

    def advance(self, action):
        """Set the states after this step."""
        s = self.state
        distance, angle = self.offset(self.step % 800)
        s['x'][:, :3] = s['target_position']
        s['x'][:, 0] += torch.as_tensor(distance)
        turn = torch.zeros(self.num_envs, 3)
        turn[:, 1] = torch.as_tensor(angle)
        s['x'][:, 6:10] = batch.product(s['target_attitude'], batch.from_rotation_vector(turn))
        s['previous'] = self.scale * action
        self.done = torch.zeros(self.num_envs, dtype=torch.bool)
        if self.step == 1000 and self.lost:
            self.done[:self.lost] = True
        self.step += 1


def still(seen):
    """A policy that does nothing."""
    return HOLD.expand(len(seen), 8)


@pytest.fixture
def held(monkeypatch):
    """Call ``assess`` with prescribed states."""
    def run(offset, mean=still, robots=20, segments=2, lost=0):
        monkeypatch.setattr(module, 'TiltableQuadrotorEnv', Held)
        monkeypatch.setattr(Held, 'offset', staticmethod(offset))
        monkeypatch.setattr(Held, 'lost', lost)
        return assess(mean, small(), ROBOT, robots=robots, segments=segments)
    return run


def test_the_windows_are_7_0_to_7_5_s_and_1_to_7_s(held):
    def offset(step):      # step k is flown from 10 k ms to 10 (k + 1) ms
        time = (step + 1) * 0.01
        if 6.995 < time < 7.495:
            return 0.04, 0.0
        return (0.08, 0.1) if 0.995 < time < 6.995 else (1.0, 1.0)
    found = held(offset)
    assert found['U_position_m'] == pytest.approx(0.04, rel=1e-3)
    assert found['L_position_m'] == pytest.approx(0.08, rel=1e-3)
    assert found['U_attitude_deg'] == pytest.approx(0.0, abs=0.05)
    assert found['L_attitude_deg'] == pytest.approx(np.degrees(0.1), rel=1e-3)
    assert found['reached'] == 1 and found['lost'] == 0


def test_lost_robots_count_as_missed_and_not_in_the_means(held):
    distance = torch.tensor([5.0] * 3 + [0.02] * 5 + [0.099, 0.101])
    angle = torch.tensor([0.0] * 3 + [np.radians(11)] + [0.0] * 6).float()
    found = held(lambda step: (distance, angle), robots=10, lost=3)
    assert found['lost'] == pytest.approx(0.3)
    assert found['reached'] == pytest.approx(0.5)    # within 10 cm and 10 degrees
    assert found['U_position_m'] == pytest.approx((5 * 0.02 + 0.2) / 7, rel=1e-3)
    # a mean over no robot is left out, because JSON has no NaN
    assert not any(key.startswith(('U_', 'L_')) for key in held(
        lambda step: (5.0, 0.0), robots=10, lost=10))


def test_command_changes_are_measured_at_the_target(held):
    sign = itertools.cycle((1.0, -1.0))
    amplitude = torch.tensor([0.02] * 4 + [0.1] * 4)

    def mean(seen):
        return next(sign) * amplitude.expand(len(seen), 8)
    found = held(lambda step: (0.0, 0.0), mean)
    assert found['tilt_change_rad'] == pytest.approx(2 * 0.02 * 0.25, rel=1e-3)
    assert found['thrust_change_N'] == pytest.approx(2 * 0.1 * 0.5, rel=1e-3)


def test_nominal_conditions_have_no_disturbance():
    nominal = conditions('nominal', RandomParameters())
    for name in QUIET:
        group, key = name.split('.')
        if group == 'random' and not key.endswith(('latency', 'limit', 'spread')):
            assert getattr(nominal, key) == 0, key


def test_the_real_environment_is_flown(monkeypatch):
    monkeypatch.setattr(module, 'SEGMENT', 0.4)
    monkeypatch.setattr(module, 'AT_TARGET', (0.3, 0.35))
    monkeypatch.setattr(module, 'ON_THE_WAY', (0.1, 0.3))
    torch.manual_seed(0)
    found = assess(still, small(), ROBOT, name='published', robots=16, segments=1)
    assert found['lost'] == 0 and found['reached'] < 0.5
    assert 0.3 < found['U_position_m'] < 5 and 20 < found['U_attitude_deg'] < 180
    assert found['tilt_change_rad'] == found['thrust_change_N'] == 0
