"""Attitudes on the way between two others: level ones, detours, and the tilts along turns."""

from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.guidance import level_between, route, ROUTED
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.parameters import RobotParameters

AXES = RobotParameters.load().tilt_axes
STEPS = np.linspace(-0.5, 0.5, 101)[:, None]
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(
    lambda q: sum(v * v for v in q) > 0.01).map(rotations.normalized)


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
def test_a_detour_is_taken_where_the_shortest_rotation_exceeds_the_travel(start, end, wound):
    tilt = hovering(start)
    if wound < 4:      # a joint and the opposite one, where a whole turn fits into the travel
        for joint in (wound, (wound + 2) % 4):
            other = tilt[joint] - 2 * np.pi * np.sign(tilt[joint])
            tilt[joint] = other if abs(other) < 3.9 else tilt[joint]
    assume(np.allclose(tilt[:2], -tilt[2:], atol=1e-6))     # otherwise no route unwinds them
    angle = rotations.geodesic_angle(start, end)
    direct, use = winding([start, end], tilt)
    assume(angle < 3.0 and use > 0.35)      # otherwise the direction of the joints is arbitrary
    found = route(start, end, tilt, AXES)
    if found is None:
        assert direct < ROUTED + 1.5        # no route is better by much
        return
    assert direct > ROUTED - 0.15
    by_way, use = winding([start, found, end], tilt)
    longer = rotations.geodesic_angle(start, found) + rotations.geodesic_angle(found, end) - angle
    assert -1e-9 < longer < 2 * np.pi
    assume(use > 0.35)
    assert by_way < direct and longer < 5.0 * (direct - by_way) + 1.0
