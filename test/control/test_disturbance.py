"""Prediction of the state at which a command acts."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.control.disturbance import (
    DisturbanceEstimator,
    FunctionCall,
    RESOLUTION,
)
from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.evaluation.loop import FlightLoop
from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot.parameters import find_robot, RobotParameters
from beetle_omni_ros.robot.servo import NUMPY, Servo, Step
from beetle_omni_ros.runs.log import LogRecorder

ROBOT = RobotParameters.load()
HOVER = ROBOT.hover_thrust
PERIOD, FINE = 0.01, 0.0005


def command(k):
    """Return the command that answers the state at time k PERIOD."""
    return Command(k * PERIOD, 0.3 * np.sin(k + np.arange(4.0)), HOVER + np.cos(k * np.ones(4)))


@pytest.mark.parametrize('delay', [0.01, 0.02, 0.035, 0.06])
def test_each_command_within_the_delay_acts_from_its_own_time(delay):
    p = NmpcParameters.load()
    p = replace(p, model=replace(p.model, command_delay=delay))
    advance = FunctionCall(model.integrator(ROBOT))
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
        x = advance(x, np.r_[u.tilt, u.thrust], estimator.disturbance, FINE)
    for part, tolerance in ((model.VELOCITY, 2e-3), (model.RATE, 5e-3), (model.TILT, 4e-3),
                            (model.THRUST, 1e-3)):
        assert np.allclose(predicted[part], x[part], atol=tolerance)


def driven(target, duration, band=0.0, sag=0.0):
    """Estimator of a robot at rest whose servos follow target(t), with a friction band and sag."""
    p, friction = NmpcParameters.load(), band * ROBOT.joints.kp
    robot = replace(ROBOT, effects={'joint_friction': {
        'coulomb': friction, 'stiction': friction}} if band else {})
    estimator = DisturbanceEstimator(robot, p.disturbance, p.model.command_delay,
                                     FunctionCall(model.integrator(ROBOT)))
    step = Step(NUMPY, Servo.of(ROBOT.joints, coulomb=friction, stiction=friction), FINE)
    tilt, rate, sent, hover = np.zeros(4), np.zeros(4), None, np.full(4, HOVER)
    for k in range(round(duration / PERIOD)):
        state = State(k * PERIOD, np.zeros(3), np.zeros(3), np.array([0.0, 0, 0, 1]), np.zeros(3),
                      tilt, np.rint(rate / 0.024) * 0.024, k * PERIOD, sent)
        estimator.observe(state)
        acting = tilt if sent is None else sent.tilt     # after the command's delay of a period
        sent = Command(k * PERIOD, np.full(4, target(k * PERIOD)), hover)
        for _ in range(round(PERIOD / FINE)):
            tilt, rate = step(acting + sag, tilt, rate)
    return estimator, tilt


def test_a_sagging_servo_is_learnt_within_ten_time_constants():
    bandwidth = NmpcParameters.load().disturbance.tilt_bandwidth
    estimator, _ = driven(lambda t: 0.2, 10 / bandwidth, sag=0.05)
    assert np.allclose(estimator.disturbance[model.TILT_OFFSET], 0.05, atol=0.005)


def test_a_servo_held_by_friction_does_not_wind_up_the_offset():
    band = 0.03
    estimator, tilt = driven(lambda t: 0.5 * band, 5.0, band=band)
    assert np.all(tilt == 0.0)      # it was held
    assert np.abs(estimator.disturbance[model.TILT_OFFSET]).max() < 0.1 * band
    assert np.abs(estimator._state[model.TILT]).max() < 0.1 * band


def test_targets_reverse_by_more_than_noise_only():
    estimator, _ = driven(lambda t: 0.1, 1.0, band=0.02)
    plan = estimator._commands[-1].tilt + 0.01
    for back, side in ((0.0, 1), (0.9 * RESOLUTION, 1), (1.1 * RESOLUTION, -1)):
        sent = estimator.sent(plan - back)
        assert np.allclose(sent, plan - back + side * 0.02)
        estimator._commands.append(estimator._moving(Command(1.0, sent, np.zeros(4))))


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
