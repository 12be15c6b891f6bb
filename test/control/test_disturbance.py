"""Prediction of the state at which a command acts."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.control.disturbance import DisturbanceEstimator
from beetle_omni_ros.control.nmpc import NmpcController, NmpcParameters
from beetle_omni_ros.flight.loop import FlightLoop
from beetle_omni_ros.model import dynamics as model
from beetle_omni_ros.model.native import buffered
from beetle_omni_ros.model.parameters import find_robot, RobotParameters

ROBOT = RobotParameters.load()
HOVER = ROBOT.hover_thrust
PERIOD, FINE = 0.01, 0.0005


def command(k):
    """Return the command that answers the state at time k PERIOD."""
    return Command(k * PERIOD, 0.3 * np.sin(k + np.arange(4.0)), HOVER + np.cos(k * np.ones(4)))


@pytest.mark.parametrize('delay', [0.01, 0.035])
def test_each_command_within_the_delay_acts_from_its_own_time(delay):
    p = NmpcParameters.load()
    p = replace(p, model=replace(p.model, command_delay=delay))
    advance = model.integrator(ROBOT)
    estimator = DisturbanceEstimator(ROBOT, p.disturbance, p.model.command_delay, advance)
    now, rest = 12, State(0.0, np.zeros(3), np.zeros(3), np.array([0.0, 0, 0, 1]), np.zeros(3),
                          np.zeros(4), np.zeros(4), 0.0)
    for k in range(now + 1):    # the robot is at rest; only the last prediction is tested
        estimator.disturbance[:] = 0.0
        predicted = estimator.update(replace(rest, stamp=k * PERIOD, tilt_stamp=k * PERIOD,
                                             command=command(k - 1) if k else None))
    # the same from the state at its stamp, in small steps
    x, t = estimator._state.copy(), now * PERIOD
    for step in range(round(delay / FINE)):
        at = t + (step + 0.5) * FINE - delay
        u = command(min(int(np.floor(at / PERIOD + 1e-9)), now - 1))
        x = buffered(advance)(x, np.r_[u.tilt, u.thrust], estimator.disturbance, FINE)
    for part, tolerance in ((model.VELOCITY, 2e-3), (model.RATE, 5e-3), (model.TILT, 4e-3),
                            (model.THRUST, 1e-3)):
        assert np.allclose(predicted[part], x[part], atol=tolerance)


def test_a_servo_held_by_friction_does_not_wind_up_the_offset():
    band, p = 0.03, NmpcParameters.load()
    friction = band * ROBOT.joints.kp
    robot = replace(ROBOT, effects={'joint_friction': {'coulomb': friction, 'stiction': friction}})
    estimator = DisturbanceEstimator(robot, p.disturbance, p.model.command_delay,
                                     model.integrator(ROBOT))
    rest, sent = np.zeros(4), None      # targets within the band do not move the joints
    for k in range(500):
        estimator.observe(State(k * PERIOD, np.zeros(3), np.zeros(3), np.array([0.0, 0, 0, 1]),
                                np.zeros(3), rest, rest, k * PERIOD, sent))
        sent = Command(k * PERIOD, np.full(4, 0.5 * band), np.full(4, HOVER))
    assert np.abs(estimator.disturbance[model.TILT_OFFSET]).max() < 0.1 * band
    assert np.abs(estimator._state[model.TILT]).max() < 0.1 * band


def test_the_measured_robot_with_friction_of_its_servos_does_not_hunt_in_hover():
    robot = RobotParameters.load(find_robot('measured'))
    loop = FlightLoop(robot, robot, {'nmpc': NmpcController(robot)}, LogRecorder())
    loop.take_off()
    start = loop.simulator.time
    loop.aim(PoseTarget(np.array([0, 0, 1.0]), np.array([0, 0, 0, 1.0])))
    rates = []
    while loop.simulator.time < start + 6.0:
        loop.step()
        rates.append(np.linalg.norm(loop.simulator.truth.angular_velocity))
    # An encoder count of all tilts accelerates yaw by 0.13 rad/s^2: this rate needs 0.2 s.
    assert np.sqrt(np.mean(np.square(rates[-400:]))) < 0.03
