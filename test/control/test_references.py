"""The reference over the horizon: held poses, unwinding joints, lead of commands."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.references import (
    ReferencePlanner,
    THRUST,
    THRUST_LEAD,
    TILT,
    TILT_LEAD,
)
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()
TIMES = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4])
LAG = 0.03
LIMIT = ROBOT.joints.position_limit
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def planner(unwind=4.0):
    return ReferencePlanner(ROBOT, TIMES, unwind, LAG)


@pytest.mark.parametrize('seed', range(5))
def test_a_pose_is_held_against_the_estimated_disturbance(seed):
    rng = np.random.default_rng(seed)
    quaternion = rotations.normalized(rng.normal(size=4))
    disturbance = np.r_[rng.normal(size=3), 0.1 * rng.normal(size=3), np.zeros(4)]
    reference = planner().plan(PoseTarget(np.ones(3), quaternion), 5.0, LEVEL, np.zeros(4),
                               disturbance)
    assert np.all(reference == reference[0])
    # with the disturbance acting, the model does not accelerate
    x = np.concatenate([np.zeros(6), quaternion, np.zeros(3), reference[0, TILT], np.zeros(4),
                        reference[0, THRUST]])
    u = np.r_[reference[0, TILT], reference[0, THRUST]]
    assert np.allclose(np.array(model.full_model(ROBOT)(x, u, disturbance)), 0, atol=1e-9)


@pytest.mark.parametrize('seed', range(8))
def test_joint_references_are_within_half_a_turn_unless_that_is_far(seed):
    rng = np.random.default_rng(seed)
    target = PoseTarget(np.zeros(3), rotations.normalized(rng.normal(size=4)))
    present = rng.uniform(-LIMIT, LIMIT, 4)
    nearest = planner(0.0).plan(target, 0.0, LEVEL, present, np.zeros(10))[0, TILT]
    unwound = planner(4.0).plan(target, 0.0, LEVEL, present, np.zeros(10))[0, TILT]
    principal = planner(6.3).plan(target, 0.0, LEVEL, present, np.zeros(10))[0, TILT]
    assert np.allclose(np.cos(nearest - unwound), 1)
    assert np.allclose(np.cos(nearest - principal), 1)
    assert np.all(np.abs(principal) <= np.pi + 1e-12)
    extra = np.abs(unwound - present) - np.abs(nearest - present)
    assert np.all(extra < 4.0)
    assert np.all((np.abs(unwound) <= np.pi) | (unwound == nearest))
    assert np.all(np.abs(unwound) <= LIMIT)


@pytest.mark.parametrize('axis', [(1, 0, 0), (0, 1, 0), (0.6, 0.8, 0)])
@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('encoder', [0.0, 0.3])
def test_joints_with_half_a_turn_to_go_turn_with_the_body_in_spite_of_noise(axis, seed, encoder):
    """``encoder`` [rad]: largest error of the encoders and of the hover before the turn."""
    noise = np.random.default_rng(seed)
    offset = noise.uniform(-encoder, encoder, 4)
    target, plan = PoseTarget(np.ones(3), np.array([*axis, 0.0])), planner()

    def seen(angle):
        """Attitude and tilts on the way, with the noise of the estimate."""
        attitude = rotations.multiply(rotations.exp(angle * np.array(axis)),
                                      rotations.exp(noise.normal(scale=1e-3, size=3)))
        held = planner().plan(PoseTarget(np.ones(3), attitude), 0.0, LEVEL,
                              np.zeros(4), np.zeros(10))[0, TILT]
        return attitude, held + offset + noise.normal(scale=0.01, size=4)

    def asked(angle):
        return plan.plan(target, 0.0, *seen(angle), np.zeros(10))[0, TILT]

    first = asked(0.0)
    assert np.allclose([asked(0.0) for _ in range(20)], first, atol=0.05)
    # Joints pass these angles, or their negatives: the body may turn in either direction.
    passed = np.sign(seen(0.5 * np.pi)[1])
    assert abs(np.sign(first) @ passed) == 4


def test_commands_lead_a_moving_reference_so_that_the_lag_arrives_on_time():
    target = make_task('lemniscate').segments[1].target(0.0)
    reference = planner().plan(target, 20.0, LEVEL, np.zeros(4), np.zeros(10))
    for values, lead, lag in ((TILT, TILT_LEAD, LAG),
                              (THRUST, THRUST_LEAD, ROBOT.rotors.time_constant)):
        for k, length in enumerate(np.diff(TIMES)):
            command = reference[k, values] + reference[k, lead]
            reached = command + (reference[k, values] - command) * np.exp(-length / lag)
            assert np.allclose(reached, reference[k + 1, values], atol=1e-12)
