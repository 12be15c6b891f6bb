"""Allocation with lost and stuck actuators, and the attitudes that can be held."""

import numpy as np
import pytest

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ActuatorHealth, ALL_HEALTHY, Allocator
from beetle_omni_ros.model.degraded import (
    allocator,
    DegradedAllocator,
    Holding,
    leaned,
    TILT_REACH,
    up,
)
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
LIMIT = ROBOT.joints.position_limit
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def lost(*rotors):
    return ActuatorHealth(rotors=tuple(i not in rotors for i in range(4)))


def stuck(joint, angle):
    return ActuatorHealth(stuck=tuple(angle if i == joint else None for i in range(4)))


KINDS = [lost(0), lost(3), stuck(1, -0.3), stuck(2, 3.5),
         ActuatorHealth(held=(None, 9.0, None, None))]
LOST, STUCK = lost(0), stuck(1, 1.5)


def draws(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.normal(size=3) * 12, rng.normal(size=3) * 0.5, rng.uniform(-LIMIT, LIMIT, 4)


def at_a_limit(got):
    return (got.thrust > ROBOT.rotors.thrust_max - 1e-6).any() \
        or (np.abs(got.tilt) >= LIMIT).any()


def keeps_to(health, tilt, thrust):
    assert all(thrust[i] == 0.0 for i in range(4) if not health.rotors[i])
    assert all(tilt[i] == angle for i, angle in enumerate(health.stuck) if angle is not None)
    assert all(thrust[i] == pytest.approx(own) for i, own in enumerate(health.held) if own)
    assert np.all(np.abs(tilt) <= LIMIT)
    assert np.all((thrust >= 0.0) & (thrust <= ROBOT.rotors.thrust_max))


@pytest.mark.parametrize('health', KINDS)
def test_the_remaining_actuators_give_the_wrench_within_limits(health):
    ours, met = allocator(ROBOT, health), 0
    for force, torque, present in draws(100, 1):
        got = ours.allocate(force, torque, present)
        keeps_to(health, got.tilt, got.thrust)
        if not at_a_limit(got):
            met += 1
            made = Allocator(ROBOT).wrench(got.tilt, got.thrust)
            np.testing.assert_allclose(np.concatenate(made), np.r_[force, torque], atol=0.01)
    assert met > 60


def test_with_all_actuators_it_is_the_healthy_allocation():
    ours, healthy = DegradedAllocator(ROBOT, ALL_HEALTHY), Allocator(ROBOT)
    assert type(allocator(ROBOT)) is Allocator
    for force, torque, present in draws(50, 2):
        got, right = (a.allocate(force, torque, present) for a in (ours, healthy))
        if not at_a_limit(right):
            np.testing.assert_allclose(got.tilt, right.tilt, atol=1e-9)
            np.testing.assert_allclose(got.thrust, right.thrust, atol=1e-9)


def test_a_stuck_rotor_that_would_need_negative_thrust_is_off():
    health = stuck(0, np.pi)
    got = allocator(ROBOT, health).hover(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(4))
    assert got.thrust[0] == 0.0
    assert not at_a_limit(got)


@pytest.mark.parametrize('health', [lost(0), stuck(1, 0.8)])
def test_beyond_the_limits_the_error_is_smaller_than_by_clipping(health):
    ours = allocator(ROBOT, health)
    nearer, clipped = [], []
    for force, torque, present in draws(200, 3):
        force, torque = 2 * force, 2 * torque
        got = ours.allocate(force, torque, present)
        if not at_a_limit(got):
            continue
        wrench = np.concatenate([force, torque])
        pairs = ours.components(wrench[None])[0].reshape(4, 2)
        lengths = np.maximum(np.linalg.norm(pairs, axis=1), 1e-9)
        pairs *= np.minimum(1.0, ROBOT.rotors.thrust_max / lengths)[:, None]
        clipped.append(ours.error(pairs.ravel(), wrench))
        made = np.concatenate(ours.wrench(got.tilt, got.thrust))
        nearer.append(np.linalg.norm(ours.scale * (made - wrench)))
    assert len(nearer) > 20
    assert np.median(nearer) < 0.7 * np.median(clipped)


@pytest.mark.parametrize('health', KINDS)
def test_solutions_near_the_present_tilts_respect_range_and_health(health):
    ours = allocator(ROBOT, health)
    for force, torque, present in draws(40, 4):
        present, _ = health.possible(present, np.zeros(4))
        aim = ours.allocate(force, torque, present)
        got = ours.allocate_near(force, torque, present, aim)
        keeps_to(health, got.tilt, got.thrust)
        assert np.all(np.abs(got.tilt - present) <= TILT_REACH + 1e-9)


@pytest.fixture(scope='module')
def holdings():
    return {health: Holding(ROBOT, health) for health in (ALL_HEALTHY, LOST, STUCK)}


def attitudes(count, seed=0):
    return [rotations.normalized(q) for q in np.random.default_rng(seed).normal(size=(count, 4))]


def test_with_a_rotor_lost_every_attitude_near_level_is_held_but_level_is_singular(holdings):
    holding = holdings[LOST]
    near = holding.directions[:, 2] > np.cos(np.radians(29))
    tilt, thrust, met = holding._held(holding.directions[near])
    assert met.all() and thrust.max() <= ROBOT.rotors.thrust_max
    assert 0.55 < np.mean(holding.margins > 0) < 0.65
    assert holding.margin(LEVEL) < 0.05


@pytest.mark.parametrize('health', [LOST, STUCK])
def test_an_attitude_with_margin_is_held_by_the_allocation(holdings, health):
    ours = allocator(ROBOT, health)
    for quaternion in attitudes(60):
        if holdings[health].margin(quaternion) > 0:
            got = ours.hover(quaternion, np.zeros(4))
            force, torque = ours.wrench(got.tilt, got.thrust)
            np.testing.assert_allclose(rotations.matrix(quaternion) @ force, ours.weight,
                                       atol=0.01)
            np.testing.assert_allclose(torque, 0.0, atol=0.01)


@pytest.mark.parametrize('health, margin', [(STUCK, 1.0), (LOST, 15.0)])
def test_the_nearest_attitude_has_the_margin_and_no_sample_is_nearer(holdings, health, margin):
    holding = holdings[health]
    best = min(margin, 0.8 * holding.margins.max())
    for desired in attitudes(30):
        got = holding.nearest(desired, margin)
        assert holding.margin(got) >= best - 1e-9
        firm = holding.directions[holding.margins >= best]
        least = np.arccos(np.clip((firm @ up(desired)).max(), -1, 1))
        assert rotations.geodesic_angle(got, desired) <= least + 1e-6


@pytest.mark.parametrize('rotor, up_now, rate, tilt', [
    # States of two random flights when the rotor was named. By angle and travel only, an inverted
    # attitude would be chosen, from which level is reached only with a fall of 2 m.
    (3, (0.99, 0.14, -0.04), -1.9, (1.6, 1.6, -1.6, -1.5)),
    (2, (-0.97, 0.24, -0.07), 1.8, (-1.6, -1.6, 1.6, 1.7))])
def test_from_the_side_the_escape_leads_towards_level(rotor, up_now, rate, tilt):
    holding = Holding(ROBOT, lost(rotor))
    start = leaned(LEVEL, np.array(up_now) / np.linalg.norm(up_now))
    got = holding.quickest(start, np.array([0.0, 0.0, rate]), np.array(tilt), 2.0, 0.8)
    assert holding.margin(got) >= 2.0 - 1e-9
    assert up(got)[2] > 0.8


def test_less_thrust_reduces_all_margins_and_level_keeps_the_largest(holdings):
    weak = Holding(ROBOT, ActuatorHealth(thrust_limit=8.8))
    assert np.all(weak.margins <= holdings[ALL_HEALTHY].margins + 1e-9)
    on_its_side = np.abs(weak.directions[:, 2]) < 0.5
    assert np.all(weak.margins[on_its_side] == 0.0)
    got = weak.quickest(rotations.from_rpy(np.radians(170.0), 0, 0), np.zeros(3), np.zeros(4),
                        2.0, 0.8)
    assert up(got)[2] > 0.9     # in the inverted attitude it could not turn further
