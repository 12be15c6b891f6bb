"""The component that steps a controller: target in force, stopped motors, exceptions."""

from dataclasses import replace

from desk import Desk
import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.flight.stack import ControllerComponent
from beetle_omni_ros.model.allocation import ActuatorHealth
from beetle_omni_ros.model.mode import Mode
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.readings import JointReading
from beetle_omni_ros.model.rotations import BodyState

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
ROBOT = RobotParameters.load()


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


@pytest.fixture
def desk():
    return Desk(ControllerComponent('own', Own(), ROBOT), 100.0)


def enter(desk, *states):
    for state in states:
        desk.component.feed('supervisor/state', Mode(state))


def at(x, stamp):
    return PoseTarget(np.array([x, 0.0, 1.0]), LEVEL, stamp)


def aim(desk, x):
    """X of the target of the component after the offer of another one."""
    desk.component.feed('target_pose', at(x, desk.time), published=np.nan)
    return desk.component.target.position[0]


def fly(desk, x=0.0, velocity=0.0, tilt=0.0):
    """Feed an estimate and joints, a second later."""
    desk.time += 1.0
    desk.component.feed('joint_states', JointReading(desk.time, np.full(4, tilt), np.zeros(4)))
    desk.component.feed('odom', BodyState(desk.time, np.array([x, 0.0, 1.0]),
                                          np.array([0.0, velocity, 0.0]), LEVEL, np.zeros(3)))


def flown(desk, x):
    """X of the target to which the controller steps from ``x``."""
    before = len(desk.values('own/command'))
    fly(desk, x)
    assert len(desk.values('own/command')) == before + 1
    return desk.component.controller.targets[-1].position[0]


def test_without_a_target_the_pose_of_the_takeover_is_held(desk):
    enter(desk, 'takeoff')
    assert [flown(desk, x) for x in (1.0, 2.0)] == [1.0, 2.0]
    enter(desk, 'flying:own')
    assert [flown(desk, x) for x in (3.0, 4.0)] == [2.0, 2.0]
    aim(desk, 5.0)
    assert flown(desk, 4.0) == 5.0
    desk.component.feed('supervisor/target', at(6.0, desk.time))
    assert flown(desk, 4.0) == 6.0


@pytest.mark.parametrize('stopped', ['disarmed', 'emergency_stop:crash'])
def test_motors_that_stop_clear_hold_and_override_once_and_keep_the_target(desk, stopped):
    component = desk.component
    enter(desk, 'flying:own')
    assert flown(desk, 1.0) == flown(desk, 2.0) == 1.0
    component.feed('supervisor/target', at(6.0, desk.time))
    enter(desk, stopped, f'{stopped}:again')
    assert component.override is None and component.controller.resets == 1
    assert flown(desk, 3.0) == 3.0
    aim(desk, 5.0)
    enter(desk, 'emergency_stop' if stopped == 'disarmed' else 'disarmed')
    assert flown(desk, 3.0) == 5.0 and component.controller.resets == 2


def test_a_target_beyond_the_reach_is_refused_in_flight(desk):
    component = desk.component
    enter(desk, 'flying:own')
    assert aim(desk, 17.0) == 17.0      # the position is unknown
    assert flown(desk, 10.0) == 17.0
    assert aim(desk, 16.0) == 16.0 and aim(desk, 17.0) == 16.0
    assert component.inputs['target_pose'].last_refusal.startswith(
        '7 m from the robot, expected at most 6.5')
    track = TrajectoryTarget(
        desk.time + np.array([0.0, 10.0]), np.array([[0, 0, 1.0], [10.0, 0, 1]]),
        np.array([LEVEL, LEVEL]), np.zeros((2, 3)), np.zeros((2, 3)), desk.time)
    later = replace(track, times=track.times - 5.0)     # now at 5 m
    for target in (track, later):
        component.feed('target_trajectory', target, published=np.nan)
        assert (component.target is target) == (target is later)


def test_a_target_beyond_the_reach_is_dropped_at_the_takeover_only(desk):
    component = desk.component
    enter(desk, 'flying:other')
    fly(desk, 10.0)
    assert aim(desk, 17.0) == 17.0 and flown(desk, 10.0) == 17.0
    enter(desk, 'flying:own')
    assert '7 m from the robot' in component.inputs['target_pose'].last_refusal
    assert flown(desk, 10.0) == 10.0
    component.target = at(17.0, desk.time)
    enter(desk, 'flying:own')
    assert flown(desk, 10.0) == 17.0


@pytest.mark.parametrize('part', ['velocity', 'tilt'])
def test_a_state_that_is_not_finite_does_not_reach_the_controller(desk, part):
    component = desk.component
    fly(desk, **{part: np.inf})
    assert not component.controller.states and not desk.sent
    assert flown(desk, 0.0) == 0.0 and component.errors == 0


@pytest.mark.parametrize('method', ['step', 'reset', 'set_health'])
def test_an_exception_of_any_method_is_counted_and_logged(desk, method):
    def fail(*_):
        raise ValueError('bad')

    component = desk.component
    setattr(component.controller, method, fail)
    for _ in range(2):
        enter(desk, 'flying:own', 'disarmed')
        component.feed('supervisor/actuators', ActuatorHealth())
        fly(desk)
    assert len(desk.values('own/command')) == (0 if method == 'step' else 2)
    assert component.errors == len(desk.lines) == 2
    assert desk.lines[0] == f'error: {component.error}' and component.error.startswith(
        f"controller 'own': {method} raised ValueError: bad (test_controllers.py:")


@pytest.mark.parametrize('wrong', [None, Command(0.0, [0] * 4, np.ones(4)),
                                   Command(0.0, np.zeros(4), np.ones(3))], ids=str)
def test_a_return_value_of_step_that_is_no_command_is_an_error(desk, wrong):
    component = desk.component
    component.controller.step = lambda state, target: wrong
    fly(desk)
    assert not desk.sent and component.errors == 1
    assert component.error.startswith(
        f"controller 'own': step returned {wrong}, expected a Command")
