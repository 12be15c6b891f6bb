"""Guidance as a wrapper of any controller: targets, trim, reach, description."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, State, TrajectoryTarget
from beetle_omni_ros.control.guidance.guidance import Guidance, GuidanceParameters, Guided
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

AXES = RobotParameters.load().tilt_axes
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


class TargetRecorder:
    """A controller that stores its targets."""

    period = 0.01

    def __init__(self):
        self.shown, self.health = [], None

    def reset(self):
        self.shown.clear()

    def step(self, state, target):
        self.shown.append(target)
        return Command(state.stamp, np.zeros(4), np.full(4, 7.5))

    def set_health(self, health):
        self.health = health


def state_at(stamp, position, command, quaternion=LEVEL):
    return State(stamp, np.array(position, dtype=float), np.zeros(3), quaternion, np.zeros(3),
                 np.zeros(4), np.zeros(4), stamp, command)


def rest(guided, command_of, steps=200):
    """Stand 2 cm beside a target; the command in force is ``command_of(the last given)``."""
    target, given = PoseTarget(np.array([0.0, 0.0, 1.0]), LEVEL), None
    for k in range(steps):
        given = guided.step(state_at(0.01 * k, (0.02, 0, 1), command_of(given)), target)


def test_guidance_removes_the_steady_error_of_any_controller():
    keeper = TargetRecorder()
    rest(Guided(keeper, Guidance(GuidanceParameters(), AXES)), lambda given: given)
    assert keeper.shown[-1].position[0] < -0.01         # against the error, by its integral


def test_the_trim_does_not_change_while_another_controller_is_active():
    keeper = TargetRecorder()
    other = Command(0.0, np.full(4, 0.1), np.full(4, 7.0))
    rest(Guided(keeper, Guidance(GuidanceParameters(), AXES)), lambda given: other)
    assert np.array_equal(keeper.shown[-1].position, [0.0, 0.0, 1.0])


def test_a_low_target_is_raised_during_a_large_rotation():
    keeper = TargetRecorder()
    guided = Guided(keeper, Guidance(GuidanceParameters(), AXES))
    target = PoseTarget(np.array([0.0, 0.0, 0.5]), rotations.exp(np.array([1.5, 0.0, 0.0])))
    guided.step(state_at(0.0, (0, 0, 0.5), None), target)
    assert keeper.shown[0].position[2] == GuidanceParameters().turning.height


def test_trajectories_pass_unchanged_and_actuator_health_is_forwarded():
    keeper = TargetRecorder()
    guided = Guided(keeper, Guidance(GuidanceParameters(), AXES))
    way = TrajectoryTarget(np.array([0.0, 1.0]), np.zeros((2, 3)), np.tile(LEVEL, (2, 1)),
                           np.zeros((2, 3)), np.zeros((2, 3)))
    guided.step(state_at(0.0, (0, 0, 1), None), way)
    assert keeper.shown == [way]
    guided.set_health('as it is')
    assert keeper.health == 'as it is'
    guided.reset()
    assert not keeper.shown and guided.diagnostics() == {'unwound': 0, 'routed': 0}


def test_guidance_reports_the_reach_of_its_controller():
    keeper = TargetRecorder()
    assert Guided(keeper, Guidance(GuidanceParameters(), AXES)).reach == np.inf
    keeper.reach = 3.0
    assert Guided(keeper, Guidance(GuidanceParameters(), AXES)).reach == 3.0


def test_layers_that_are_off_do_not_act_and_are_not_in_the_description():
    keeper = TargetRecorder()
    assert Guidance(GuidanceParameters(), AXES).text == 'unwinding, routing, turning, trimming'
    off = Guidance(GuidanceParameters(without='trimming, routing'), AXES)
    assert off.text == 'unwinding, turning'
    rest(Guided(keeper, off), lambda given: given)
    assert np.array_equal(keeper.shown[-1].position, [0.0, 0.0, 1.0])
    bare = Guidance(GuidanceParameters(without='all'), AXES)
    low = PoseTarget(np.array([0.0, 0.0, 0.5]), rotations.exp(np.array([1.5, 0.0, 0.0])))
    assert bare.text == 'none' and bare.target(state_at(0.0, (0, 0, 0.5), None), low) is low
    with pytest.raises(ParameterError, match=r"'without'.*trimming or all, found 'trim'"):
        GuidanceParameters(without='trim')
