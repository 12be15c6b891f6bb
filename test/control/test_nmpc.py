"""The NMPC in closed loop with the CasADi model as plant, with its delay."""

from dataclasses import replace

from body import Body, LEVEL, ROBOT
import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.nmpc import NmpcController, NmpcParameters
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ALL_HEALTHY
from beetle_omni_ros.model.schema import ParameterError


@pytest.fixture(scope='module')
def controller():
    return NmpcController(ROBOT, NmpcParameters.load())


@pytest.fixture(autouse=True)
def fresh(controller):
    controller.reset()


@pytest.mark.parametrize('rpy', [(180, 0, 0), (-60, 80, 170)])
def test_reaches_inverted_poses_without_error(controller, rpy):
    target = PoseTarget(np.array([1.0, -1.0, 1.5]), rotations.from_rpy(*np.radians(rpy)))
    position, angle = Body().fly(controller, target, 6.0).errors(target)[-1]
    assert position < 2e-3 and angle < np.radians(0.2)


def test_holds_a_pose_for_which_a_joint_is_barely_beyond_its_stop():
    attitude = rotations.from_rpy(*np.radians([154.2, -47.0, 32.1]))
    body = Body((0.0, 0.0, 1.5), attitude, np.array([-3.96, 2.0, 3.96, -2.0]))
    held = body.command.tilt
    stop = np.abs(held).max() - 0.02
    robot = replace(ROBOT, joints=replace(ROBOT.joints, position_limit=stop))
    target = PoseTarget(body.x[:3], attitude)
    body.x[13:17] = np.clip(held, -stop, stop)
    position, angle = body.fly(NmpcController(robot), target, 4.0).errors(target)[-1]
    assert position < 5e-3 and angle < np.radians(1)
    assert max(np.abs(command.tilt - held).max() for _, _, command in body.trace) < 1.0


@pytest.mark.parametrize('effects', [
    {'rotor_thrust_coefficient': {'scale': [0.95, 1.0, 1.03, 1.0]}},
    {'wind': {'force': [2.0, -1.0, 1.0]}}], ids=['uneven rotors', 'wind'])
def test_an_unknown_constant_disturbance_leaves_no_steady_error(controller, effects):
    target = PoseTarget(np.array([0.5, 0.0, 1.2]), rotations.from_rpy(0.6, -0.3, 0.2))
    body = Body(robot=replace(ROBOT, effects=effects))
    position, angle = body.fly(controller, target, 7.0).errors(target)[-1]
    assert position < 2e-3 and angle < np.radians(0.1)


def test_servo_offsets_and_torque_are_estimated(controller):
    target = PoseTarget(np.array([0.0, 0.0, 1.0]), LEVEL)
    disturbance = np.r_[np.zeros(3), [0.1, -0.05, 0.03], [0.02, -0.01, 0.015, 0.0]]
    body = Body(disturbance=disturbance).fly(controller, target, 6.0)
    assert body.errors(target)[-1] == pytest.approx((0, 0), abs=9e-4)
    assert np.allclose(controller._estimator.disturbance[6:], disturbance[6:], atol=2e-3)
    assert np.allclose(controller._estimator.disturbance[3:6], disturbance[3:6], atol=1e-2)


@pytest.mark.parametrize('without, broken, unwound', [
    ('', ALL_HEALTHY, 1), ('unwinding', ALL_HEALTHY, 0),
    ('', replace(ALL_HEALTHY, stuck=(0.7, None, None, None)), 0)],
    ids=['healthy', 'without', 'a stuck joint'])
def test_a_plan_stuck_with_wound_joints_is_led_through_the_level_attitude(
        without, broken, unwound):
    controller = NmpcController(ROBOT, replace(NmpcParameters.load(), without=without))
    controller.set_health(broken)
    attitude = rotations.from_rpy(*np.radians([165, 10, -160]))
    state = Body((0.0, 0.0, 1.2), attitude, np.array([0.7, 2.7, -1.5, 3.1])).state()
    target = PoseTarget(state.position, rotations.from_rpy(*np.radians([43, -51, -64])))
    for k in range(150):    # 1.5 s without motion
        controller.step(replace(state, stamp=0.01 * k), target)
    assert controller.diagnostics()['unwound'] == unwound


def test_a_moving_reference_is_tracked_with_preview(controller):
    time = np.arange(0, 8, 0.02)
    phase = 2 * np.pi * time / 8
    positions = np.stack([np.sin(phase), np.zeros_like(time), 1 + 0 * time], axis=1)
    velocities = np.stack([2 * np.pi / 8 * np.cos(phase), 0 * time, 0 * time], axis=1)
    target = TrajectoryTarget(time, positions, np.tile(LEVEL, (len(time), 1)), velocities,
                              np.zeros_like(positions))
    body = Body()
    body.x[3] = 2 * np.pi / 8
    assert body.fly(controller, target, 6.0).errors(target)[-1, 0] < 0.004  # at 0.8 m/s: 5 ms


def test_without_a_compiler_the_cause_is_named(monkeypatch):
    monkeypatch.setenv('CC', 'no-such-compiler')
    with pytest.raises(ParameterError, match='needs a C compiler: no C compiler found'):
        NmpcController(ROBOT)
