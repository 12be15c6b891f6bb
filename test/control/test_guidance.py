"""Guidance: joints at their stops, detours around them, trimmed steady errors, layers off."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.guidance import (
    ATTEMPTS,
    DURATION,
    Guidance,
    HEIGHT,
    MISSED_ANGLE,
    NEAR,
    PATIENCE,
    RAISE,
    Trimming,
)
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

AXES = RobotParameters.load().tilt_axes
GOAL = PoseTarget(np.array([0.4, -0.3, 1.5]), rotations.from_rpy(0.8, -0.5, 2.0), stamp=3.0)
SMALL = st.tuples(*[st.floats(-0.03, 0.03)] * 3).map(np.array)


def state(stamp, way=(0, 0, 0), turn=(0, 0, 0), target=GOAL, **changed):
    """State of a robot with an offset from a target, a vector in world and a rotation."""
    values = {'position': target.position - np.array(way), 'velocity': np.zeros(3),
              'quaternion': rotations.multiply(target.quaternion, rotations.conjugate(
                  rotations.exp(np.array(turn, dtype=float)))),
              'angular_velocity': np.zeros(3), 'tilt': np.zeros(4), **changed}
    return State(stamp, **values, tilt_velocity=np.zeros(4), tilt_stamp=stamp)


def wait(trimming, seconds, begin=0.0, target=GOAL, **where):
    for k in range(round(100 * seconds) + 1):
        shown = trimming.target(state(begin + 0.01 * k, target=target, **where), target)
    return shown


@settings(max_examples=20, deadline=None)
@given(SMALL, SMALL)
def test_a_constant_tracking_error_is_trimmed_to_zero(way, turn):
    """The robot follows with a time constant of 0.3 s, much faster than the integral."""
    trimming, position, lag = Trimming(), np.zeros(3), np.zeros(3)
    for k in range(700):
        shown = trimming.target(state(0.01 * k, way - position, turn - lag), GOAL)
        asked = rotations.log(rotations.multiply(
            rotations.conjugate(GOAL.quaternion), shown.quaternion))
        position += 0.01 / 0.3 * (shown.position - GOAL.position - position)
        lag += 0.01 / 0.3 * (asked - lag)
    assert np.linalg.norm(way - position) < 0.03 * max(np.linalg.norm(way), 1e-3)
    assert np.linalg.norm(turn - lag) < 0.03 * max(np.linalg.norm(turn), 1e-3)
    assert shown.stamp == GOAL.stamp


@pytest.mark.parametrize('where', [
    {'way': (0.2, 0, 0)}, {'turn': (0, 0.5, 0)},
    {'way': (0.01, 0, 0), 'velocity': np.array([0, 0.3, 0])}])
def test_the_trim_does_not_change_in_motion(where):
    shown = wait(Trimming(), 2.0, **where)
    assert shown.position == pytest.approx(GOAL.position)
    assert shown.quaternion == pytest.approx(GOAL.quaternion)


def test_the_trim_is_kept_for_equal_and_nearby_targets_only():
    trimming = Trimming()
    wait(trimming, 3.0, way=(0.02, 0, 0))
    found = list(trimming.position)
    again = PoseTarget(GOAL.position.copy(), GOAL.quaternion.copy(), stamp=9.0)
    near = replace(GOAL, position=GOAL.position + [0, 0.05, 0])
    for target in (again, near):
        shown = trimming.target(state(9.0, target=target), target)
        assert shown.position - target.position == pytest.approx(found)
    far = replace(GOAL, position=GOAL.position + [0, 0.5, 0])
    assert trimming.target(state(9.0, target=far), far).position == pytest.approx(far.position)


TARGET = PoseTarget(np.array([0.0, 0.0, 1.0]), rotations.from_rpy(1.2, 0.4, -2.0))
OFF = rotations.multiply(TARGET.quaternion, rotations.exp(np.array([0.0, 0.4, 0.0])))
WOUND = np.array([1.5, 3.8, -1.5, -3.7])


def unwinding():
    return Guidance(AXES, 'routing, trimming')


def stuck(stamp, **changed):
    return state(stamp, target=TARGET, **{'quaternion': OFF, 'tilt': WOUND, **changed})


def fly(guidance, seconds, begin=0.0, target=TARGET, **changed):
    """Targets of the guidance over a time, every 10 ms."""
    return [guidance.target(stuck(begin + 0.01 * k, **changed), target)
            for k in range(round(seconds * 100))]


def test_a_robot_stuck_at_a_joint_stop_gets_a_level_target_above_its_place_after_the_timeout():
    guidance = unwinding()
    shown = fly(guidance, 1.0)
    first = next(k for k, t in enumerate(shown) if t is not TARGET)
    assert 0.01 * first == pytest.approx(PATIENCE, abs=0.011)
    assert all(t.quaternion is shown[-1].quaternion for t in shown[first:])
    assert shown[-1].position == pytest.approx([0.0, 0.0, HEIGHT])
    assert rotations.matrix(shown[-1].quaternion)[2, 2] == pytest.approx(1.0)
    assert guidance.diagnostics()['unwound'] == 1


@pytest.mark.parametrize('low, high, unwinds', [
    (0.8, 1.4, True), (0.3, 0.95, False), (0.4, 1.4, False)])
def test_oscillation_about_the_limit_counts_as_missed_and_arrival_does_not(low, high, unwinds):
    guidance, shown = unwinding(), []
    for k in range(300):
        part = low + (high - low) * (0.5 + 0.5 * np.sin(2 * np.pi * 0.01 * k))
        attitude = rotations.multiply(TARGET.quaternion, rotations.exp(
            np.array([0, part * MISSED_ANGLE, 0])))
        shown.append(guidance.target(stuck(0.01 * k, quaternion=attitude), TARGET))
    assert any(t is not TARGET for t in shown) == unwinds


def test_the_target_returns_once_the_joints_are_unwound():
    guidance = unwinding()
    level = fly(guidance, 1.0)[-1]
    assert fly(guidance, 0.1, 1.0, quaternion=level.quaternion)[-1].quaternion is level.quaternion
    assert fly(guidance, 0.1, 1.1, quaternion=level.quaternion,
               tilt=np.full(4, 0.5))[-1] is TARGET


UPSIDE_DOWN = PoseTarget(np.array([0.0, 0.0, 1.5]), rotations.from_rpy(2.98, 0.02, 1.6))


def missed(target, seconds=1.0):
    """An unwinding at the start of its route through level, the attitude, and its target."""
    guidance = unwinding()
    off = rotations.multiply(target.quaternion, rotations.exp(np.array([0.0, 0.3, 0.0])))
    return guidance, fly(guidance, seconds, target=target, position=target.position,
                          quaternion=off)[-1]


def test_a_long_return_rotation_passes_an_attitude_halfway():
    guidance, level = missed(UPSIDE_DOWN)
    there = {'target': UPSIDE_DOWN, 'position': UPSIDE_DOWN.position, 'tilt': np.full(4, 0.5)}
    half = fly(guidance, 0.1, 1.0, quaternion=level.quaternion, **there)[-1]
    turns = [rotations.geodesic_angle(a.quaternion, b.quaternion)
             for a, b in ((level, half), (half, UPSIDE_DOWN), (level, UPSIDE_DOWN))]
    assert turns[0] == pytest.approx(turns[1]) == pytest.approx(turns[2] / 2)
    shown = fly(guidance, 0.1, 1.1, quaternion=level.quaternion, **there)[-1]
    assert shown.quaternion is half.quaternion
    near = rotations.multiply(half.quaternion, rotations.exp(np.array([0.0, 0.0, 0.4])))
    assert fly(guidance, 0.1, 1.2, quaternion=near, **there)[-1] is UPSIDE_DOWN


def test_the_number_of_attempts_is_limited_and_the_target_returns():
    guidance = unwinding()
    shown = fly(guidance, 30.0)
    away = sum(t is not TARGET for t in shown) * 0.01
    assert guidance.diagnostics()['unwound'] == ATTEMPTS
    assert away == pytest.approx(ATTEMPTS * DURATION, abs=0.1)
    assert shown[-1] is TARGET


PLACE = np.array([0.5, -0.5, 1.5])
# Inverted with two joints wound by half a turn; the target would wind them further.
START, TILT = rotations.from_rpy(np.pi - 0.2, 0.3, 0.0), np.array([-3.0, -2.9, 3.0, 2.9])
END = rotations.from_rpy(0.7, 0.1, 0.3)     # its direct rotation winds joints up to 5.8 rad


def inverted(attitude, **changed):
    return PoseTarget(**{'position': PLACE, 'quaternion': attitude, **changed})


def wound_state(stamp=0.0, quaternion=START):
    return state(stamp, position=PLACE, quaternion=quaternion, tilt=TILT)


def test_a_route_is_searched_once_for_each_attitude_and_again_after_reset():
    routing, given = Guidance(AXES, 'unwinding, trimming'), inverted(END)
    between = routing.target(wound_state(), given).quaternion
    for off, passed in ((NEAR + 0.05, False), (NEAR - 0.05, True)):
        near = rotations.multiply(between, rotations.exp(np.array([0.0, off, 0.0])))
        assert (routing.target(wound_state(0.1, near), given) is given) == passed
    little = rotations.multiply(END, rotations.exp(np.array([0.1, 0.0, 0.0])))
    for same in (inverted(END), inverted(END, position=PLACE + 1), inverted(little)):
        assert routing.target(wound_state(5.0), same) is same
    assert routing.target(wound_state(6.0), inverted(START)).quaternion is START    # no turn
    assert routing.target(wound_state(7.0), inverted(END)).quaternion is not END
    assert routing.diagnostics()['routed'] == 2
    routing.reset()
    assert routing.diagnostics()['routed'] == 0
    assert routing.target(wound_state(8.0), inverted(END)).quaternion is not END


def test_a_far_target_is_nearer_at_first_in_its_direction_at_its_height_and_attitude():
    guidance, target = Guidance(AXES, 'unwinding, trimming'), inverted(START, position=PLACE + 4)
    for stamp, distance in ((7.0, 1.5), (6.0, 1.5), (7.2, 2.5), (7.6, 4.5), (8.0, 32 ** 0.5)):
        shown = guidance.target(wound_state(stamp), target)
        assert shown.position - PLACE == pytest.approx([distance / 2 ** 0.5] * 2 + [4.0])
        assert shown.quaternion is START
    again = guidance.target(wound_state(9.0), inverted(START, position=PLACE - 4))
    assert again.position - PLACE == pytest.approx([-1.5 / 2 ** 0.5] * 2 + [-4.0])


@pytest.mark.parametrize('stamp, height, speed, dives', [
    (0.3, 0.1, -1, True), (0.3, 0.1, -0.5, False), (0.3, -0.5, 0.1, False), (2.0, 0.1, -1, False)])
def test_the_target_is_higher_while_the_robot_dives_at_first(stamp, height, speed, dives):
    guidance = Guidance(AXES)
    for now, z, v in ((0.0, 0.2, 0.0), (stamp, height, speed)):     # [m] above the target
        shown = guidance.target(state(now, (0, 0, -z), velocity=np.array([0, 0, v])), GOAL)
    assert shown.position == pytest.approx(GOAL.position + [0, 0, RAISE * dives])


def test_layers_that_are_off_do_not_act_and_are_not_in_the_description():
    assert Guidance(AXES).text == 'unwinding, routing, easing, trimming, gravity'
    assert Guidance(AXES, 'trimming, routing').text == 'unwinding, easing, gravity'
    bare = Guidance(AXES, 'all')
    assert bare.text == 'none' and fly(bare, 2.0)[-1] is TARGET
    assert bare.target(wound_state(), inverted(END)).quaternion is END
    with pytest.raises(ParameterError, match=r"'without'.*gravity or all, found 'turning'"):
        Guidance(AXES, 'turning')
