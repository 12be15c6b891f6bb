"""The interface of a controller, and its host: target in force, stopped motors, exceptions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from beetle_omni_ros.control.base import (
    Command,
    ControllerHost,
    PoseTarget,
    State,
    TrajectoryTarget,
)
from beetle_omni_ros.model.allocation import ActuatorHealth
from beetle_omni_ros.model.mode import Mode

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


class Own:
    """Stand-in for a controller that notes its calls."""

    period, reach = 0.01, 6.5

    def __init__(self):
        self.targets, self.states, self.resets = [], [], 0

    def reset(self):
        self.resets += 1

    def step(self, state, target):
        self.states.append(state)
        self.targets.append(target)
        return Command(state.stamp, np.zeros(4), np.ones(4))


def at(x, stamp=0.0):
    return PoseTarget(np.array([x, 0.0, 1.0]), LEVEL, stamp)


def state(x=0.0, stamp=0.0):
    return State(stamp, np.array([x, 0.0, 1.0]), np.zeros(3), LEVEL, np.zeros(3), np.zeros(4),
                 np.zeros(4), stamp)


def flown(host, x):
    """X of the target to which the controller steps from ``x``."""
    host.on_estimate(state(x))
    assert host.step(state(x)) is not None
    return host.controller.targets[-1].position[0]


def test_without_a_target_the_pose_of_the_takeover_is_held():
    host = ControllerHost('own', Own())
    host.on_mode(Mode('takeoff'), 0.0)
    assert [flown(host, x) for x in (1.0, 2.0)] == [1.0, 2.0]
    host.on_mode(Mode('flying:own'), 0.0)
    assert [flown(host, x) for x in (3.0, 4.0)] == [2.0, 2.0]
    host.target = at(5.0)
    assert flown(host, 4.0) == 5.0
    host.override = at(6.0)
    assert flown(host, 4.0) == 6.0


@pytest.mark.parametrize('stopped', ['disarmed', 'emergency_stop:crash'])
def test_motors_that_stop_clear_hold_and_override_once_and_keep_the_target(stopped):
    host = ControllerHost('own', Own())
    host.on_mode(Mode('flying:own'), 0.0)
    assert flown(host, 1.0) == flown(host, 2.0) == 1.0
    host.override = at(6.0)
    host.on_mode(Mode(stopped), 0.0)
    host.on_mode(Mode(f'{stopped}:again'), 0.0)
    assert host.override is None and host.controller.resets == 1
    assert flown(host, 3.0) == 3.0
    host.target = at(5.0)
    host.on_mode(Mode('emergency_stop' if stopped == 'disarmed' else 'disarmed'), 0.0)
    assert flown(host, 3.0) == 5.0 and host.controller.resets == 2


def test_a_target_beyond_the_reach_is_dropped_at_the_takeover_only():
    host = ControllerHost('own', Own())
    assert host.too_far(at(17.0), 0.0) == ''        # the position is unknown
    host.on_estimate(state(10.0))
    assert host.too_far(at(16.0), 0.0) == ''
    assert host.too_far(at(17.0), 0.0).startswith('7 m from the robot, expected at most 6.5')
    track = TrajectoryTarget(np.array([0.0, 10.0]), np.array([[0, 0, 1.0], [10.0, 0, 1]]),
                             np.array([LEVEL, LEVEL]), np.zeros((2, 3)), np.zeros((2, 3)))
    assert host.too_far(track, 0.0) and not host.too_far(track, 5.0)
    host.target = at(17.0)
    assert host.on_mode(Mode('flying:other'), 0.0) == '' and flown(host, 10.0) == 17.0
    assert '7 m from the robot' in host.on_mode(Mode('flying:own'), 0.0)
    assert flown(host, 10.0) == 10.0
    host.target = at(17.0)
    assert host.on_mode(Mode('flying:own'), 0.0) == '' and flown(host, 10.0) == 17.0


@pytest.mark.parametrize('part', ['velocity', 'tilt'])
def test_a_state_that_is_not_finite_does_not_reach_the_controller(part):
    host, good = ControllerHost('own', Own()), state()
    host.on_estimate(good)
    bad = getattr(good, part).copy()
    bad[1] = np.nan
    assert host.step(replace(good, **{part: bad})) is None and not host.controller.states
    assert host.step(good) is not None and host.errors == 0


@pytest.mark.parametrize('method', ['step', 'reset', 'set_health'])
def test_an_exception_of_any_method_is_counted_and_reported(method):
    reported = []

    def fail(*_):
        raise ValueError('bad')

    host = ControllerHost('own', Own(), report=reported.append)
    setattr(host.controller, method, fail)
    for _ in range(2):
        host.on_mode(Mode('flying:own'), 0.0)
        host.on_mode(Mode('disarmed'), 0.0)
        host.on_health(SimpleNamespace(zeros=ActuatorHealth().zeros))
        host.on_estimate(state())
        assert (host.step(state()) is None) == (method == 'step')
    assert host.errors == len(reported) == 2
    assert host.error == reported[0] and host.error.startswith(
        f"controller 'own': {method} raised ValueError: bad (test_host.py:")


@pytest.mark.parametrize('wrong', [None, Command(0.0, [0] * 4, np.ones(4)),
                                   Command(0.0, np.zeros(4), np.ones(3))], ids=str)
def test_a_return_value_of_step_that_is_no_command_is_an_error(wrong):
    host = ControllerHost('own', Own())
    host.controller.step = lambda state, target: wrong
    host.on_estimate(state())
    assert host.step(state()) is None and host.errors == 1
    assert host.error.startswith(f"controller 'own': step returned {wrong}, expected a Command")
