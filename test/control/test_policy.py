"""The policy as a controller: observation, commands, bad numbers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from policy_files import write
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import Command, PoseTarget, Reference, State
from beetle_omni_ros.control.policy import disturbed, observed, PolicyController, PolicyParameters
from beetle_omni_ros.control.policy_file import PolicyContract
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
TARGET = PoseTarget(np.array([0.0, 0.0, 1.0]), LEVEL)


def controller(path, robot=ROBOT, **changed):
    return PolicyController(robot, replace(PolicyParameters.load(), policy=str(path), **changed))


def state(stamp=1.0, command=None, **changed):
    values = {'position': np.array([0.1, -0.2, 1.0]), 'velocity': np.array([0.1, 0.0, -0.1]),
              'quaternion': np.array([0.1, 0.2, 0.0, np.sqrt(0.95)]),
              'angular_velocity': np.array([0.0, 0.3, 0.1]),
              'tilt': np.array([0.1, -0.1, 0.2, 0.0]), 'tilt_velocity': np.zeros(4), **changed}
    return State(stamp, **values, tilt_stamp=stamp - 0.01, command=command)


def drawn():
    """Random state, reference, previous action and disturbance (10,)."""
    rng = np.random.default_rng(0)
    turns = Rotation.random(2, random_state=0).as_quat()
    state = State(0.0, rng.normal(size=3), rng.normal(size=3), turns[0], rng.normal(size=3),
                  rng.normal(size=4), rng.normal(size=4), 0.0)
    reference = Reference(rng.normal(size=3), turns[1], rng.normal(size=3), rng.normal(size=3))
    return state, reference, rng.normal(size=8).tolist(), rng.normal(size=10)


def test_each_block_contains_the_quantity_of_its_name():
    state, reference, previous, disturbance = drawn()
    values = observed(state, reference, previous) + disturbed(state, disturbance)
    table = PolicyContract.default(ROBOT, memory=True).observations
    ends = np.cumsum([block['size'] for block in table])
    seen = {block['name']: values[end - block['size']:end] for block, end in zip(table, ends)}
    body, goal = Rotation.from_quat(state.quaternion), Rotation.from_quat(reference.quaternion)
    to_body = body.inv()
    expected = {
        'velocity': to_body.apply(state.velocity - reference.velocity),
        'angular_velocity': state.angular_velocity
        - to_body.apply(goal.apply(reference.angular_velocity)),
        'target_position': to_body.apply(reference.position - state.position),
        'attitude': np.r_[body.apply([1, 0, 0]), body.apply([0, 0, 1])],
        'target_attitude': np.r_[goal.apply([1, 0, 0]), goal.apply([0, 0, 1])],
        'tilt': state.tilt, 'previous_action': previous,
        'disturbance_force': to_body.apply(disturbance[:3]),
        'disturbance_torque': disturbance[3:6]}
    assert len(values) == ends[-1] and set(seen) == set(expected)
    for name, numbers in expected.items():
        assert np.allclose(seen[name], numbers, atol=1e-12), name


@pytest.mark.parametrize('memory', [False, True])
def test_targets_follow_from_the_observation_by_scale_and_offset(tmp_path, memory):
    rng = np.random.default_rng(1)
    size = 39 if memory else 33
    weights, bias = 0.05 * rng.normal(size=(size, 8)), 0.1 * rng.normal(size=8)
    policy = controller(write(tmp_path / 'p.onnx', memory=memory, weights=weights, bias=bias))
    assert policy.name == ('rl_any' if memory else 'rl') and policy.period == 0.01
    given = state(command=Command(0.99, np.full(4, 0.1), np.full(4, 7.0)))
    contract = policy.contract
    scale, offset = np.array(contract.action_scale), np.array(contract.action_offset)
    before = (np.r_[given.command.tilt, given.command.thrust] - offset) / scale
    seen = np.array(observed(given, TARGET.at(1.0), before) + [0.0] * (6 if memory else 0))
    expected = scale * (seen @ weights + bias) + offset
    command = policy.step(given, TARGET)
    assert command.stamp == given.stamp
    assert np.allclose(np.r_[command.tilt, command.thrust], expected, atol=1e-5)


def test_targets_are_cut_to_the_limits_of_the_actuators(tmp_path):
    bias = np.array([50.0, -50, 0, 0, 50, -50, 0, 0])
    policy = controller(write(tmp_path / 'p.onnx', bias=bias))
    command = policy.step(state(), TARGET)
    limit = ROBOT.joints.position_limit
    assert np.allclose(command.tilt, [limit, -limit, 0, 0])
    assert np.allclose(command.thrust, [ROBOT.rotors.thrust_max, ROBOT.rotors.thrust_min,
                                        ROBOT.hover_thrust, ROBOT.hover_thrust])
    assert policy.diagnostics()['steps_at_a_limit'] == 1


def test_an_action_that_is_not_finite_is_left_to_the_supervisor(tmp_path):
    weights = np.zeros((33, 8))
    weights[8] = 1e38       # z of target_position, in float32: infinite 4 m away
    policy = controller(write(tmp_path / 'p.onnx', weights=weights))
    far = PoseTarget(np.array([0.0, 0.0, 5.0]), LEVEL)
    assert not np.isfinite(policy.step(state(), far).thrust).any()
    assert policy.diagnostics()['faulty_actions'] == 1


def test_only_its_latest_commands_put_the_policy_in_charge(tmp_path):
    policy, charges = controller(write(tmp_path / 'p.onnx')), []
    policy._guidance = SimpleNamespace(
        target=lambda state, target, in_charge: charges.append(in_charge) or target)
    own = policy.step(state(1.0), TARGET)
    for command in (own, None, replace(own, thrust=own.thrust + 0.1)):
        policy.step(state(1.01, command), TARGET)
    assert charges == [False, True, False, False]


def test_the_disturbance_of_another_robot_is_its_difference_from_that_of_the_training(tmp_path):
    heavy = replace(ROBOT, mass=ROBOT.mass + 0.5)
    policy = controller(write(tmp_path / 'p.onnx', memory=True), heavy, matching=False)
    still = {'velocity': np.zeros(3), 'quaternion': LEVEL, 'angular_velocity': np.zeros(3),
             'tilt': np.zeros(4)}
    for k in range(400):
        stamp = 0.01 * (k + 1)
        hover = Command(stamp - 0.01, np.zeros(4), np.full(4, heavy.hover_thrust))
        policy.step(state(stamp, hover, **still), TARGET)
    assert policy.diagnostics()['force_estimate_N'] == pytest.approx(0.5 * ROBOT.gravity, abs=0.1)


def test_a_known_weak_rotor_gets_more_of_the_thrust_that_the_policy_asks_for(tmp_path):
    weak = replace(ROBOT, effects={'thrust_coefficient': {'scale': 0.8}})
    path = write(tmp_path / 'p.onnx', bias=[0.0] * 8)
    hover = Command(0.99, np.zeros(4), np.full(4, ROBOT.hover_thrust / 0.8))
    still = {'velocity': np.zeros(3), 'quaternion': LEVEL, 'angular_velocity': np.zeros(3),
             'tilt': np.zeros(4)}
    sent = [controller(path, weak, matching=matching).step(
        state(1.0, hover, **still), TARGET).thrust for matching in (True, False)]
    np.testing.assert_allclose(sent[0], sent[1] / 0.8, rtol=0.01)


def test_the_policy_with_memory_observes_a_push_in_body_axes(tmp_path):
    # action = disturbance_force / 20, on the rotors
    weights = np.zeros((39, 8))
    weights[33:36, 4:7] = 0.05 * np.eye(3)
    policy = controller(write(tmp_path / 'p.onnx', memory=True, weights=weights))
    yaw = np.array([0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)])   # x of the body along y
    hover = Command(0.0, np.zeros(4), np.full(4, ROBOT.hover_thrust))
    for k in range(400):    # level thrust carries the weight; 6 N along world y speed it up
        stamp = 0.01 * (k + 1)
        given = state(stamp, replace(hover, stamp=stamp - 0.01), quaternion=yaw,
                      velocity=np.array([0, 6.0 / ROBOT.mass * stamp, 0]),
                      angular_velocity=np.zeros(3), tilt=np.zeros(4))
        command = policy.step(given, TARGET)
    force = (command.thrust[:3] - ROBOT.hover_thrust) / 0.5 / 0.05
    assert np.allclose(force, [6.0, 0.0, 0.0], atol=0.3)
    assert policy.diagnostics()['force_estimate_N'] == pytest.approx(6.0, abs=0.3)
