"""Guidance: trimmed steady errors, raised targets in large turns, layers that are off."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.control.guidance import (
    Charge,
    CLIMB,
    Guidance,
    LARGE,
    Trimming,
    TURN_DISTANCE,
    TURN_HEIGHT,
    Turning,
)
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

ROBOT = RobotParameters.load()
TARGET = PoseTarget(np.array([0.4, -0.3, 1.5]), rotations.from_rpy(0.8, -0.5, 2.0), stamp=3.0)
SMALL = st.tuples(*[st.floats(-0.03, 0.03)] * 3).map(np.array)


def state(stamp, way=(0, 0, 0), turn=(0, 0, 0), target=TARGET, **changed):
    """State of a robot with an offset from a target, a vector in world and a rotation."""
    values = {'position': target.position - np.array(way), 'velocity': np.zeros(3),
              'quaternion': rotations.multiply(target.quaternion, rotations.conjugate(
                  rotations.exp(np.array(turn, dtype=float)))),
              'angular_velocity': np.zeros(3), **changed}
    return State(stamp, **values, tilt=np.zeros(4), tilt_velocity=np.zeros(4), tilt_stamp=stamp)


def wait(trimming, seconds, begin=0.0, target=TARGET, **where):
    for k in range(round(100 * seconds) + 1):
        shown = trimming.target(state(begin + 0.01 * k, target=target, **where), target)
    return shown


@settings(max_examples=20, deadline=None)
@given(SMALL, SMALL)
def test_a_constant_tracking_error_is_trimmed_to_zero(way, turn):
    """The robot follows with a time constant of 0.3 s, much faster than the integral."""
    trimming = Trimming()
    position, lag = np.zeros(3), np.zeros(3)
    for k in range(700):
        shown = trimming.target(state(0.01 * k, way - position, turn - lag), TARGET)
        asked = rotations.log(rotations.multiply(
            rotations.conjugate(TARGET.quaternion), shown.quaternion))
        position += 0.01 / 0.3 * (shown.position - TARGET.position - position)
        lag += 0.01 / 0.3 * (asked - lag)
    assert np.linalg.norm(way - position) < 0.03 * max(np.linalg.norm(way), 1e-3)
    assert np.linalg.norm(turn - lag) < 0.03 * max(np.linalg.norm(turn), 1e-3)
    assert shown.stamp == TARGET.stamp


@pytest.mark.parametrize('where', [
    {'way': (0.2, 0, 0)}, {'turn': (0, 0.5, 0)},
    {'way': (0.01, 0, 0), 'velocity': np.array([0, 0.3, 0])}, {'position': np.full(3, np.nan)}])
def test_the_trim_does_not_change_in_motion_or_for_nan_states(where):
    trimming = Trimming()
    shown = wait(trimming, 2.0, **where)
    assert shown.position == pytest.approx(TARGET.position)
    assert shown.quaternion == pytest.approx(TARGET.quaternion)


def test_the_trim_is_kept_for_equal_and_nearby_targets_only():
    trimming = Trimming()
    wait(trimming, 3.0, way=(0.02, 0, 0))
    found = list(trimming.position)
    again = PoseTarget(TARGET.position.copy(), TARGET.quaternion.copy(), stamp=9.0)
    near = replace(TARGET, position=TARGET.position + [0, 0.05, 0])
    for target in (again, near):
        shown = trimming.target(state(9.0, target=target), target)
        assert shown.position - target.position == pytest.approx(found)
    far = replace(TARGET, position=TARGET.position + [0, 0.5, 0])
    assert trimming.target(state(9.0, target=far), far).position == pytest.approx(far.position)


LEVEL = rotations.from_rpy(0.0, 0.0, 0.0)
FAR, NEAR = rotations.from_rpy(2.0, 0.0, 0.0), rotations.from_rpy(0.3, 0.0, 0.0)


def turned(quaternion, height=1.0, sinking=0.0, place=(0.0, 0.0)):
    return State(0.0, np.array([*place, height]), np.array([0.0, 0.0, -sinking]),
                 np.asarray(quaternion, float), np.zeros(3), np.zeros(4), np.zeros(4),
                 tilt_stamp=0.0)


def pose(height=1.5, quaternion=LEVEL, place=(0.3, -0.4)):
    return PoseTarget(np.array([*place, height]), quaternion)


@given(st.floats(0.2, 2.5), st.floats(0.0, 3.1), st.floats(-3, 3))
def test_only_low_targets_with_a_large_rotation_are_raised(height, angle, yaw):
    target = pose(height, rotations.from_rpy(0.0, 0.0, yaw))
    away = rotations.multiply(target.quaternion, rotations.exp(np.array([angle, 0.0, 0.0])))
    shown = Turning().target(turned(away), target)
    if height >= TURN_HEIGHT or angle < LARGE - 1e-6:
        assert shown is target
    elif angle > LARGE + 1e-6:
        assert shown.position == pytest.approx([0.3, -0.4, TURN_HEIGHT])
        assert shown.quaternion is target.quaternion and target.position[2] == height


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(1.0, 4.0), st.floats(0.0, 3.1))
def test_the_distance_of_an_inverted_target_is_limited_during_a_large_rotation(x, y, z, angle):
    target, now = pose(z, place=(x, y)), turned(rotations.from_rpy(angle, 0.0, 0.0), 1.0)
    shown, way = Turning().target(now, target), target.position - now.position
    if angle < np.pi / 2 - 1e-6 or np.linalg.norm(way) <= TURN_DISTANCE:
        assert shown is target
    elif angle > np.pi / 2 + 1e-6:
        step = shown.position - now.position
        assert np.linalg.norm(step) == pytest.approx(TURN_DISTANCE)
        assert np.cross(step, way) == pytest.approx(np.zeros(3), abs=1e-9) and step @ way > 0


@pytest.mark.parametrize('attitude, height, sinking, begin, caught', [
    (FAR, 1.25, 0.0, 1.3, False),        # above its start, less the depth
    (FAR, 1.15, 0.0, 1.3, True),
    (FAR, 1.3, 0.5, 1.3, True),          # it will be
    (FAR, 1.3, 0.3, 1.3, False),
    (FAR, 1.3, 0.5, 1.1, False),         # it began lower
    (FAR, 1.45, 0.1, 2.0, False),        # the target is lower than where it began
    (FAR, 1.35, 0.5, 2.0, True),
    (NEAR, 1.15, 0.5, 1.3, False),       # a small rotation
], ids=str)
def test_a_predicted_descent_below_start_and_target_raises_the_target(attitude, height, sinking,
                                                                      begin, caught):
    turning, target = Turning(), pose(1.5)
    turning.target(turned(attitude, begin), target)
    shown = turning.target(turned(attitude, height, sinking), target)
    assert shown.position[:2] == pytest.approx([0.3, -0.4])
    assert shown.position[2] == pytest.approx(1.5 + CLIMB if caught else 1.5)


def test_only_its_latest_commands_put_a_controller_in_charge():
    charge, at = Charge(), state(0.0)
    own = Command(0.0, np.full(4, 0.1), np.full(4, 7.0))
    charge.gave([0.1] * 4 + [7.0] * 4)
    assert charge.holds(replace(at, command=own)) and not charge.holds(at)
    assert not charge.holds(replace(at, command=replace(own, thrust=np.full(4, 7.1))))
    for k in range(10):
        charge.gave([0.2] * 4 + [float(k)] * 4)
    assert not charge.holds(replace(at, command=own))


def test_layers_that_are_off_do_not_act_and_are_not_in_the_description():
    assert Guidance(ROBOT.tilt_axes).text == 'unwinding, routing, turning, trimming'
    assert Guidance(ROBOT.tilt_axes, 'trimming, routing').text == 'unwinding, turning'
    low = PoseTarget(np.array([0.0, 0.0, 0.5]), rotations.exp(np.array([1.5, 0.0, 0.0])))
    bare = Guidance(ROBOT.tilt_axes, 'all')
    assert bare.text == 'none' and bare.target(turned(LEVEL, 0.5), low) is low
    shown = Guidance(ROBOT.tilt_axes).target(turned(LEVEL, 0.5), low)
    assert shown.position[2] == TURN_HEIGHT
    with pytest.raises(ParameterError, match=r"'without'.*trimming or all, found 'trim'"):
        Guidance(ROBOT.tilt_axes, 'trim')
