"""Attitudes that can be held: shares, singularities, the nearest one with margin, heading."""

import numpy as np
import pytest

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import ActuatorHealth, ALL_HEALTHY
from beetle_omni_ros.robot.degraded import allocator, Holding, leaned, sphere, up
from beetle_omni_ros.robot.parameters import RobotParameters

ROBOT = RobotParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
LOST = ActuatorHealth(rotors=(False, True, True, True))
STUCK = ActuatorHealth(stuck=(None, 1.5, None, None))


@pytest.fixture(scope='module')
def holdings():
    return {health: Holding(ROBOT, health) for health in (ALL_HEALTHY, LOST, STUCK)}


def attitudes(count, seed=0):
    return [rotations.normalized(q) for q in np.random.default_rng(seed).normal(size=(count, 4))]


def test_a_healthy_robot_holds_every_attitude(holdings):
    assert holdings[ALL_HEALTHY].margins.min() > 0.0


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


def test_heading_does_not_change_the_margin(holdings):
    for quaternion in attitudes(20):
        turned = rotations.multiply(rotations.from_rpy(0, 0, 1.1), quaternion)
        assert holdings[STUCK].margin(turned) == pytest.approx(holdings[STUCK].margin(quaternion))


@pytest.mark.parametrize('health', [LOST, STUCK])
def test_the_nearest_attitude_has_the_margin_and_no_sample_is_nearer(holdings, health):
    holding = holdings[health]
    for desired in attitudes(30):
        got = holding.nearest(desired, 1.0)
        assert holding.margin(got) >= 1.0 - 1e-9
        firm = holding.directions[holding.margins >= 1.0]
        least = np.arccos(np.clip((firm @ up(desired)).max(), -1, 1))
        assert rotations.geodesic_angle(got, desired) <= least + 1e-6


def test_an_attitude_with_margin_is_kept(holdings):
    firm = leaned(LEVEL, holdings[LOST].directions[np.argmax(holdings[LOST].margins)])
    np.testing.assert_allclose(holdings[LOST].nearest(firm, 2.0), firm)


def test_without_any_margin_the_nearest_of_the_best_is_taken(holdings):
    holding = holdings[LOST]
    nearly = 0.8 * holding.margins.max()
    for desired in (LEVEL, *attitudes(10)):
        got = holding.nearest(desired, 15.0)
        assert holding.margin(got) >= nearly - 1e-9
        firm = holding.directions[holding.margins >= nearly]
        least = np.arccos(np.clip((firm @ up(desired)).max(), -1, 1))
        assert rotations.geodesic_angle(got, desired) <= least + 1e-6


def test_the_quickest_attitude_is_the_present_one_if_all_have_margin(holdings):
    got = holdings[ALL_HEALTHY].quickest(LEVEL, np.zeros(3), np.zeros(4), 1.0, 0.8)
    assert rotations.geodesic_angle(got, LEVEL) < 0.2
    turning = holdings[ALL_HEALTHY].quickest(LEVEL, np.array([5.0, 0, 0]), np.zeros(4), 1.0,
                                            0.8)
    assert rotations.log(turning)[0] > rotations.log(got)[0] + 0.05


def test_the_nearest_attitude_has_the_flight_margin_near_the_requested_one():
    holding = Holding(ROBOT, LOST)
    got = holding.nearest(LEVEL, holding.parameters.flying_margin)
    assert holding.margin(got) >= 2.0
    assert rotations.geodesic_angle(got, LEVEL) < np.radians(20)


def test_leaning_is_the_shortest_rotation():
    for quaternion, direction in zip(attitudes(20), sphere(20)):
        got = leaned(quaternion, direction)
        np.testing.assert_allclose(up(got), direction, atol=1e-9)
        assert rotations.geodesic_angle(got, quaternion) == pytest.approx(
            np.arccos(np.clip(up(quaternion) @ direction, -1, 1)), abs=1e-6)
    upside_down = leaned(LEVEL, np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(up(upside_down), [0, 0, -1], atol=1e-9)


@pytest.mark.parametrize('lost, up_now, rate, tilt', [
    # States of two random flights when the rotor was named. By angle and travel only, an inverted
    # attitude would be chosen, from which level is reached only with a fall of 2 m.
    (3, (0.99, 0.14, -0.04), -1.9, (1.6, 1.6, -1.6, -1.5)),
    (2, (-0.97, 0.24, -0.07), 1.8, (-1.6, -1.6, 1.6, 1.7))])
def test_from_the_side_the_escape_leads_towards_level(lost, up_now, rate, tilt):
    holding = Holding(ROBOT, ActuatorHealth(rotors=tuple(i != lost for i in range(4))))
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
