"""Raised targets during large rotations; other targets pass unchanged."""

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.guidance.turning import Turning, TurningParameters
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters

P = TurningParameters()
LEVEL = rotations.from_rpy(0.0, 0.0, 0.0)
FAR, NEAR = rotations.from_rpy(2.0, 0.0, 0.0), rotations.from_rpy(0.3, 0.0, 0.0)


def state(quaternion, height=1.0, sinking=0.0, place=(0.0, 0.0)):
    return State(0.0, np.array([*place, height]), np.array([0.0, 0.0, -sinking]),
                 np.asarray(quaternion, float), np.zeros(3), np.zeros(4), np.zeros(4),
                 tilt_stamp=0.0)


def pose(height=1.5, quaternion=LEVEL, place=(0.3, -0.4)):
    return PoseTarget(np.array([*place, height]), quaternion)


@given(st.floats(0.2, 2.5), st.floats(0.0, 3.1), st.floats(-3, 3))
def test_only_low_targets_with_a_large_rotation_are_raised(height, angle, yaw):
    target = pose(height, rotations.from_rpy(0.0, 0.0, yaw))
    away = rotations.multiply(target.quaternion, rotations.exp(np.array([angle, 0.0, 0.0])))
    shown = Turning(P).target(state(away), target)
    if height >= P.height or angle < P.angle - 1e-6:
        assert shown is target
    elif angle > P.angle + 1e-6:
        assert shown.position == pytest.approx([0.3, -0.4, P.height])
        assert shown.quaternion is target.quaternion and target.position[2] == height


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(1.0, 4.0), st.floats(0.0, 3.1))
def test_the_distance_of_an_inverted_target_is_limited_during_a_large_rotation(x, y, z, angle):
    target, now = pose(z, place=(x, y)), state(rotations.from_rpy(angle, 0.0, 0.0), 1.0)
    shown, way = Turning(P).target(now, target), target.position - now.position
    if angle < np.pi / 2 - 1e-6 or np.linalg.norm(way) <= P.distance:
        assert shown is target
    elif angle > np.pi / 2 + 1e-6:
        step = shown.position - now.position
        assert np.linalg.norm(step) == pytest.approx(P.distance)
        assert np.cross(step, way) == pytest.approx(np.zeros(3), abs=1e-9) and step @ way > 0


def test_an_inverted_far_target_passes_unchanged_once_the_rotation_is_small():
    turned = rotations.from_rpy(3.0, 0.0, 0.0)
    target = pose(1.5, rotations.from_rpy(2.5, 0.0, 0.0), place=(4.0, 0.0))
    assert Turning(P).target(state(turned), target) is target


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
    turning, target = Turning(P), pose(1.5)
    turning.target(state(attitude, begin), target)
    shown = turning.target(state(attitude, height, sinking), target)
    assert shown.position[:2] == pytest.approx([0.3, -0.4])
    assert shown.position[2] == pytest.approx(1.5 + P.climb if caught else 1.5)
    off = Turning(replace(P, climb=0.0))
    off.target(state(attitude, begin), target)
    assert off.target(state(attitude, height, sinking), target) is target


def test_a_new_target_restarts_at_the_robot_and_a_repeated_one_does_not():
    turning = Turning(P)
    turning.target(state(FAR, 1.3), pose(1.5))
    assert turning.target(state(FAR, 1.1), pose(1.5)).position[2] > 1.5
    assert turning.target(state(FAR, 1.1), pose(1.5, place=(0.5, 0.0))).position[2] == 1.5
    turning.reset()
    assert turning.target(state(FAR, 0.7), pose(1.5)).position[2] == 1.5


def test_intermediate_attitudes_are_raised_in_the_same_way():
    turning, target = Turning(P), pose(0.4, LEVEL)
    between = replace(target, quaternion=NEAR)
    shown = turning.target(state(NEAR), target, between)
    assert shown.quaternion is NEAR and shown.position[2] == P.height
    assert turning.target(state(NEAR), target, target) is target


@pytest.mark.parametrize('broken', ['quaternion', 'height'])
def test_for_a_state_that_is_not_finite_the_target_passes_unchanged(broken):
    target, turning = pose(0.4), Turning(P)
    bad = state(np.full(4, np.nan)) if broken == 'quaternion' else state(LEVEL, np.nan)
    assert turning.target(bad, target) is target
    assert turning.target(state(FAR, 0.2), target).position[2] == P.height + P.climb


@pytest.mark.parametrize('angle, climbs', [(2.0, True), (0.5, False)])
def test_the_policy_turns_above_a_low_target(angle, climbs):
    """At the position of the target, the results differ by the required lift only."""
    robot, lift = RobotParameters.load(), []
    for height in (0.3, 1.5):
        controller = PolicyController(robot, PolicyParameters.load())
        target = PoseTarget(np.array([0.0, 0.0, height]), rotations.from_rpy(0.0, 0.0, 0.0))
        turned = state(rotations.from_rpy(0.0, 0.0, angle), height)
        for _ in range(20):
            command = controller.step(turned, target)
        lift.append(command.thrust.sum())
    assert (lift[0] > lift[1] + 1.0) == climbs
