"""Low targets are turned to above them, and nothing else changes."""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.control.turning import raised, TurningParameters
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters

P = TurningParameters()


def state(quaternion, height=1.0):
    return State(0.0, np.array([0.0, 0.0, height]), np.zeros(3), np.asarray(quaternion, float),
                 np.zeros(3), np.zeros(4), np.zeros(4), tilt_stamp=0.0)


@given(st.floats(0.2, 2.5), st.floats(0.0, 3.1), st.floats(-3, 3))
def test_only_a_low_target_far_to_turn_to_is_shown_higher(height, angle, yaw):
    target = PoseTarget(np.array([0.3, -0.4, height]), rotations.from_rpy(0.0, 0.0, yaw))
    away = rotations.multiply(target.quaternion, rotations.exp(np.array([angle, 0.0, 0.0])))
    shown = raised(state(away), target, P)
    if height >= P.height or angle < P.angle - 1e-6:
        assert shown is target
    elif angle > P.angle + 1e-6:
        assert shown.position == pytest.approx([0.3, -0.4, P.height])
        assert shown.quaternion is target.quaternion and target.position[2] == height


def test_a_state_that_is_not_finite_sees_the_target():
    target = PoseTarget(np.array([0.0, 0.0, 0.4]), rotations.from_rpy(0.0, 0.0, 0.0))
    assert raised(state(np.full(4, np.nan)), target, P) is target


@pytest.mark.parametrize('angle, climbs', [(2.0, True), (0.5, False)])
def test_the_policy_turns_above_a_low_target(angle, climbs):
    """At the target's place already: what differs is whether it asks for lift."""
    robot, lift = RobotParameters.load(), []
    for height in (0.3, 1.5):
        controller = PolicyController(robot, PolicyParameters.load())
        target = PoseTarget(np.array([0.0, 0.0, height]), rotations.from_rpy(0.0, 0.0, 0.0))
        turned = state(rotations.from_rpy(0.0, 0.0, angle), height)
        for _ in range(20):
            command = controller.step(turned, target)
        lift.append(command.thrust.sum())
    assert (lift[0] > lift[1] + 1.0) == climbs
