"""The route to level: joints stay within their stops, from any winding."""

import numpy as np
import pytest

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.supervisor.way import climb, inclination, MARGIN, plan, Ramp, Way

ROBOT = RobotParameters.load()
ALLOCATOR = Allocator(ROBOT)
RATE = 0.8      # [rad/s] of the body
RANDOM = np.random.default_rng(5)
ATTITUDES = [rotations.normalized(q) for q in RANDOM.normal(size=(20, 4))]
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
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
    way = plan(attitude, held(attitude), ALLOCATOR, RATE)
    assert inclination(way.at(way.duration)[0]) < 1e-6
    np.testing.assert_allclose(np.abs(way.at(0.0)[0] @ attitude), 1, atol=1e-9)
    tilts, jumps = followed(way, held(attitude))
    np.testing.assert_allclose(tilts[-1], 0, atol=1e-3)
    assert jumps.max() < 1.0


@pytest.mark.parametrize('attitude', UPSIDE_DOWN)
@pytest.mark.parametrize('joint', range(4))
def test_an_adversely_wound_joint_unwinds_while_its_arm_is_vertical(attitude, joint):
    tilt = held(attitude)
    tilt[joint] -= 2 * np.pi * np.sign(tilt[joint])
    way = plan(attitude, tilt, ALLOCATOR, RATE)
    tilts, jumps = followed(way, tilt)
    np.testing.assert_allclose(tilts[-1], 0, atol=1e-3)
    assert jumps.max() < 1.5        # of 7.5 N


def test_two_opposite_joints_at_their_stops_turn_back_without_loss_of_lift():
    limit, tried = ALLOCATOR.tilt_limit, 0
    for attitude in np.random.default_rng(7).normal(size=(1500, 4)):
        attitude = rotations.normalized(attitude)
        tilt = held(attitude)
        other = tilt - 2 * np.pi * np.sign(tilt)
        at_stop = (np.abs(other) < limit) & (np.abs(other) > limit - MARGIN)
        if at_stop.sum() != 2 or not (at_stop[:2] & at_stop[2:]).any():
            continue
        tried += 1
        tilt = np.where(at_stop, other, tilt)
        way = plan(attitude, tilt, ALLOCATOR, RATE)
        tilts, jumps = followed(way, tilt)
        assert jumps.max() < 1.0
        np.testing.assert_allclose(tilts[-1], 0, atol=1e-3)
    assert tried > 10


KNOTS = [climb(0.8, 0.4, 0.5), climb(0.1, 0.4, 0.5), [(0.0, 0.0), (0.5, 0.0), (0.7, -1.0)]]


@pytest.mark.parametrize('knots', KNOTS)
def test_velocities_of_a_ramp_are_the_derivatives_of_its_pose(knots):
    way, h = Way(np.array([0.0, 3.0]), np.array([ATTITUDES[2], UPSIDE_DOWN[1]])), 1e-5
    ramp = Ramp(10.0, np.array([1.0, 2.0, 3.0]), way, knots)
    for time in np.linspace(10.03, 16.03, 61):
        before, now, after = (ramp.at(t) for t in (time - h, time, time + h))
        np.testing.assert_allclose((after.position - before.position) / (2 * h), now.velocity,
                                   atol=1e-4)
        turn = rotations.log(rotations.multiply(rotations.conjugate(before.quaternion),
                                                after.quaternion))
        if abs(time - 10 - way.duration) > 2 * h:
            np.testing.assert_allclose(turn / (2 * h), now.angular_velocity, atol=1e-4)
