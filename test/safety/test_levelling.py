"""The route to level: joints stay within their stops, from any winding."""

import numpy as np
import pytest

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.levelling import LevellingParameters, plan, Way
from beetle_omni_ros.safety.ramp import inclination

ALLOCATOR = Allocator(RobotParameters.load())
P = LevellingParameters()
RANDOM = np.random.default_rng(5)
ATTITUDES = [rotations.normalized(q) for q in RANDOM.normal(size=(20, 4))]
UPSIDE_DOWN = [rotations.from_rpy(np.pi, 0.0, yaw) for yaw in (0.0, 0.4, 1.6, 3.0)]


def held(attitude):
    """Tilts of hovering; inverted, those after a rotation from one side."""
    beside = rotations.multiply(attitude, rotations.exp(np.array([2e-4, 5e-4, 0.0])))
    return ALLOCATOR.upright(rotations.matrix(beside)[2][None])[0][0]


def followed(way, tilt):
    """Tilts (P, 4) of the allocation along a route, and the largest loss of thrust."""
    present, tilts, jumps = np.array(tilt), [], []
    for elapsed in np.linspace(0, way.duration, 200):
        goal = ALLOCATOR.hover(way.at(elapsed)[0], present)
        moved = np.abs(goal.tilt - present) > 1.0
        jumps.append(float((goal.thrust * moved).sum()))
        present = goal.tilt
        tilts.append(present)
    return np.array(tilts), np.array(jumps)


@pytest.mark.parametrize('attitude', ATTITUDES + UPSIDE_DOWN)
def test_ends_level_and_no_loaded_joint_turns_over(attitude):
    way = plan(attitude, held(attitude), ALLOCATOR, P)
    assert inclination(way.goal) < 1e-6
    np.testing.assert_allclose(np.abs(way.at(0.0)[0] @ attitude), 1, atol=1e-9)
    tilts, jumps = followed(way, held(attitude))
    np.testing.assert_allclose(tilts[-1], 0, atol=1e-3)
    assert jumps.max() < 1.0


@pytest.mark.parametrize('signs', [(1, 1, -1, -1), (1, -1, -1, 1), (-1, -1, 1, 1), (-1, 1, 1, -1)])
def test_from_an_inverted_attitude_the_joint_windings_choose_the_side(signs):
    tilt = np.pi * np.array(signs)
    way = plan(UPSIDE_DOWN[0], tilt, ALLOCATOR, P)
    tilts, jumps = followed(way, tilt)
    np.testing.assert_allclose(tilts[-1], 0, atol=1e-3)
    assert jumps.max() < 1.0


@pytest.mark.parametrize('attitude', UPSIDE_DOWN)
@pytest.mark.parametrize('joint', range(4))
def test_an_adversely_wound_joint_unwinds_while_its_arm_is_vertical(attitude, joint):
    tilt = held(attitude)
    tilt[joint] -= 2 * np.pi * np.sign(tilt[joint])
    way = plan(attitude, tilt, ALLOCATOR, P)
    tilts, jumps = followed(way, tilt)
    np.testing.assert_allclose(tilts[-1], 0, atol=1e-3)
    assert jumps.max() < 1.5        # of 7.5 N


def test_levelling_respects_the_rate_limits_of_body_and_joints():
    for attitude in ATTITUDES:
        way = plan(attitude, held(attitude), ALLOCATOR, P)
        times = np.linspace(0, way.duration, 100)[:-1]
        assert max(np.linalg.norm(way.at(t)[1]) for t in times) < P.rate + 1e-6


def test_the_rate_is_the_derivative_of_the_attitude():
    way, h = plan(ATTITUDES[0], held(ATTITUDES[0]), ALLOCATOR, P), 1e-6
    for t in np.linspace(0.01, way.duration - 0.01, 37):
        turn = rotations.log(rotations.multiply(rotations.conjugate(way.at(t - h)[0]),
                                                way.at(t + h)[0]))
        np.testing.assert_allclose(turn / (2 * h), way.at(t)[1], atol=2e-2)


def test_a_direct_route_is_the_shortest_rotation():
    goal = rotations.from_rpy(0, 0, 0.3)
    way = Way.straight(ATTITUDES[1], goal, 0.5)
    assert way.duration == pytest.approx(rotations.geodesic_angle(goal, ATTITUDES[1]) / 0.5)
    assert Way.straight(goal, goal, 0.5).duration == 0.0


def test_the_attitude_is_held_while_a_joint_waits_at_the_start():
    tilt = held(ATTITUDES[0])
    tilt[0] -= 0.8
    way = plan(ATTITUDES[0], tilt, ALLOCATOR, P)
    attitude, rate = way.at(0.01)
    np.testing.assert_allclose(np.abs(attitude @ ATTITUDES[0]), 1, atol=1e-9)
    np.testing.assert_allclose(rate, 0)


def test_two_opposite_joints_at_their_stops_turn_back_without_loss_of_lift():
    limit, tried = ALLOCATOR.tilt_limit, 0
    for attitude in np.random.default_rng(7).normal(size=(1500, 4)):
        attitude = rotations.normalized(attitude)
        tilt = held(attitude)
        other = tilt - 2 * np.pi * np.sign(tilt)
        at_stop = (np.abs(other) < limit) & (np.abs(other) > limit - P.margin)
        if at_stop.sum() != 2 or not (at_stop[:2] & at_stop[2:]).any():
            continue
        tried += 1
        tilt = np.where(at_stop, other, tilt)
        way = plan(attitude, tilt, ALLOCATOR, P)
        tilts, jumps = followed(way, tilt)
        assert way.lost < 0.1 and jumps.max() < 1.0
        np.testing.assert_allclose(tilts[-1], 0, atol=1e-3)
    assert tried > 10


def test_a_path_that_stays_near_a_stop_counts_as_a_turnover():
    attitude = np.radians([-147.0, 2.0, -112.0])    # no path leads joint 2 away from its stop
    attitude, tilt = rotations.from_rpy(*attitude), np.array([-3.90, 3.95, 3.83, 2.40])
    np.testing.assert_allclose(ALLOCATOR.hover(attitude, tilt).tilt, tilt, atol=0.03)
    assert plan(attitude, tilt, ALLOCATOR, P).lost > 0.3
