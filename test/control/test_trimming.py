"""The steady error at a target is removed; other errors do not change the trim."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from plant import Plant
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.control.guidance.trimming import Trimming, TrimmingParameters
from beetle_omni_ros.control.policy import PolicyController, PolicyParameters
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters

P = TrimmingParameters()
ROBOT = RobotParameters.load()
TARGET = PoseTarget(np.array([0.4, -0.3, 1.5]), rotations.from_rpy(0.8, -0.5, 2.0), stamp=3.0)
SMALL = st.tuples(*[st.floats(-0.03, 0.03)] * 3).map(np.array)


def state(stamp, way=(0, 0, 0), turn=(0, 0, 0), target=TARGET, **changed):
    """State of a robot with an offset from a target, a vector in world and a rotation."""
    values = {'position': target.position - np.array(way), 'velocity': np.zeros(3),
              'quaternion': rotations.multiply(target.quaternion, rotations.conjugate(
                  rotations.exp(np.array(turn, dtype=float)))),
              'angular_velocity': np.zeros(3), **changed}
    return State(stamp, **values, tilt=np.zeros(4), tilt_velocity=np.zeros(4), tilt_stamp=stamp)


def wait(trimming, seconds, begin=0.0, target=TARGET, **where):
    for k in range(round(100 * seconds) + 1):
        shown = trimming.target(state(begin + 0.01 * k, target=target, **where), target)
    return shown


@settings(max_examples=20, deadline=None)
@given(SMALL, SMALL)
def test_a_constant_tracking_error_is_trimmed_to_zero(way, turn):
    """The robot follows with a time constant of 0.3 s, much faster than the integral."""
    trimming = Trimming(P)
    position, lag = np.zeros(3), np.zeros(3)
    for k in range(700):
        shown = trimming.target(state(0.01 * k, way - position, turn - lag), TARGET)
        asked = rotations.log(rotations.multiply(
            rotations.conjugate(TARGET.quaternion), shown.quaternion))
        position += 0.01 / 0.3 * (shown.position - TARGET.position - position)
        lag += 0.01 / 0.3 * (asked - lag)
    assert np.linalg.norm(way - position) < 0.03 * max(np.linalg.norm(way), 1e-3)
    assert np.linalg.norm(turn - lag) < 0.03 * max(np.linalg.norm(turn), 1e-3)
    assert shown.stamp == TARGET.stamp


@pytest.mark.parametrize('where', [
    {'way': (0.2, 0, 0)}, {'turn': (0, 0.5, 0)},
    {'way': (0.01, 0, 0), 'velocity': np.array([0, 0.3, 0])},
    {'turn': (0.01, 0, 0), 'angular_velocity': np.array([0, 0, 1.0])},
    {'position': np.full(3, np.nan)}, {'quaternion': np.full(4, np.nan)},
    {'velocity': np.full(3, np.inf)}, {'angular_velocity': np.full(3, np.nan)}])
def test_the_trim_does_not_change_in_motion_or_for_nan_states(where):
    trimming = Trimming(P)
    shown = wait(trimming, 2.0, **where)
    assert shown.position == pytest.approx(TARGET.position)
    assert shown.quaternion == pytest.approx(TARGET.quaternion)


def test_the_trim_is_limited():
    trimming = Trimming(P)
    shown = wait(trimming, 20.0, way=(0.05, -0.05, 0.02), turn=(0.1, 0.1, 0.0))
    assert np.linalg.norm(shown.position - TARGET.position) == pytest.approx(P.distance)
    assert rotations.geodesic_angle(shown.quaternion, TARGET.quaternion) \
        == pytest.approx(P.angle, abs=1e-3)


def test_the_trim_is_kept_for_equal_and_nearby_targets_only():
    trimming = Trimming(P)
    wait(trimming, 3.0, way=(0.02, 0, 0))
    found = list(trimming.position)
    again = PoseTarget(TARGET.position.copy(), TARGET.quaternion.copy(), stamp=9.0)
    near = replace(TARGET, position=TARGET.position + [0, 0.05, 0])
    for target in (again, near):
        shown = trimming.target(state(9.0, target=target), target)
        assert shown.position - target.position == pytest.approx(found)
    far = replace(TARGET, position=TARGET.position + [0, 0.5, 0])
    assert trimming.target(state(9.0, target=far), far).position == pytest.approx(far.position)


def test_the_trim_does_not_change_over_a_pause():
    trimming = Trimming(P)
    for stamp in (0.0, 5.0, 10.0, 9.0, 9.0):
        shown = trimming.target(state(stamp, way=(0.05, 0, 0)), TARGET)
    assert shown.position == pytest.approx(TARGET.position)


def test_a_rate_of_zero_leaves_targets_unchanged():
    shown = wait(Trimming(replace(P, rate=0.0)), 3.0, way=(0.02, 0, 0), turn=(0, 0.02, 0))
    assert shown.position == pytest.approx(TARGET.position)
    assert shown.quaternion == pytest.approx(TARGET.quaternion)


def hovering(mass_scale, **changed):
    """The steady position error [m] of a policy on a plant of another mass."""
    pytest.importorskip('onnx')
    from hover_policy import write_hover_policy
    parameters = PolicyParameters.load()
    path = changed.pop('folder') / 'hover.onnx'
    write_hover_policy(path)
    controller = PolicyController(ROBOT, replace(parameters, policy=str(path), trimming=replace(
        parameters.trimming, **changed)))
    goal = PoseTarget(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    plant, command = Plant(ROBOT, goal.position, goal.quaternion, np.zeros(4), mass_scale), None
    for _ in range(800):
        command = controller.step(plant.state(command), goal)
        plant.advance(command, 0.01)
    return np.linalg.norm(plant.position - goal.position)


def test_a_policy_carries_unknown_payload_without_a_steady_height_error(tmp_path):
    assert hovering(1.015, folder=tmp_path, rate=0.0) > 0.03
    assert hovering(1.015, folder=tmp_path) < 0.003


def test_a_policy_on_standby_does_not_trim_the_error_of_another_controller(tmp_path):
    """Without its own command in force, an error must not change the trim."""
    controller, targets = PolicyController(ROBOT), []
    others = Command(0.0, np.zeros(4), np.full(4, ROBOT.hover_thrust))
    for k in range(300):
        at = replace(state(0.01 * k, way=(0.05, 0, 0)), command=others)
        targets.append(controller.step(at, TARGET).tilt)
    fresh = PolicyController(ROBOT)
    same = replace(state(2.99, way=(0.05, 0, 0)), command=others)
    assert targets[-1] == pytest.approx(fresh.step(same, TARGET).tilt, abs=1e-9)
