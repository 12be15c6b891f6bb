"""The hover controller in closed loop with lagging, delayed actuators, and its properties."""

from dataclasses import replace

import numpy as np
from plant import fly, Plant
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.control.hover import (
    HoverController,
    STOP_OVERLAP,
    THRUST_RATE,
    TILT_RATE_SHARE,
)
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import Allocator
from beetle_omni_ros.robot.parameters import RobotParameters

ROBOT = RobotParameters.load()
PERIOD = HoverController.period
TILT_RATE = TILT_RATE_SHARE * ROBOT.joints.velocity_limit
HOME, LEVEL = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0])


def unit(rng, size=3):
    return rotations.normalized(rng.normal(size=size))


def start(attitude, position=HOME, mass_scale=1.0, torque_body=0.0):
    """A plant that hovers with settled actuators, and the command in force."""
    hover = Allocator(ROBOT).hover(attitude, np.zeros(4))
    plant = Plant(ROBOT, position, attitude, hover.tilt, mass_scale, torque_body)
    plant.thrust = hover.thrust.copy()
    return plant, Command(0.0, hover.tilt, hover.thrust)


@pytest.mark.parametrize('seed', range(4))
def test_hovers_at_rest_at_any_attitude(seed):
    attitude = unit(np.random.default_rng(seed), 4)
    plant, in_force = start(attitude)
    log = fly(plant, HoverController(ROBOT), PoseTarget(HOME, attitude), 2.0, in_force)
    assert max(step[0] for step in log) < 1e-3
    assert max(step[1] for step in log) < 1e-3


@pytest.mark.parametrize('seed, mass_scale', [(0, 1.0), (1, 1.1), (2, 0.9), (13, 1.0)])
def test_recovers_from_one_metre_and_sixty_degrees(seed, mass_scale):
    rng = np.random.default_rng(seed)
    goal = unit(rng, 4)
    plant, in_force = start(rotations.multiply(goal, rotations.exp(np.pi / 3 * unit(rng))),
                            HOME + unit(rng), mass_scale, 0.08)
    log = fly(plant, HoverController(ROBOT), PoseTarget(HOME, goal), 7.0, in_force)
    position, attitude = np.array([step[:2] for step in log]).T
    assert position.max() < 1.3                             # no excursion on the way
    assert position[-50:].max() < 0.12 and attitude[-50:].max() < 0.1
    assert np.ptp([step[2].thrust for step in log[-50:]], axis=0).max() < 0.3   # no limit cycle


def test_hovers_with_thrust_along_an_arm_where_one_rotor_is_unloaded():
    """With gravity along arm 1, rotors 1 and 3 have no thrust and no defined direction."""
    arm = ROBOT.tilt_axes[0]
    axis = np.cross(arm, [0, 0, 1.0])
    attitude = rotations.exp(np.pi / 2 * axis / np.linalg.norm(axis))
    assert abs(rotations.matrix(attitude)[2] @ arm) == pytest.approx(1.0)
    plant, in_force = start(attitude)
    rng, controller, tilts = np.random.default_rng(0), HoverController(ROBOT), []
    target = PoseTarget(HOME, attitude)
    for _ in range(300):
        state = plant.state(in_force)
        state = replace(state, velocity=state.velocity + 0.01 * rng.normal(size=3),
                        angular_velocity=state.angular_velocity + 0.01 * rng.normal(size=3))
        in_force = controller.step(state, target)
        plant.advance(in_force, PERIOD)
        tilts.append(in_force.tilt)
    assert np.linalg.norm(plant.position - HOME) < 0.02
    assert rotations.geodesic_angle(attitude, plant.quaternion) < 0.03
    assert np.abs(np.diff(tilts, axis=0)).max() <= TILT_RATE * PERIOD + 1e-9


@pytest.mark.parametrize('rotor', range(4))
def test_the_observer_removes_the_tilt_that_a_weak_rotor_causes(rotor):
    missing = np.zeros(4)
    missing[rotor] = -0.3 * Allocator(ROBOT).hover(LEVEL, np.zeros(4)).thrust[rotor]
    _, torque = Allocator(ROBOT).wrench(np.zeros(4), missing)
    plant, in_force = start(LEVEL, torque_body=torque)
    log = fly(plant, HoverController(ROBOT), PoseTarget(HOME, LEVEL), 4.0, in_force)
    assert log[-1][1] < np.radians(1)


def test_takes_over_without_a_jump_from_any_command_in_force():
    rng = np.random.default_rng(5)
    controller = HoverController(ROBOT)
    for _ in range(20):
        in_force = Command(0.0, rng.uniform(-3.9, 3.9, 4), rng.uniform(0, 20, 4))
        plant, _ = start(unit(rng, 4))
        controller.reset()
        command = controller.step(plant.state(in_force), PoseTarget(HOME, unit(rng, 4)))
        assert np.abs(command.tilt - in_force.tilt).max() <= TILT_RATE * PERIOD + 1e-9
        assert np.abs(command.thrust - in_force.thrust).max() \
            <= THRUST_RATE * PERIOD + 1e-9


def test_the_disturbance_estimate_converges_while_another_controller_is_active():
    """A handover with a wrong mass starts without a loss of height."""
    level = np.array([0, 0, 0, 1.0])
    plant, in_force = start(level, mass_scale=1.1)
    flying, standby = HoverController(ROBOT), HoverController(ROBOT)
    for _ in range(300):
        state = plant.state(in_force)
        standby.observe(state)
        in_force = flying.step(state, PoseTarget(HOME, level))
        plant.advance(in_force, PERIOD)
    log = fly(plant, standby, PoseTarget(plant.position, level), 1.0, in_force)
    assert max(step[0] for step in log) < 0.01


def test_a_distant_target_does_not_change_the_disturbance_estimate():
    level = np.array([0, 0, 0, 1.0])
    plant, in_force = start(level)
    controller = HoverController(ROBOT)
    fly(plant, controller, PoseTarget(HOME + [3.0, 0, 0], level), 3.0, in_force)
    assert controller.diagnostics()['force_disturbance_m_s2'] < 0.1


def test_a_repeated_stamp_repeats_the_command_and_a_pause_limits_the_time_step():
    level = np.array([0, 0, 0, 1.0])
    plant, in_force = start(level)
    controller, target = HoverController(ROBOT), PoseTarget(HOME, rotations.exp([0.5, 0, 0]))
    first = controller.step(plant.state(in_force), target)
    assert controller.step(plant.state(first), target) is first
    plant.time += 10.0
    late = controller.step(plant.state(first), target)
    assert np.abs(late.tilt - first.tilt).max() <= 5 * TILT_RATE * PERIOD + 1e-9


def test_any_finite_state_gives_a_finite_command_within_limits():
    rng = np.random.default_rng(6)
    controller, in_force = HoverController(ROBOT), None
    plant, _ = start(np.array([0, 0, 0, 1.0]))
    for k in range(300):
        state = replace(plant.state(in_force), stamp=0.01 * k, position=rng.normal(size=3) * 100,
                        velocity=rng.normal(size=3) * 50, quaternion=unit(rng, 4),
                        angular_velocity=rng.normal(size=3) * 50, tilt=rng.normal(size=4) * 5)
        in_force = controller.step(state, PoseTarget(rng.normal(size=3), unit(rng, 4)))
        assert np.all(np.abs(in_force.tilt) <= ROBOT.joints.position_limit)
        assert np.all((in_force.thrust >= 0) & (in_force.thrust <= ROBOT.rotors.thrust_max))
    assert controller.diagnostics()['saturated_steps'] > 0


def test_follows_a_moving_target_with_its_velocity():
    level, times = np.array([0, 0, 0, 1.0]), np.linspace(0, 5, 51)
    way = HOME + np.outer(times, [0.3, 0.0, 0.0])
    target = TrajectoryTarget(times, way, np.tile(level, (51, 1)),
                              np.tile([0.3, 0, 0], (51, 1)), np.zeros((51, 3)))
    plant, in_force = start(level)
    log = fly(plant, HoverController(ROBOT), target, 4.9, in_force)
    assert log[-1][0] < 0.05


STOP = ROBOT.joints.position_limit
AT_STOP = rotations.from_rpy(*np.radians([154.2, -47.0, 32.1]))     # joints 1 and 3 at +-3.93 rad


@pytest.mark.parametrize('seed', range(6))
def test_a_joint_waits_at_its_stop_for_the_end_of_a_transient(seed):
    wound = Allocator(ROBOT).hover(AT_STOP, np.array([-STOP, 2.0, STOP, -2.0]))
    assert np.abs(wound.tilt[[0, 2]]).min() > STOP - 0.1
    rng = np.random.default_rng(seed)
    plant = Plant(ROBOT, HOME, rotations.multiply(AT_STOP, rotations.exp(0.05 * unit(rng))),
                  wound.tilt)
    plant.thrust = wound.thrust.copy()
    log = fly(plant, HoverController(ROBOT), PoseTarget(HOME + 0.2 * unit(rng), AT_STOP), 2.0,
              Command(0.0, wound.tilt, wound.thrust))
    farthest = max(np.abs(step[2].tilt - wound.tilt).max() for step in log)
    assert farthest < 1.5                                   # not to the other side
    assert log[-1][0] < 0.05 and log[-1][1] < 0.1


def test_a_joint_leaves_its_stop_if_the_weight_needs_the_other_side():
    on_its_side = rotations.from_rpy(np.pi / 2, 0.0, 0.0)
    steady = Allocator(ROBOT).hover(on_its_side, np.zeros(4))
    assert 2 * np.pi - np.abs(steady.tilt).max() > STOP + STOP_OVERLAP
    command = Command(0.0, np.copysign(STOP, -steady.tilt), steady.thrust)
    plant = Plant(ROBOT, HOME, on_its_side, command.tilt)
    hover = HoverController(ROBOT)
    for plant.time in np.arange(1, 40) * PERIOD:
        command = hover.step(plant.state(command), PoseTarget(HOME, on_its_side))
    assert (np.abs(command.tilt) < STOP - 2.0).all()
