"""Allocation by its properties: residual, minimum norm, nearest permitted turn, symmetry."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
ALLOCATOR = Allocator(ROBOT)
LIMIT = ROBOT.joints.position_limit


def independent_wrench(robot, tilt, thrust):
    """Sum over rotors with scipy's rotation about the arm: the oracle of the forward map."""
    force, torque = np.zeros(3), np.zeros(3)
    for i, yaw in enumerate(robot.rotors.arm_yaw):
        turn = Rotation.from_rotvec(tilt[i] * np.array([np.cos(yaw), np.sin(yaw), 0.0]))
        push = turn.apply([0.0, 0.0, thrust[i]])
        force += push
        torque += np.cross(robot.rotors.positions[i], push) \
            - robot.rotors.spin[i] * robot.rotors.torque_to_thrust_ratio * push
    return force, torque


def at_a_limit(got):
    return (got.thrust >= ROBOT.rotors.thrust_max).any() or (np.abs(got.tilt) >= LIMIT).any()


def random_wrench(rng):
    return rng.normal(size=3) * 12, rng.normal(size=3) * 0.8


def test_allocation_leaves_no_residual_and_respects_the_limits():
    rng = np.random.default_rng(2)
    met = 0
    for _ in range(300):
        force, torque = random_wrench(rng)
        got = ALLOCATOR.allocate(force, torque, rng.uniform(-LIMIT, LIMIT, 4))
        assert np.all(np.abs(got.tilt) <= LIMIT)
        assert np.all((got.thrust >= 0) & (got.thrust <= ROBOT.rotors.thrust_max))
        if not at_a_limit(got):
            met += 1
            made = independent_wrench(ROBOT, got.tilt, got.thrust)
            np.testing.assert_allclose(made[0], force, atol=1e-4)
            np.testing.assert_allclose(made[1], torque, atol=1e-4)
    assert met > 100


def test_each_tilt_is_the_permitted_turn_nearest_the_present_angle():
    rng = np.random.default_rng(3)
    for _ in range(300):
        force, torque = random_wrench(rng)
        present = rng.uniform(-LIMIT, LIMIT, 4)
        got = ALLOCATOR.allocate(force, torque, present)
        for angle, now in zip(got.tilt, present):
            turns = [angle + 2 * np.pi * k for k in range(-2, 3)]
            legal = [turn for turn in turns if abs(turn) <= LIMIT]
            assert abs(angle - now) == pytest.approx(min(abs(turn - now) for turn in legal))


def test_the_solution_has_minimum_norm():
    # Each column is the wrench of one newton of one rotor, up or sideways.
    matrix = np.column_stack([np.concatenate(independent_wrench(ROBOT, [tilt] * 4, np.eye(4)[i]))
                              for i in range(4) for tilt in (0.0, np.pi / 2)])
    rng = np.random.default_rng(4)
    for _ in range(5):
        force, torque = random_wrench(rng)
        got = ALLOCATOR.allocate(force / 2, torque / 2, np.zeros(4))
        least = np.linalg.lstsq(matrix, np.concatenate([force, torque]) / 2, rcond=None)[0]
        pairs = np.stack([got.thrust * np.cos(got.tilt), got.thrust * np.sin(got.tilt)], axis=1)
        np.testing.assert_allclose(pairs.ravel(), least, atol=1e-9)


def test_rotor_without_thrust_keeps_its_present_angle():
    present = np.array([0.3, -1.2, 2.5, -3.9])
    got = ALLOCATOR.allocate(np.zeros(3), np.zeros(3), present)
    np.testing.assert_array_equal(got.tilt, present)
    np.testing.assert_array_equal(got.thrust, np.zeros(4))


@pytest.mark.parametrize('beyond, stays', [(0.04, True), (0.06, False)])
def test_a_joint_at_its_stop_stays_there_for_a_tilt_barely_beyond_it(beyond, stays):
    on_its_side = rotations.from_rpy(np.pi / 2, 0.0, 0.0)
    tilt = ALLOCATOR.hover(on_its_side, np.zeros(4)).tilt
    other = tilt[0] - np.copysign(2 * np.pi, tilt[0])
    stop = abs(other) - beyond
    present = np.array([np.copysign(stop, other), *tilt[1:]])
    got = Allocator(replace(ROBOT, joints=replace(ROBOT.joints, position_limit=stop))).hover(
        on_its_side, present)
    np.testing.assert_allclose(got.tilt, present if stays else tilt, atol=1e-9)


def test_known_effects_of_the_robot_file_are_allocated_for():
    effects = {'mass': {'mass': 3.3}, 'thrust_coefficient': {'scale': 0.9},
               'rotor_thrust_coefficient': {'scale': [1.0, 0.95, 1.0, 1.05]},
               'torque_coefficient': {'torque_to_thrust_ratio': 0.02},
               'wind': {'force': [1.0, 0.0, 0.0]}}
    robot = replace(ROBOT, effects=effects)
    got = Allocator(robot).hover(np.array([0, 0, 0, 1.0]), np.zeros(4))
    true = replace(ROBOT, rotors=replace(ROBOT.rotors, torque_to_thrust_ratio=0.02))
    scale = 0.9 * np.array([1.0, 0.95, 1.0, 1.05])
    force, torque = independent_wrench(true, got.tilt, scale * got.thrust)
    np.testing.assert_allclose(force, [-1.0, 0.0, 3.3 * ROBOT.gravity], atol=1e-4)
    np.testing.assert_allclose(torque, np.zeros(3), atol=1e-4)
