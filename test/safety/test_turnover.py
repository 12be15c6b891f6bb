"""An adversely wound joint turns with its rotor at rest, and the robot lands softly."""

import itertools

import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.degraded import Holding
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.levelling import LevellingParameters, lost_lift, plan
from beetle_omni_ros.safety.turnover import find_turnover, TurnoverParameters

ROBOT = RobotParameters.load()
ALLOCATOR = Allocator(ROBOT)
LEVEL, P = LevellingParameters(), TurnoverParameters()
UPSIDE_DOWN = rotations.from_rpy(np.pi, 0.0, 0.7)
WINDINGS = [np.pi * np.array(signs) for signs in itertools.product((1.0, -1.0), repeat=4)]
WRONG = [tilt for tilt in WINDINGS if plan(UPSIDE_DOWN, tilt, ALLOCATOR, LEVEL).lost > P.lost_lift]


def equal_pairs(tilt):
    """Number of pairs of opposite arms with equal windings."""
    return int(np.sum(tilt[:2] == tilt[2:]))


def test_equal_windings_of_opposite_joints_prevent_levelling():
    np.testing.assert_array_equal(WRONG, [tilt for tilt in WINDINGS if equal_pairs(tilt)])


@pytest.mark.parametrize('tilt', WRONG)
def test_one_joint_turn_a_pair_permits_levelling_while_three_rotors_hold_the_position(tilt):
    for _ in range(equal_pairs(tilt)):
        assert plan(UPSIDE_DOWN, tilt, ALLOCATOR, LEVEL).lost > P.lost_lift
        found = find_turnover(UPSIDE_DOWN, tilt, ROBOT, ALLOCATOR, LEVEL, P)
        holding = Holding(ROBOT, found.health())
        assert holding.margin(found.quaternion) > holding.parameters.flying_margin
        assert rotations.geodesic_angle(found.quaternion, UPSIDE_DOWN) < P.farthest
        assert abs(found.tilt) <= ALLOCATOR.tilt_limit - P.room
        assert np.sign(found.tilt) == -np.sign(tilt[found.joint])
        tilt = np.where(np.arange(4) == found.joint, tilt - np.copysign(2 * np.pi, tilt), tilt)
    assert plan(UPSIDE_DOWN, tilt, ALLOCATOR, LEVEL).lost <= P.lost_lift


def test_the_lost_lift_of_several_windings_is_that_of_each():
    together = lost_lift(UPSIDE_DOWN, np.array(WINDINGS), ALLOCATOR, LEVEL)
    np.testing.assert_allclose(together, [plan(UPSIDE_DOWN, tilt, ALLOCATOR, LEVEL).lost
                                          for tilt in WINDINGS], atol=1e-9)


def test_nearly_every_attitude_with_wound_joints_is_near_a_place_to_turn_one_over():
    random, found = np.random.default_rng(12), []
    while len(found) < 60:
        attitude = rotations.normalized(random.normal(size=4))
        tilt = ALLOCATOR.hover(attitude, np.zeros(4)).tilt
        other = tilt - np.copysign(2 * np.pi, tilt)
        legal = np.abs(other) < ALLOCATOR.tilt_limit
        tilt = np.where(legal & (random.uniform(size=4) < 0.6), other, tilt)
        if plan(attitude, tilt, ALLOCATOR, LEVEL).lost > P.lost_lift:
            found.append(find_turnover(attitude, tilt, ROBOT, ALLOCATOR, LEVEL, P) is not None)
    assert np.mean(found) >= 0.95


def test_no_joint_turns_over_if_none_can():
    level = rotations.from_rpy(0.0, 0.0, 0.7)
    assert find_turnover(level, np.zeros(4), ROBOT, ALLOCATOR, LEVEL, P) is None


@pytest.mark.parametrize('signs', [(1, 1, 1, 1), (-1, 1, -1, 1)])
def test_lands_softly_from_inverted_attitude_with_all_joints_wound_adversely(signs):
    flight = hovering(rotations.from_rpy(np.pi, 0.0, 0.0))
    present = flight.sim._plant._tilt
    wind(flight, np.where(np.sign(present) != signs, 2 * np.pi * np.array(signs, dtype=float), 0))
    assert_lands_softly(flight, 27.0)


@pytest.mark.parametrize('seed', [203, 209, 220, 224])
def test_lands_softly_from_any_attitude_with_joints_wound_near_their_stops(seed):
    random = np.random.default_rng([seed, 77])
    wound = np.zeros(4)
    while not np.abs(wound).max() > 3.85:
        attitude = rotations.normalized(random.normal(size=4))
        tilt = ALLOCATOR.hover(attitude, np.zeros(4)).tilt
        other = tilt - np.copysign(2 * np.pi, tilt)
        legal = np.abs(other) < ALLOCATOR.tilt_limit - 0.01
        wound = np.where(legal & (random.uniform(size=4) < 0.6), other, 0.0)
    flight = hovering(attitude, 1.2, 'published', seed)
    goal = np.where(wound == 0, tilt, wound)
    wind(flight, 2 * np.pi * np.round((goal - flight.sim._plant._tilt) / (2 * np.pi)))
    assert_lands_softly(flight, 25.0)


def hovering(attitude, height=1.5, conditions='nominal', seed=0):
    """A flight at rest in an attitude."""
    from test_closed_loop import Flight  # the robot, its sensors and its supervisor
    flight = Flight(conditions=conditions, seed=seed)
    flight.run(5.0)
    flight.target = PoseTarget(np.array([0.0, 0.0, height]), attitude)
    flight.run(11.0)
    return flight


def assert_lands_softly(flight, duration):
    assert flight.supervisor.land(flight.sim.time)
    flight.run(flight.sim.time + duration)
    assert flight.off() and not flight.sim.truth.broken
    assert abs(flight.touchdown_speed) < 0.6


def wind(flight, turns):
    """Turn joints by whole turns (4,) [rad], with their readings, commands and targets."""
    plant, supervisor = flight.sim._plant, flight.supervisor
    plant._tilt += turns
    link = flight.sim._actuate
    until = flight.sim.time + 0.15

    def nearest(tilt):
        return tilt + 2 * np.pi * np.round((plant._tilt - tilt) / (2 * np.pi))

    flight.sim._actuate = lambda tilt, *rest: link(
        nearest(np.array(tilt)) if flight.sim.time < until else tilt, *rest)
    while flight.sim.time < until - 0.03:
        supervisor.watch.restart(flight.sim.time)
        supervisor._in_force = flight.in_force = supervisor._in_force.__class__(
            supervisor._in_force.stamp, nearest(supervisor._in_force.tilt),
            supervisor._in_force.thrust)
        flight.run(flight.sim.time + 0.01)
