"""Hover law and NMPC with a rotor lost or a servo stuck: commands, recovery, targets."""

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget, State
from beetle_omni_ros.control.disturbance import FunctionCall
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.robot import dynamics as model
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import ActuatorHealth, ALL_HEALTHY
from beetle_omni_ros.robot.degraded import Holding
from beetle_omni_ros.robot.parameters import RobotParameters

ROBOT = RobotParameters.load()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
LOST = ActuatorHealth(rotors=(True, False, True, True))
STUCK = ActuatorHealth(stuck=(None, None, 0.8, None))
WEAK = ActuatorHealth(thrust_limit=8.8)
PLACE = np.array([0.0, 0.0, 2.0])


def held(health):
    """Attitude nearest to level with the margin for flying."""
    holding = Holding(ROBOT, health)
    return holding.nearest(LEVEL, holding.parameters.flying_margin)


class Body:
    """The CasADi model with broken actuators; a command acts 10 ms after its state."""

    def __init__(self):
        self.advance = FunctionCall(model.integrator(ROBOT, 4))
        self.x = np.zeros(25)
        self.x[:3], self.x[9], self.x[21:] = PLACE, 1.0, ROBOT.hover_thrust
        self.time, self.broken = 0.0, ALL_HEALTHY
        self.command = Command(-0.01, self.x[model.TILT], self.x[model.THRUST])
        self.lowest = np.inf

    def fly(self, controller, target, seconds):
        for _ in range(round(seconds / 0.01)):
            x = self.x
            following = controller.step(
                State(self.time, x[:3], x[3:6], x[6:10], x[10:13], x[13:17], x[17:21], self.time,
                      self.command), target)
            acting = self.broken.possible(self.command.tilt, self.command.thrust)
            self.x = self.advance(x, np.concatenate(acting), np.zeros(10), 0.01)
            self.command, self.time = following, self.time + 0.01
            self.lowest = min(self.lowest, self.x[2])
        return self


@pytest.fixture(scope='module')
def nmpc():
    return NmpcController(ROBOT)


@pytest.fixture(params=['nmpc', 'hover'])
def controller(request, nmpc):
    chosen = nmpc if request.param == 'nmpc' else HoverController(ROBOT)
    chosen.set_health(ALL_HEALTHY)
    chosen.reset()
    return chosen


@pytest.mark.parametrize('health', [LOST, STUCK, WEAK])
def test_recovers_from_hover_and_holds_the_flight_attitude(controller, health):
    body = Body().fly(controller, PoseTarget(PLACE, LEVEL), 0.5)
    body.broken = health
    body.fly(controller, PoseTarget(PLACE, LEVEL), 0.1)
    controller.set_health(health)
    target = PoseTarget(PLACE, held(health))
    body.fly(controller, target, 7.0)
    assert body.lowest > 1.4
    assert np.linalg.norm(body.x[:3] - PLACE) < 0.03
    assert rotations.geodesic_angle(body.x[6:10], target.quaternion) < np.radians(2)


@pytest.mark.parametrize('health', [LOST, STUCK, WEAK])
def test_commands_use_the_remaining_actuators_from_the_first_step(controller, health):
    body = Body().fly(controller, PoseTarget(PLACE, LEVEL), 0.2)
    controller.set_health(health)
    for _ in range(5):
        body.fly(controller, PoseTarget(PLACE, rotations.from_rpy(0.5, -0.3, 0.2)), 0.01)
        tilt, thrust = health.possible(body.command.tilt, body.command.thrust)
        np.testing.assert_array_equal(body.command.tilt, tilt)
        np.testing.assert_array_equal(body.command.thrust, thrust)


def test_after_repair_the_commands_equal_those_without_a_fault(controller):
    fresh = Body().fly(controller, PoseTarget(PLACE, LEVEL), 0.3).command
    controller.set_health(LOST)
    Body().fly(controller, PoseTarget(PLACE, LEVEL), 0.3)
    controller.set_health(ALL_HEALTHY)
    controller.reset()
    again = Body().fly(controller, PoseTarget(PLACE, LEVEL), 0.3).command
    np.testing.assert_array_equal(fresh.tilt, again.tilt)
    np.testing.assert_array_equal(fresh.thrust, again.thrust)


def test_the_disturbance_estimate_is_reset_after_an_actuator_loss(nmpc):
    nmpc.set_health(ALL_HEALTHY)
    nmpc.reset()
    body = Body().fly(nmpc, PoseTarget(PLACE, LEVEL), 0.5)
    body.broken = LOST
    body.fly(nmpc, PoseTarget(PLACE, LEVEL), 0.1)
    assert np.linalg.norm(nmpc.disturbance[model.TORQUE]) > 0.1
    nmpc.set_health(LOST)
    assert np.linalg.norm(nmpc.disturbance[model.TORQUE]) < 0.01
