"""Leaving a joint stop, and detours around it: condition, intermediate targets, end."""

from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.unwinding import (
    ATTEMPTS,
    DURATION,
    HEIGHT,
    level_between,
    levelled,
    MISSED_ANGLE,
    NEAR,
    PATIENCE,
    ROUTED,
    Routing,
    tilts_along,
    turned,
    Unwinding,
)
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters

ROBOT = RobotParameters.load()
AXES = ROBOT.tilt_axes
TARGET = PoseTarget(np.array([0.0, 0.0, 1.0]), rotations.from_rpy(1.2, 0.4, -2.0))
OFF = rotations.multiply(TARGET.quaternion, rotations.exp(np.array([0.0, 0.4, 0.0])))
WOUND = np.array([1.5, 3.8, -1.5, -3.7])


def stuck(stamp, **changed):
    values = {'position': TARGET.position, 'velocity': np.zeros(3), 'quaternion': OFF,
              'angular_velocity': np.zeros(3), 'tilt': WOUND, 'tilt_velocity': np.zeros(4),
              **changed}
    return State(stamp, **values, tilt_stamp=stamp)


def fly(unwinding, seconds, begin=0.0, target=TARGET, **changed):
    """Targets of the guidance over a time, every 10 ms."""
    return [unwinding.target(stuck(begin + 0.01 * k, **changed), target)
            for k in range(round(seconds * 100))]


def tilts_at_end(start, end):
    """Tilts (n, 4) after the shortest turns from level attitudes with tilts of zero."""
    return tilts_along(turned(start, end)[1], AXES)[:, -1]


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(
    lambda q: sum(v * v for v in q) > 0.01).map(rotations.normalized)


@settings(max_examples=100, deadline=None)
@given(quaternions)
def test_the_level_attitude_is_the_nearest_one(quaternion):
    level = levelled(quaternion)
    assert rotations.matrix(level)[2] == pytest.approx([0, 0, 1], abs=1e-7)
    way = rotations.geodesic_angle(level, quaternion)
    for yaw in np.linspace(0, 2 * np.pi, 12):
        other = rotations.multiply(rotations.exp(np.array([0, 0, yaw])), level)
        assert rotations.geodesic_angle(other, quaternion) >= way - 1e-6


def uses(start, end):
    """Part of its thrust with which the worst arm can hold weight, along the shortest turn."""
    start, end = Rotation.from_quat(start), Rotation.from_quat(end)
    parts = np.linspace(0, 1, 400)[:, None] * (start.inv() * end).as_rotvec()
    arms = [(start * Rotation.from_rotvec(parts)).apply(axis) for axis in AXES]
    return np.min(np.hypot(*np.moveaxis(arms, -1, 0)[:2]), axis=0)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.05, 0.5), st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi))
def test_the_route_to_an_inverted_attitude_has_no_vertical_arm(off, direction, yaw):
    target = rotations.multiply(rotations.from_rpy(0, 0, yaw), rotations.from_rpy(2.98, 0.02, 0))
    start = rotations.multiply(
        target, rotations.exp(off * np.array([np.cos(direction), np.sin(direction), 0.0])))
    level = level_between(start, target, AXES)
    assert rotations.matrix(level)[2] == pytest.approx([0, 0, 1], abs=1e-7)
    assert min(uses(start, level)) > 0.45 and min(uses(level, target)) > 0.45


def upward(attitude, tilts):
    """World's z (..., 4) of the thrust directions at tilts (..., 4)."""
    tilted = Rotation.from_rotvec((AXES * tilts[..., None]).reshape(-1, 3))
    return (tilted.apply([0, 0, 1]) @ rotations.matrix(attitude)[2]).reshape(tilts.shape)


@settings(max_examples=50, deadline=None)
@given(quaternions, st.floats(-np.pi, np.pi))
def test_after_a_rotation_each_thrust_points_upward_as_far_as_its_arm_permits(end, yaw):
    tilts = tilts_at_end(Rotation.from_euler('z', yaw), Rotation.from_quat(end))[0]
    across = [np.linalg.norm(np.cross(rotations.matrix(end) @ axis, [0, 0, 1])) for axis in AXES]
    assert upward(end, tilts) == pytest.approx(across, abs=1e-6)


def test_a_robot_stuck_at_a_joint_stop_gets_a_level_target_above_its_place_after_the_timeout():
    unwinding = Unwinding(AXES)
    shown = fly(unwinding, 1.0)
    first = next(k for k, t in enumerate(shown) if t is not TARGET)
    assert 0.01 * first == pytest.approx(PATIENCE, abs=0.011)
    assert all(t is shown[-1] for t in shown[first:])
    assert shown[-1].position == pytest.approx([0.0, 0.0, HEIGHT])
    assert rotations.matrix(shown[-1].quaternion)[2, 2] == pytest.approx(1.0)
    assert unwinding.attempts == 1


@pytest.mark.parametrize('low, high, goes_through_level', [
    (0.8, 1.4, True), (0.3, 0.95, False), (0.4, 1.4, False)])
def test_oscillation_about_the_limit_counts_as_missed_and_arrival_does_not(low, high,
                                                                          goes_through_level):
    unwinding = Unwinding(AXES)
    shown = []
    for k in range(300):
        part = low + (high - low) * (0.5 + 0.5 * np.sin(2 * np.pi * 0.01 * k))
        attitude = rotations.multiply(TARGET.quaternion, rotations.exp(
            np.array([0, part * MISSED_ANGLE, 0])))
        shown.append(unwinding.target(stuck(0.01 * k, quaternion=attitude), TARGET))
    assert any(t is not TARGET for t in shown) == goes_through_level


def test_the_target_returns_once_the_joints_are_unwound():
    unwinding = Unwinding(AXES)
    level = fly(unwinding, 1.0)[-1]
    assert fly(unwinding, 0.1, 1.0, quaternion=level.quaternion)[-1] is level    # still wound
    assert fly(unwinding, 0.1, 1.1, quaternion=level.quaternion,
               tilt=np.full(4, 0.5))[-1] is TARGET


UPSIDE_DOWN = PoseTarget(np.array([0.0, 0.0, 1.5]), rotations.from_rpy(2.98, 0.02, 1.6))


def missed(target, seconds=1.0):
    """An unwinding at the start of its route through level, the attitude, and its target."""
    unwinding = Unwinding(AXES)
    off = rotations.multiply(target.quaternion, rotations.exp(np.array([0.0, 0.3, 0.0])))
    return unwinding, fly(unwinding, seconds, target=target, position=target.position,
                          quaternion=off)[-1]


def test_a_long_return_rotation_passes_an_attitude_halfway():
    unwinding, level = missed(UPSIDE_DOWN)
    there = {'target': UPSIDE_DOWN, 'position': UPSIDE_DOWN.position, 'tilt': np.full(4, 0.5)}
    half = fly(unwinding, 0.1, 1.0, quaternion=level.quaternion, **there)[-1]
    turns = [rotations.geodesic_angle(a.quaternion, b.quaternion)
             for a, b in ((level, half), (half, UPSIDE_DOWN), (level, UPSIDE_DOWN))]
    assert turns[0] == pytest.approx(turns[1]) == pytest.approx(turns[2] / 2)
    assert fly(unwinding, 0.1, 1.1, quaternion=level.quaternion, **there)[-1] is half
    near = rotations.multiply(half.quaternion, rotations.exp(np.array([0.0, 0.0, 0.4])))
    assert fly(unwinding, 0.1, 1.2, quaternion=near, **there)[-1] is UPSIDE_DOWN


def test_the_number_of_attempts_is_limited_and_the_target_returns():
    unwinding = Unwinding(AXES)
    shown = fly(unwinding, 30.0)
    away = sum(t is not TARGET for t in shown) * 0.01
    assert unwinding.attempts == ATTEMPTS
    assert away == pytest.approx(ATTEMPTS * DURATION, abs=0.1)
    assert shown[-1] is TARGET


STEPS = np.linspace(-0.5, 0.5, 101)[:, None]
PLACE = np.array([0.5, -0.5, 1.5])
# Inverted with two joints wound by half a turn; the target would wind them further.
START, TILT = rotations.from_rpy(np.pi - 0.2, 0.3, 0.0), np.array([-3.0, -2.9, 3.0, 2.9])


def winding(attitudes, tilt):
    """
    Largest tilts in a slow rotation through attitudes, and the least usable part of a thrust.

    In each step each joint turns by at most half a radian to the most upward thrust direction.
    """
    largest, least = np.abs(tilt).max(), 1.0
    for before, after in zip(attitudes, attitudes[1:]):
        turn = rotations.log(rotations.multiply(rotations.conjugate(before), after))
        count = max(2, round(np.linalg.norm(turn) / 0.05))
        for part in np.arange(1, count + 1) / count:
            attitude = rotations.multiply(before, rotations.exp(part * turn))
            tried = tilt + STEPS
            tilted = Rotation.from_rotvec((AXES * tried[..., None]).reshape(-1, 3))
            up = (tilted.apply([0, 0, 1]) @ rotations.matrix(attitude)[2]).reshape(tried.shape)
            tilt = tilt + STEPS[up.argmax(axis=0), 0]
            largest, least = max(largest, np.abs(tilt).max()), min(least, up.max(axis=0).min())
    return largest, least


def hovering(attitude):
    """Tilts that keep the thrusts upward, each within half a turn."""
    up = rotations.matrix(attitude)[2]
    return np.arctan2(np.cross(AXES, [0, 0, 1]) @ up, up[2])


@settings(max_examples=60, deadline=None)
@given(quaternions, quaternions, st.integers(0, 4))
def test_a_detour_is_taken_where_the_shortest_rotation_exceeds_the_travel(start, end,
                                                                        wound):
    tilt = hovering(start)
    if wound < 4:      # a joint and the opposite one, where a whole turn fits into the travel
        for joint in (wound, (wound + 2) % 4):
            other = tilt[joint] - 2 * np.pi * np.sign(tilt[joint])
            tilt[joint] = other if abs(other) < 3.9 else tilt[joint]
    assume(np.allclose(tilt[:2], -tilt[2:], atol=1e-6))     # otherwise no route unwinds them
    angle = rotations.geodesic_angle(start, end)
    direct, use = winding([start, end], tilt)
    assume(angle < 3.0 and use > 0.35)      # otherwise the direction of the joints is arbitrary
    found = Routing(AXES).between(start, end, tilt)
    if found is None:
        assert direct < ROUTED + 1.5        # no route is better by much
        return
    assert direct > ROUTED - 0.15
    by_way, use = winding([start, found, end], tilt)
    longer = rotations.geodesic_angle(start, found) + rotations.geodesic_angle(found, end) - angle
    assert -1e-9 < longer < 2 * np.pi
    assume(use > 0.35)
    assert by_way < direct and longer < 5.0 * (direct - by_way) + 1.0


END = rotations.from_rpy(0.7, 0.1, 0.3)     # its direct rotation winds joints up to 5.8 rad


def inverted(attitude, **changed):
    return PoseTarget(**{'position': PLACE, 'quaternion': attitude, **changed})


def wound_state(stamp=0.0, quaternion=START):
    return State(stamp, PLACE, np.zeros(3), quaternion, np.zeros(3), TILT, np.zeros(4), stamp)


def test_a_route_is_searched_once_for_each_attitude_and_again_after_reset():
    routing, given = Routing(AXES), inverted(END)
    between = routing.target(wound_state(), given).quaternion
    assert winding([START, between, END], TILT)[0] < 3.9
    for off, passed in ((NEAR + 0.05, False), (NEAR - 0.05, True)):
        near = rotations.multiply(between, rotations.exp(np.array([0.0, off, 0.0])))
        assert (routing.target(wound_state(0.1, near), given) is given) == passed
    little = rotations.multiply(END, rotations.exp(np.array([0.1, 0.0, 0.0])))
    for same in (inverted(END), inverted(END, position=PLACE + 1), inverted(little)):
        assert routing.target(wound_state(5.0), same) is same
    assert routing.target(wound_state(6.0), inverted(START)).quaternion is START    # no turn
    assert routing.target(wound_state(7.0), inverted(END)).quaternion is not END
    assert routing.routed == 2
    routing.reset()
    assert routing.routed == 0
    assert routing.target(wound_state(8.0), inverted(END)).quaternion is not END
