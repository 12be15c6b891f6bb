"""An adversely wound joint turns with its rotor at rest, and the robot lands softly."""

import itertools

import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.holding import Holding
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.safety.levelling import LevellingParameters, plan
from beetle_omni_ros.safety.turnover import find_turnover, TurnoverParameters

ROBOT = RobotParameters.load()
ALLOCATOR = Allocator(ROBOT)
LEVEL, P = LevellingParameters(), TurnoverParameters()
UPSIDE_DOWN = rotations.from_rpy(np.pi, 0.0, 0.7)
WINDINGS = [np.pi * np.array(signs) for signs in itertools.product((1.0, -1.0), repeat=4)]
WRONG = [tilt for tilt in WINDINGS if plan(UPSIDE_DOWN, tilt, ALLOCATOR, LEVEL).lost > P.lost_lift]


def test_only_equal_windings_on_both_arm_pairs_prevent_levelling():
    alike = [tilt for tilt in WINDINGS if tilt[0] == tilt[2] and tilt[1] == tilt[3]]
    np.testing.assert_array_equal(WRONG, alike)


@pytest.mark.parametrize('tilt', WRONG)
def test_one_joint_turn_permits_levelling_while_three_rotors_hold_the_position(tilt):
    found = find_turnover(UPSIDE_DOWN, tilt, ROBOT, ALLOCATOR, LEVEL, P)
    holding = Holding(ROBOT, found.health())
    assert holding.margin(found.quaternion) > holding.parameters.flying_margin
    assert rotations.geodesic_angle(found.quaternion, UPSIDE_DOWN) < P.farthest
    assert abs(found.tilt) <= ALLOCATOR.tilt_limit - P.room
    assert np.sign(found.tilt) == -np.sign(tilt[found.joint])
    turned = np.where(np.arange(4) == found.joint, tilt - np.copysign(2 * np.pi, tilt), tilt)
    assert plan(UPSIDE_DOWN, turned, ALLOCATOR, LEVEL).lost <= P.lost_lift


def test_no_joint_turns_over_if_none_can():
    level = rotations.from_rpy(0.0, 0.0, 0.7)
    assert find_turnover(level, np.zeros(4), ROBOT, ALLOCATOR, LEVEL, P) is None


@pytest.mark.parametrize('signs', [(1, 1, 1, 1), (-1, 1, -1, 1)])
def test_lands_softly_from_inverted_attitude_with_all_joints_wound_adversely(signs):
    from test_closed_loop import Flight  # the robot, its sensors and its supervisor
    flight = Flight()
    flight.run(5.0)
    flight.target = PoseTarget(np.array([0.0, 0.0, 1.5]), rotations.from_rpy(np.pi, 0.0, 0.0))
    flight.run(11.0)
    wind(flight, np.array(signs, dtype=float))
    assert flight.supervisor.land(flight.sim.time)
    flight.run(32.0)
    assert flight.off() and not flight.sim.truth.broken
    assert abs(flight.touchdown_speed) < 0.6


def wind(flight, signs):
    """Turn joints by whole turns, with their readings, commands and targets."""
    plant, supervisor = flight.sim._plant, flight.supervisor
    turns = np.where(np.sign(plant._tilt) != signs, 2 * np.pi * signs, 0.0)
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
