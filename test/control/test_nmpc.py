"""The NMPC in closed loop with the CasADi model as plant, with its delay."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, State, TrajectoryTarget
from beetle_omni_ros.control.disturbance import FunctionCall
from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import ParameterError

ROBOT = RobotParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def hovering(position=(0.0, 0.0, 1.0)):
    x = np.zeros(25)
    x[:3], x[9], x[21:] = position, 1.0, ROBOT.hover_thrust
    return x


def fly(controller, target, seconds, x=None, plant=ROBOT, disturbance=np.zeros(10), start=0.0):
    """Closed loop at 100 Hz; a command acts 10 ms after the state that it answers."""
    advance = FunctionCall(model.integrator(plant, 4))
    x = hovering() if x is None else x
    command = Command(start - 0.01, x[13:17], x[21:25])
    trace = []
    for k in range(round(seconds / 0.01)):
        time = start + 0.01 * k
        state = State(time, x[:3], x[3:6], x[6:10], x[10:13], x[13:17], x[17:21], time, command)
        following = controller.step(state, target)
        x = advance(x, np.r_[command.tilt, command.thrust], disturbance, 0.01)
        command = following
        trace.append((time + 0.01, x, command))
    return trace


def errors(trace, target):
    time, x, _ = trace[-1]
    reference = target.at(time)
    return (np.linalg.norm(x[:3] - reference.position),
            np.degrees(rotations.geodesic_angle(x[6:10], reference.quaternion)))


@pytest.fixture(scope='module')
def controller():
    return NmpcController(ROBOT, NmpcParameters.load())


@pytest.fixture(autouse=True)
def fresh(controller):
    controller.reset()


@pytest.mark.parametrize('rpy', [(180, 0, 0), (0, 180, 0), (0, 0, 180), (90, 0, 0),
                                 (-60, 80, 170)])
def test_reaches_inverted_poses_without_error(controller, rpy):
    target = PoseTarget(np.array([1.0, -1.0, 1.5]), rotations.from_rpy(*np.radians(rpy)))
    position, angle = errors(fly(controller, target, 6.0), target)
    assert position < 2e-3
    assert angle < 0.2


def test_holds_a_pose_for_which_a_joint_is_barely_beyond_its_stop():
    attitude = rotations.from_rpy(*np.radians([154.2, -47.0, 32.1]))
    held = Allocator(ROBOT).hover(attitude, np.array([-3.96, 2.0, 3.96, -2.0]))
    stop = np.abs(held.tilt).max() - 0.02
    robot = replace(ROBOT, joints=replace(ROBOT.joints, position_limit=stop))
    target = PoseTarget(np.array([0.0, 0.0, 1.5]), attitude)
    x = np.r_[target.position, np.zeros(3), attitude, np.zeros(3),
              np.clip(held.tilt, -stop, stop), np.zeros(4), held.thrust]
    trace = fly(NmpcController(robot), target, 4.0, x=x)
    position, angle = errors(trace, target)
    assert position < 5e-3 and angle < 1.0
    assert max(np.abs(command.tilt - held.tilt).max() for _, _, command in trace) < 1.0


@pytest.mark.parametrize('changes', [
    {'effects': {'thrust_coefficient': {'scale': 0.93}}},
    {'effects': {'mass': {'mass': 1.05 * ROBOT.mass}}},
    {'effects': {'rotor_thrust_coefficient': {'scale': [0.95, 1.0, 1.03, 1.0]}}},
    {'effects': {'wind': {'force': [2.0, -1.0, 1.0]}}},
], ids=['weak rotors', 'heavy', 'uneven rotors', 'wind'])
def test_an_unknown_constant_disturbance_leaves_no_steady_error(controller, changes):
    target = PoseTarget(np.array([0.5, 0.0, 1.2]), rotations.from_rpy(0.6, -0.3, 0.2))
    plant = replace(ROBOT, **changes)
    position, angle = errors(fly(controller, target, 7.0, plant=plant), target)
    assert position < 2e-3
    assert angle < 0.1


def test_servo_offsets_and_torque_are_estimated(controller):
    target = PoseTarget(np.array([0.0, 0.0, 1.0]), LEVEL)
    disturbance = np.r_[np.zeros(3), [0.1, -0.05, 0.03], [0.02, -0.01, 0.015, 0.0]]
    trace = fly(controller, target, 6.0, disturbance=disturbance)
    assert errors(trace, target) == pytest.approx((0, 0), abs=5e-2)
    assert np.allclose(controller.disturbance[6:], disturbance[6:], atol=2e-3)
    assert np.allclose(controller.disturbance[3:6], disturbance[3:6], atol=1e-2)


def test_a_moving_reference_is_tracked_with_preview(controller):
    time = np.arange(0, 8, 0.02)
    phase = 2 * np.pi * time / 8
    positions = np.stack([np.sin(phase), np.zeros_like(time), 1 + 0 * time], axis=1)
    velocities = np.stack([2 * np.pi / 8 * np.cos(phase), 0 * time, 0 * time], axis=1)
    target = TrajectoryTarget(time, positions, np.tile(LEVEL, (len(time), 1)), velocities,
                              np.zeros_like(positions))
    x = hovering((0.0, 0.0, 1.0))
    x[3] = 2 * np.pi / 8
    trace = fly(controller, target, 6.0, x=x)
    assert errors(trace, target)[0] < 0.004   # at 0.8 m/s: 5 ms


def test_commands_keep_the_limits_whatever_the_target(controller):
    target = PoseTarget(np.array([50.0, 0.0, 80.0]), rotations.from_rpy(3.0, 0.2, 1.0))
    for _, _, command in fly(controller, target, 0.5):
        assert np.all((command.thrust >= 0) & (command.thrust <= ROBOT.rotors.thrust_max))
        assert np.all(np.abs(command.tilt) <= ROBOT.joints.position_limit)


def test_the_same_flight_results_after_reset(controller):
    target = PoseTarget(np.array([1.0, 0.0, 1.0]), rotations.from_rpy(1.0, 0, 0))
    first = fly(controller, target, 0.5)
    controller.reset()
    second = fly(controller, target, 0.5)
    assert np.array_equal(first[-1][1], second[-1][1])


def test_without_a_compiler_the_cause_is_named(monkeypatch):
    monkeypatch.setenv('CC', 'no-such-compiler')
    with pytest.raises(ParameterError, match='needs a C compiler: no C compiler found'):
        NmpcController(ROBOT)


def test_a_nan_state_repeats_the_plan_and_does_not_poison_the_next_cycles(controller):
    target = PoseTarget(np.array([0.0, 0.0, 1.0]), LEVEL)
    _, x, command = fly(controller, target, 0.2)[-1]
    bad = State(0.2, np.full(3, np.nan), x[3:6], x[6:10], x[10:13], x[13:17], x[17:21], 0.2, None)
    repeated = controller.step(bad, target)
    assert np.allclose(repeated.thrust, command.thrust, atol=0.2)
    assert controller.diagnostics()['rejected_states'] == 1
    moved = PoseTarget(np.array([0.5, 0.0, 1.0]), rotations.from_rpy(0.5, 0, 0))
    trace = fly(controller, moved, 5.0, start=0.21)
    assert errors(trace, moved) == pytest.approx((0, 0), abs=2e-2)


@pytest.mark.parametrize('robot, field, expected', [
    ({'joints': {'kd': 0.02}}, 'servo_lag', 0.02 / ROBOT.joints.kp),
    ({'joints': {'kd': 0.0}}, 'servo_lag', np.sqrt(ROBOT.joints.inertia / ROBOT.joints.kp)),
    ({'joints': {'velocity_limit': 5.0}}, 'tilt_rate', 3.5),
    ({'joints': {'position_limit': 3.0}}, 'tilt', 3.0),
    ({'rotors': {'thrust_max': 15.0}}, 'thrust_max', 15.0)])
def test_actuators_of_the_problem_are_those_of_the_robot(robot, field, expected):
    (part, change), = robot.items()
    changed = replace(ROBOT, **{part: replace(getattr(ROBOT, part), **change)})
    p = NmpcParameters.load()
    assert getattr(p.actuators(changed), field) == pytest.approx(expected)
    other = {'servo_lag': 0.05, 'tilt': 2.0, 'thrust_max': 30.0}.get(field)
    if other:       # nmpc.yaml overrides the robot file
        part = 'model' if field == 'servo_lag' else 'limits'
        own = replace(p, **{part: replace(getattr(p, part), **{field: other})})
        assert getattr(own.actuators(changed), field) == other


def test_the_published_settings_are_unchanged():
    p = NmpcParameters.load(share_path('params/nmpc_published.yaml'))
    assert not p.model.rotor_lag
    assert p.horizon.intervals.tolist() == [0.1] * 20
    assert p.limits.velocity == 1.0
    assert p.actuators(ROBOT) == (0.048, 3.15, 10.0, 30.0)
    assert (p.weights.position_xy, p.weights.position_z, p.weights.tilt) == (300, 400, 2)
    assert (p.weights.tilt_change, p.weights.thrust_command) == (250, 2)
    assert not p.limits.soft
    assert p.unwind > 2 * np.pi
