"""Modules load their joints, both as described in the robot file and as an effect."""

from dataclasses import replace

from flights import Motion, P, ROBOT
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.servo import module_load, simulate, undescribed_load, Windows
from beetle_omni_ros.identify.gap.signals import Signals
from beetle_omni_ros.robot.parameters import RobotParameters

DESCRIBED, MOTION = RobotParameters.load(), Motion()


def test_undescribed_modules_load_joints_as_described_ones_of_equal_moment_and_inertia():
    flight, module = MOTION.flight(), DESCRIBED.multibody.module
    moment = -module.mass * module.centre_of_mass[2]
    inertia = module.inertia[0] - moment * module.centre_of_mass[2]
    expected = module_load(Signals(flight, DESCRIBED, P), {})
    hanging, turning = undescribed_load(Signals(flight, ROBOT, P), {})
    found = moment * hanging + inertia * turning
    assert np.std(found - expected) < 0.05 * np.std(expected)
    assert np.std(moment * hanging - expected) > np.std(found - expected)


def test_described_module_loads_are_not_counted_twice():
    flight = MOTION.flight()
    assert undescribed_load(Signals(flight, DESCRIBED, P), {}) == ()
    assert not module_load(Signals(flight, ROBOT, P), {}).any()


@pytest.mark.parametrize('sets, base, moment', [
    ({'module_reaction.mass_moment': 2e-3}, 0.0, 2e-3), ({}, 1e-3, 1e-3),
    ({'module_reaction.mass_moment': -4e-4}, 1e-3, 6e-4)])
def test_a_servo_sags_under_a_module_that_hangs_beside_its_axis(sets, base, moment):
    k, gravity = 800, 9.8
    zero, one = np.zeros((k, 1, 4)), np.ones((k, 1, 4))
    windows = Windows(zero[0], zero[0], zero, zero, zero, P.servo_step, 0, 8,
                      (gravity * one, zero))
    robot = replace(ROBOT, effects={'module_reaction': {'module_inertia': 0.0,
                                                        'mass_moment': base}})
    shown = simulate(robot, windows, np.zeros((1, k, 1, 4)), [sets], 0.0)[0, -1, 0]
    assert shown == pytest.approx(moment * gravity / ROBOT.joints.kp, rel=1e-3)
