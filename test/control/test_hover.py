"""The hover controller in closed loop with lagging, delayed actuators, and its properties."""

from dataclasses import replace

from body import Body, LEVEL, PERIOD, ROBOT
import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.control.hover import (
    HoverController,
    STOP_OVERLAP,
    THRUST_RATE,
    TILT_RATE_SHARE,
)
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import Allocator
from beetle_omni_ros.supervisor.way import coasted, halting

TILT_RATE = TILT_RATE_SHARE * ROBOT.joints.velocity_limit
HOME = np.array([0.0, 0.0, 1.0])


def unit(rng, size=3):
    return rotations.normalized(rng.normal(size=size))


def heavy(scale):
    return replace(ROBOT, effects={'mass': {'mass': scale * ROBOT.mass}})


@pytest.mark.parametrize('seed, mass_scale', [(1, 1.1), (2, 0.9), (13, 1.0)])
def test_recovers_from_one_metre_and_sixty_degrees(seed, mass_scale):
    rng = np.random.default_rng(seed)
    goal = unit(rng, 4)
    turned = rotations.multiply(goal, rotations.exp(np.pi / 3 * unit(rng)))
    body = Body(HOME + unit(rng), turned, robot=heavy(mass_scale),
                disturbance=np.r_[np.zeros(3), np.full(3, 0.08), np.zeros(4)])
    target = PoseTarget(HOME, goal)
    position, attitude = body.fly(HoverController(ROBOT), target, 7.0).errors(target).T
    assert position.max() < 1.3                             # no excursion on the way
    assert position[-50:].max() < 0.12 and attitude[-50:].max() < 0.1
    thrusts = [command.thrust for _, _, command in body.trace[-50:]]
    assert np.ptp(thrusts, axis=0).max() < 0.3              # no limit cycle


def test_takes_over_without_a_jump_from_any_command_in_force():
    rng = np.random.default_rng(5)
    controller, state = HoverController(ROBOT), Body().state()
    for stamp in range(20):     # another controller flew in between
        in_force = Command(0.0, rng.uniform(-3.9, 3.9, 4), rng.uniform(0, 20, 4))
        command = controller.step(replace(state, stamp=stamp, quaternion=unit(rng, 4),
                                          command=in_force), PoseTarget(HOME, unit(rng, 4)))
        assert np.abs(command.tilt - in_force.tilt).max() <= TILT_RATE * PERIOD + 1e-9
        assert np.abs(command.thrust - in_force.thrust).max() <= THRUST_RATE * PERIOD + 1e-9


def test_the_disturbance_estimate_converges_while_another_controller_is_active():
    """A handover with a wrong mass starts without a loss of height."""
    body, flying, standby = Body(robot=heavy(1.1)), HoverController(ROBOT), HoverController(ROBOT)
    for _ in range(300):
        standby.observe(body.state())
        body.advance(flying.step(body.state(), PoseTarget(HOME, LEVEL)))
    body.trace, target = [], PoseTarget(body.x[:3], LEVEL)
    assert body.fly(standby, target, 1.0).errors(target)[:, 0].max() < 0.01


@pytest.mark.parametrize('seed', range(4))
def test_a_fast_turn_is_stopped_without_loss_of_height(seed):
    """At 5 rad/s and 2 m/s, with joints up to 0.6 rad beside those of hovering."""
    rng = np.random.default_rng(seed)
    body, hover, target = Body(HOME, unit(rng, 4)), HoverController(ROBOT), None
    body.x[3:5], body.x[10:13] = 2 * unit(rng, 2), 5 * unit(rng)
    body.x[13:17] += rng.uniform(-0.6, 0.6, 4)
    body.command = replace(body.command, tilt=body.x[13:17].copy())
    for _ in range(100):
        state = body.state()
        reference = target or halting(state, HOME[2])
        if reference is None:
            reference = target = PoseTarget(coasted(state), state.quaternion)
        body.advance(hover.step(state, reference))
    assert min(x[2] for _, x, _ in body.trace) > HOME[2] - 0.3
    assert target is not None


STOP = ROBOT.joints.position_limit
AT_STOP = rotations.from_rpy(*np.radians([154.2, -47.0, 32.1]))     # joints 1 and 3 at +-3.93 rad


@pytest.mark.parametrize('seed', range(2))
def test_a_joint_waits_at_its_stop_for_the_end_of_a_transient(seed):
    rng = np.random.default_rng(seed)
    body = Body(HOME, AT_STOP, np.array([-STOP, 2.0, STOP, -2.0]))
    wound = body.command.tilt
    assert np.abs(wound[[0, 2]]).min() > STOP - 0.1
    body.x[6:10] = rotations.multiply(AT_STOP, rotations.exp(0.05 * unit(rng)))
    target = PoseTarget(HOME + 0.2 * unit(rng), AT_STOP)
    position, turn = body.fly(HoverController(ROBOT), target, 2.0).errors(target)[-1]
    farthest = max(np.abs(command.tilt - wound).max() for _, _, command in body.trace)
    assert farthest < 1.5                                   # not to the other side
    assert position < 0.05 and turn < 0.1


def test_a_joint_far_from_its_stop_turns_to_its_goal_at_once():
    rng, hover, state, back = np.random.default_rng(0), HoverController(ROBOT), Body().state(), 0
    for stamp in range(1, 300):
        attitude, tilt = unit(rng, 4), rng.uniform(-1, 1, 4) * (STOP - STOP_OVERLAP)
        goal = Allocator(ROBOT).hover(attitude, tilt)
        command = hover.step(replace(
            state, stamp=stamp, quaternion=attitude, tilt=tilt, angular_velocity=np.zeros(3),
            command=Command(0.0, tilt, goal.thrust)), PoseTarget(state.position, attitude))
        assert ((command.tilt - tilt) * (goal.tilt - tilt) >= 0).all()
        back += (np.abs(goal.tilt - tilt) > np.pi).sum()
    assert back > 10            # to the other side


def test_a_joint_leaves_its_stop_if_the_weight_needs_the_other_side():
    on_its_side = rotations.from_rpy(np.pi / 2, 0.0, 0.0)
    steady = Allocator(ROBOT).hover(on_its_side, np.zeros(4))
    assert 2 * np.pi - np.abs(steady.tilt).max() > STOP + STOP_OVERLAP
    tilt = np.copysign(STOP, -steady.tilt)
    hover, state = HoverController(ROBOT), replace(
        Body(HOME, on_its_side).state(), tilt=tilt, command=Command(0.0, tilt, steady.thrust))
    for stamp in np.arange(1, 40) * PERIOD:
        command = hover.step(replace(state, stamp=stamp), PoseTarget(HOME, on_its_side))
        state = replace(state, command=command)
    assert (np.abs(command.tilt) < STOP - 2.0).all()
