"""Detours around joint stops: their condition, their winding, and their end."""

from dataclasses import replace

from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beetle_omni_ros.control.base import PoseTarget, State
from beetle_omni_ros.control.guidance.routing import Routing, RoutingParameters, spread_attitudes
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import RobotParameters

P = RoutingParameters()
AXES = RobotParameters.load().tilt_axes
STEPS = np.linspace(-0.5, 0.5, 101)[:, None]
PLACE = np.array([0.5, -0.5, 1.5])
# Inverted with two joints wound by half a turn; the target would wind them further.
START, TILT = rotations.from_rpy(np.pi - 0.2, 0.3, 0.0), np.array([-3.0, -2.9, 3.0, 2.9])
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(
    lambda q: sum(v * v for v in q) > 0.01).map(rotations.normalized)


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
    found = Routing(P, AXES).between(start, end, tilt)
    if found is None:
        assert direct < P.tilt + 1.5        # no route is better by much
        return
    assert direct > P.tilt - 0.15
    by_way, use = winding([start, found, end], tilt)
    longer = rotations.geodesic_angle(start, found) + rotations.geodesic_angle(found, end) - angle
    assert -1e-9 < longer < 2 * np.pi
    assume(use > 0.35)
    assert by_way < direct and longer < 5.0 * (direct - by_way) + 1.0


def target(attitude, **changed):
    return PoseTarget(**{'position': PLACE, 'quaternion': attitude, **changed})


def beyond():
    """An attitude for which the joints at START would be wound further by more than a radian."""
    for end in spread_attitudes(200):
        largest, use = winding([START, end], TILT)
        if 1.5 < rotations.geodesic_angle(START, end) < 2.5 and largest > 4.5 and use > 0.4:
            return end
    raise AssertionError('no such attitude')


END = beyond()


def state(stamp=0.0, quaternion=START, tilt=TILT):
    return State(stamp, PLACE, np.zeros(3), quaternion, np.zeros(3), tilt, np.zeros(4), stamp)


def test_wound_joints_return_within_their_travel_on_the_chosen_route():
    given = target(END)
    shown = Routing(P, AXES).target(state(), given)
    assert shown is not given and shown.position is given.position
    assert winding([START, END], TILT)[0] > 4.5
    assert winding([START, shown.quaternion, END], TILT)[0] < 3.9


def test_the_target_is_passed_on_near_the_intermediate_attitude():
    routing, given = Routing(P, AXES), target(END)
    between = routing.target(state(), given).quaternion
    for off, passed in ((P.near + 0.05, False), (P.near - 0.05, True)):
        near = rotations.multiply(between, rotations.exp(np.array([0.0, off, 0.0])))
        assert (routing.target(state(0.1, near), given) is given) == passed
    assert routing.target(state(0.2), given) is given       # and does not come back
    assert routing.routed == 1


def test_the_target_is_passed_on_after_the_time_limit():
    routing, given = Routing(P, AXES), target(END)
    shown = [routing.target(state(0.01 * k), given) is given for k in range(300)]
    assert shown.index(True) == round(P.duration * 100) and all(shown[shown.index(True):])


def test_a_route_is_searched_once_for_each_attitude_and_again_after_reset():
    routing = Routing(P, AXES)
    assert routing.target(state(), target(END)).quaternion is not END
    routing.target(state(5.0), target(END))
    little = rotations.multiply(END, rotations.exp(np.array([0.1, 0.0, 0.0])))
    for same in (target(END), target(END, position=PLACE + 1), target(little)):
        assert routing.target(state(5.0), same) is same
    assert routing.target(state(6.0), target(START)).quaternion is START    # nothing to turn
    assert routing.target(state(7.0), target(END)).quaternion is not END
    assert routing.routed == 2
    routing.reset()
    assert routing.routed == 0
    assert routing.target(state(8.0), target(END)).quaternion is not END


@pytest.mark.parametrize('changed', [{'quaternion': np.full(4, np.nan)},
                                     {'tilt': np.array([np.nan, 0.0, 0.0, 0.0])}], ids=str)
def test_a_route_begins_at_the_first_finite_state(changed):
    routing, given = Routing(P, AXES), target(END)
    assert routing.target(state(**changed), given) is given
    assert routing.target(state(0.01), given) is not given


def test_without_a_limit_targets_pass_unchanged():
    given = target(END)
    assert Routing(replace(P, tilt=100.0), AXES).target(state(), given) is given


def test_the_attitude_samples_cover_all_rotations():
    attitudes = spread_attitudes(150)
    assert np.linalg.norm(attitudes, axis=1) == pytest.approx(np.ones(150))
    others = Rotation.random(2000, random_state=0).as_quat()
    off = 2 * np.arccos(np.minimum(np.abs(others @ attitudes.T).max(axis=1), 1.0))
    assert np.degrees(off).max() < 50
    pairs = np.abs(attitudes @ attitudes.T) - 2 * np.eye(150)
    assert np.degrees(2 * np.arccos(pairs.max())) > 20
