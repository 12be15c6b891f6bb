"""Hover law and NMPC with a rotor lost or a servo stuck: commands, recovery, targets."""

from body import Body, LEVEL, ROBOT
import numpy as np
import pytest

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.control.nmpc import NmpcController
from beetle_omni_ros.model import rotations
from beetle_omni_ros.model.allocation import ActuatorHealth, ALL_HEALTHY
from beetle_omni_ros.model.degraded import FLYING_MARGIN, Holding

LOST = ActuatorHealth(rotors=(True, False, True, True))
STUCK = ActuatorHealth(stuck=(None, None, 0.8, None))
WEAK = ActuatorHealth(thrust_limit=8.8)
PLACE = np.array([0.0, 0.0, 2.0])


def held(health):
    """Attitude nearest to level with the margin for flying."""
    return Holding(ROBOT, health).nearest(LEVEL, FLYING_MARGIN)


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
    body = Body(PLACE).fly(controller, PoseTarget(PLACE, LEVEL), 0.5)
    body.broken = health
    body.fly(controller, PoseTarget(PLACE, LEVEL), 0.1)
    controller.set_health(health)
    target = PoseTarget(PLACE, held(health))
    body.fly(controller, target, 7.0)
    assert min(x[2] for _, x, _ in body.trace) > 1.4
    position, turn = body.errors(target)[-1]
    assert position < 0.03 and turn < np.radians(2)


@pytest.mark.parametrize('health', [LOST, STUCK, WEAK])
def test_commands_use_the_remaining_actuators_from_the_first_step(controller, health):
    body = Body(PLACE).fly(controller, PoseTarget(PLACE, LEVEL), 0.2)
    controller.set_health(health)
    for _ in range(5):
        body.fly(controller, PoseTarget(PLACE, rotations.from_rpy(0.5, -0.3, 0.2)), 0.01)
        tilt, thrust = health.possible(body.command.tilt, body.command.thrust)
        np.testing.assert_array_equal(body.command.tilt, tilt)
        np.testing.assert_array_equal(body.command.thrust, thrust)
