"""Prediction of the state at which a command acts."""

from dataclasses import replace

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.control.call import FunctionCall
from beetle_omni_ros.control.disturbance import DisturbanceEstimator
from beetle_omni_ros.control.nmpc_parameters import NmpcParameters
from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot.parameters import RobotParameters

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
    advance = FunctionCall(model.integrator(ROBOT), None)
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
