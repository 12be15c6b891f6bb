"""The moving target: its velocity is the derivative of its pose; its end pose."""

import numpy as np
import pytest

from beetle_omni_ros.robot import rotations
from beetle_omni_ros.safety.levelling import Way
from beetle_omni_ros.safety.ramp import inclination, Ramp


def ramp(climb=-0.8, wait=0.5):
    rng = np.random.default_rng(1)
    start = rotations.normalized(rng.normal(size=4))
    level = rotations.from_rpy(0.0, 0.0, rotations.to_rpy(start)[2])
    return Ramp(10.0, np.array([1.0, 2.0, 3.0]), Way.straight(start, level, 0.8), wait, climb,
                0.4, 0.5)


@pytest.mark.parametrize('climb', [-0.8, 0.8, 0.1, -np.inf])
def test_velocities_are_the_derivatives_of_the_pose(climb):
    way, h = ramp(climb), 1e-5
    for time in np.linspace(10.03, 16.03, 61):
        before, now, after = (way.at(t) for t in (time - h, time, time + h))
        np.testing.assert_allclose((after.position - before.position) / (2 * h), now.velocity,
                                   atol=1e-4)
        turn = rotations.log(rotations.multiply(rotations.conjugate(before.quaternion),
                                                after.quaternion))
        if abs(time - 10 - way.way.duration) > 2 * h:
            np.testing.assert_allclose(turn / (2 * h), now.angular_velocity, atol=1e-4)


def test_starts_at_its_start_and_ends_level_at_the_height():
    way = ramp(0.8)
    first, last = way.at(10.0), way.at(10.0 + way.duration)
    np.testing.assert_allclose(first.position, way.position)
    np.testing.assert_allclose(last.position, way.position + [0, 0, 0.8])
    assert inclination(last.quaternion) < 1e-6
    assert np.abs(way.at(10.4).position - way.position).max() == 0   # it waits


def test_a_moving_ramp_has_its_speed_from_the_start():
    way = Ramp(1.0, np.zeros(3), Way.straight(*[np.array([0, 0, 0, 1.0])] * 2, 1.0), 0.0, -np.inf,
               0.3, 0.5, moving=True)
    assert way.at(1.0).velocity[2] == way.at(3.0).velocity[2] == -0.3
    assert way.at(3.0).position[2] == pytest.approx(-0.6)
