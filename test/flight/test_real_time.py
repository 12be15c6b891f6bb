"""The loop with drivers, serial ports and emulated devices, without ROS."""

from contextlib import closing

import numpy as np
import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from beetle_omni_ros.bags.log import LogRecorder
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.control.hover import HoverController
from beetle_omni_ros.flight.bridges import EmulatedLoop
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.faults import Fault

pytestmark = pytest.mark.real_time
ROBOT = RobotParameters.load()


@pytest.mark.alone
def test_a_flight_through_drivers_and_emulated_devices_holds_its_target():
    recorder = LogRecorder()
    with closing(EmulatedLoop(ROBOT, ROBOT, {'hover': HoverController(ROBOT)}, recorder)) as loop:
        loop.take_off()
        loop.aim(PoseTarget(np.array([0.0, 0.0, 1.0]), np.array([0, 0, 0, 1.0]), loop.now()))
        loop.run(2.0)
        truth = loop.simulator.truth
        # a stall of the computer leads to the fallback, which is the same controller
        assert loop.supervisor.state in ('flying', 'fallback')
        assert loop.supervisor.inputs.bridges == {'joint': 'ready', 'rotor': 'ready'}
    assert np.linalg.norm(truth.position - [0, 0, 1.0]) < 0.1
    log = recorder.log()
    # Angles in counts of the encoder: they passed the registers of the servos.
    counts = log.joint.position[-200:] / (2 * np.pi / 4096)
    assert np.allclose(counts, np.round(counts), atol=1e-6) and len(log.joint.t) > 400
    assert len(log.battery.t) > 4


def test_faults_of_devices_need_direct_actuators():
    with pytest.raises(ParameterError, match='--actuators direct'):
        EmulatedLoop(ROBOT, ROBOT, {'hover': HoverController(ROBOT)}, LogRecorder(),
                     faults=[Fault('rotor_speed_lost')])
