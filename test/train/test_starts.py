"""Random initial states, targets and robots."""

from learning import environment, only, quiet, ROBOT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import torch

from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.train.batch import Draw
from beetle_omni_ros.train.model import (
    ACTUATORS,
    actuators,
    DAMPING,
    LAG,
    nominal_body,
    STIFFNESS,
)
from beetle_omni_ros.train.starts import DRAWN, Starts, STRATA


def test_strata_have_their_shares_in_every_part_of_the_batch():
    env = environment(robots=1000)
    shares = np.array([getattr(env.cfg.start, name) for name in STRATA])
    shares = shares / shares.sum()
    for part in (slice(None), slice(0, 200), slice(400, 600)):
        found = np.bincount(env._starts.stratum[part], minlength=len(STRATA))
        np.testing.assert_allclose(found / found.sum(), shares, atol=0.02)


@pytest.mark.parametrize('name', STRATA)
def test_each_stratum_has_the_starts_of_its_name(name):
    env = environment({**only(name), 'start.other_branch': 0.0}, robots=300)
    x = env.state['x']
    if name in ('wound_back', 'level', 'wound'):
        expected = {'wound_back': -1, 'level': 0, 'wound': 1}[name]
        torch.testing.assert_close(x[:, model.TILT], torch.full((300, 4), expected * torch.pi))
    if name == 'mixed':
        windings = (x[:, model.TILT] / torch.pi).round().long()
        for value in (-1, 0, 1):
            assert float((windings == value).float().mean()) == pytest.approx(1 / 3, abs=0.06)
    if name in ('wound_back', 'level', 'wound', 'mixed'):
        assert (x[:, model.THRUST] == ROBOT.hover_thrust).all()
    assert bool(x[:, model.VELOCITY].any() or x[:, model.RATE].any()) == (name == 'moving')
    at_target = torch.isclose(x[:, model.QUATERNION], env.state['target_attitude']).all()
    assert bool(at_target) == (name == 'hold')


def test_a_hover_start_hovers():
    env = quiet({**only('hover'), 'start.other_branch': 0.5}, robots=200)
    accelerate = model.body_acceleration(ROBOT)
    for x in env.state['x'].double().numpy():
        linear, angular = accelerate(x[3:6], x[6:10], x[10:13], x[13:17], x[21:25])
        assert np.abs(np.array(linear)).max() < 1e-4
        assert np.abs(np.array(angular)).max() < 1e-3
    tilts = env.state['x'][:, model.TILT].abs()
    assert float((tilts > torch.pi).float().mean()) > 0.02      # some are wound further
    assert float(tilts.max()) < ROBOT.joints.position_limit
    torch.testing.assert_close(env.state['previous'], env.state['x'][:, [*range(13, 17),
                                                                         *range(21, 25)]])


def test_a_target_lasts_exactly_its_time():
    env = quiet(only('hold'))
    env.state['target_left'].copy_(torch.arange(64) % 4 + 1)
    before, changed = env.state['target_position'].clone(), torch.zeros(64)
    for step in range(1, 6):
        env.advance((env.state['previous'] - env.offset) / env.scale)
        new = (env.state['target_position'] != before).any(-1)
        changed[new & (changed == 0)] = step
    assert not env.done.any()
    torch.testing.assert_close(changed, torch.arange(64) % 4 + 1.0)
    assert (env.state['target_left'] >= 300 - 5).all()


def test_targets_lie_in_the_region_or_near_the_robot():
    env = quiet({'episode.hold_targets': 0.0}, robots=500)
    half = torch.tensor(env.cfg.episode.region) / 2
    assert (env.state['target_position'].abs() <= half).all()
    assert (env.state['target_position'].abs().max(0).values > 0.95 * half).all()
    env = quiet({**only('hover'), 'episode.hold_targets': 1.0}, robots=500)
    s = env.state
    assert float((s['target_position'] - s['x'][:, :3]).abs().max()) <= 0.3
    turned = Rotation.from_quat(s['x'][:, 6:10].numpy()).inv() \
        * Rotation.from_quat(s['target_attitude'].numpy())
    assert np.abs(turned.as_rotvec()).max() <= 0.6 + 1e-5


def drawn_starts(env, severity):
    starts = Starts(env.cfg, ROBOT, env.num_envs, 'cpu')
    starts.severity.fill_(severity)
    return starts.draw(Draw(torch.rand(env.num_envs, 145,
                                       generator=torch.Generator().manual_seed(0))))


def test_severity_scales_forces_and_payloads_of_new_robots():
    env = quiet({f'random.{name}_share': 1.0 for name in ('force', 'strong', 'payload')})
    none, half, full = (drawn_starts(env, severity) for severity in (0.0, 0.5, 1.0))
    assert full['wrench'].any(0).all() and not none['wrench'].any()
    torch.testing.assert_close(half['wrench'], 0.5 * full['wrench'])
    nominal = torch.tensor(nominal_body(ROBOT)).float()
    torch.testing.assert_close(none['body'], nominal.expand(env.num_envs, -1))
    load = full['body'][:, 0] - ROBOT.mass
    assert float(load.min()) >= 0 and 0.8 * env.cfg.random.payload < float(load.max()) \
        <= env.cfg.random.payload
    torch.testing.assert_close(half['body'][:, 0] - ROBOT.mass, 0.5 * load, atol=1e-5, rtol=1e-4)
    assert (full['body'][:, 6] <= 0).all()     # it hangs below


def test_rotors_hold_a_strong_force_with_bounded_thrust_in_every_direction():
    env = quiet({'random.strong_share': 1.0}, robots=2000)
    weight = ROBOT.mass * ROBOT.gravity
    thrust = env.state['wrench'].new_tensor([0, 0, weight]) - env.state['wrench'][:, :3]
    size = thrust.norm(dim=-1)
    assert 0.95 * env.cfg.random.strong_force < float(size.max()) \
        <= env.cfg.random.strong_force + 1e-3
    assert (thrust / size[:, None]).mean(0).abs().max() < 0.06
    assert not env.state['other_wrench'].any()


def test_slower_actuators_have_more_damping_and_lag_alone():
    nominal, other = (quiet({'random.lag_scale': scale}, robots=500).state['body'][:, ACTUATORS]
                      for scale in (0.0, 0.25))
    ratio = (other / nominal).nan_to_num(1.0)
    for part in (DAMPING, LAG):
        own = ratio[:, part.start - 7:part.stop - 7]
        assert (own == own[:, :1]).all() and 0.75 <= float(own.min()) < 0.76
        assert 1.24 < float(own.max()) <= 1.2501
        ratio[:, part.start - 7:part.stop - 7] = 1.0
    assert (ratio == 1.0).all()


def test_drawn_actuators_are_those_of_robots_that_the_robot_file_draws():
    rng, file = np.random.default_rng(0), RobotParameters.load('measured')
    drawn = torch.tensor(np.array([actuators(file.drawn(rng)) for _ in range(DRAWN)])).float()
    low, high = drawn.min(0).values, drawn.max(0).values
    nominal = torch.tensor(actuators(ROBOT)).float()
    measured = quiet({'random.actuator_spread': [1.0, 1.0]}, robots=2000)
    body, later = measured.state['body'][:, ACTUATORS], measured.state['delays'][:, :2] - 0.01
    distance = torch.cdist(body, drawn, compute_mode='donot_use_mm_for_euclid_dist')
    assert distance.min(1).values.max() < 1e-6
    torch.testing.assert_close(body.mean(0), drawn.mean(0), rtol=0.05, atol=1e-4)
    lag = body[:, 4:8] / body[:, :4] + later[:, :1]
    bounds = torch.tensor(np.array(file.interval('tilt_lag'))).float()
    assert ((bounds[0] - 1e-5 <= lag) & (lag <= bounds[1] + 1e-5)).all()
    assert later.min() >= -1e-6 and later[:, 0].max() > 0.004 and not later[:, 1].any()
    between = quiet({'random.actuator_spread': [0.0, 1.0]}, robots=2000)
    for part in (STIFFNESS, LAG):
        place = between.state['body'][:, part]
        limits = torch.stack((low, high, nominal))[:, part.start - 7:part.stop - 7]
        assert (place >= limits.min(0).values - 1e-6).all()
        assert (place <= limits.max(0).values + 1e-6).all()
        assert float(place.max()) > 0.95 * float(nominal[part.start - 7])
