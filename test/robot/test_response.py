"""Limits of the actuators' responses by intervals and effects of a robot file."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.servo import Responses

RANGES = ('servo_lag', 'servo_delay', 'rotor_lag', 'rotor_delay')


@pytest.mark.parametrize('name', ['measured', None])
def test_a_drawn_robot_responds_within_the_limits_of_its_file(name):
    robot = RobotParameters.load(name)
    allowed = Responses.of(robot)
    for seed in range(50):
        own = Responses.of(robot.drawn(np.random.default_rng(seed)))
        for key in RANGES:
            (low, high), (least, most) = getattr(own, key), getattr(allowed, key)
            assert least - 1e-12 <= low <= high <= most + 1e-12, key
        assert own.friction <= allowed.friction


def test_without_intervals_the_limits_are_the_numbers_of_file_and_effects():
    robot = replace(RobotParameters.load(), intervals={}, effects={
        'command_latency': {'delay': 0.01}, 'joint_command_latency': {'delay': 0.02},
        'joint_feedback_delay': {'delay': 0.005}, 'rotor_lag': {'time_constant': 0.2},
        'joint_friction': {'coulomb': 0.01, 'stiction': 0.02}})
    found = Responses.of(robot)
    expected = {'servo_lag': robot.joints.time_constant, 'servo_delay': 0.035, 'rotor_lag': 0.2,
                'rotor_delay': 0.01}
    for key, value in expected.items():
        assert getattr(found, key) == pytest.approx((value, value))
    assert found.friction == pytest.approx(0.02 / robot.joints.kp)
