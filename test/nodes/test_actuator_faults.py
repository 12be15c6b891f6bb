"""
Faults of servos and motor board in flight: what the robot does, who says why, what is left on.

The whole graph flies through both bridges. Faults are switched on in the emulated devices by
sim_node's parameters; what the rotors and servos really do is read from the simulator.
"""

import numpy as np
import pytest
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from witness import PATIENT, READY, Witness

from beetle_omni_ros.nodes.actuators import bridged, BRIDGES
from beetle_omni_ros.nodes.graph import Graph

FLYING = 'flying:nmpc'
DEVICES = 'sim_node: devices'


class Mechanic(Witness):
    """A witness who breaks and mends the simulated devices."""

    def __init__(self, domain):
        super().__init__(domain)
        self._client = AsyncParameterClient(self._node, 'sim_node')

    def set(self, name, value):
        """Set a parameter of sim_node."""
        assert self.wait(self._client.services_are_ready, 10), 'sim_node is not there'
        future = self._client.set_parameters([Parameter(name, value=value)])
        assert self.wait(future.done, 5), 'sim_node does not answer'
        result = future.result().results[0]
        assert result.successful, result.reason

    def device(self, key):
        """What the simulator says about its devices, fresh; a number or a text."""
        self.diagnostics.pop(DEVICES, None)
        assert self.wait(lambda: DEVICES in self.diagnostics, 5), 'sim_node is silent'
        return self.values(DEVICES)[key]

    def take_off(self):
        """Arm, as soon as the bridges are ready, and wait until the controller flies."""
        assert self.wait(lambda: not self.waits_for(BRIDGES), 20), self.waits_for(BRIDGES)
        assert self.wait(lambda: self.call('arm')[0], 10), self.call('arm')
        assert self.wait(lambda: self.state == FLYING, 30), self.states

    def says(self, node, status, text):
        """Wait until a status of ``node`` has said ``text``, as message or value."""
        def said():
            found = self.diagnostics.get(f'{node}: {status}')
            return found is not None and text in ' '.join(
                [found.message, *(f'{pair.key} {pair.value}' for pair in found.values)])
        return self.wait(said, 5)


@pytest.fixture
def robot(ros_domain, tmp_path):
    """Graph and mechanic of a robot in the air."""
    parameters = {'sim_node': {}, 'ekf_node': {}, 'nmpc_node': {}, 'supervisor_node': PATIENT}
    for node, values in bridged(tmp_path, {}).items():
        parameters[node] = {**parameters.get(node, {}), **values}
    graph, mechanic = Graph(parameters, tmp_path, ros_domain), None
    try:
        graph.start()
        mechanic = Mechanic(ros_domain)
        assert mechanic.wait(lambda: mechanic.ready, READY), graph.dead()
        mechanic.take_off()
        yield graph, mechanic
    finally:
        stubborn = graph.stop()
        if mechanic:
            mechanic.close()
    assert not stubborn


# name, value, value when mended; node, status and text that tell of it
BEARABLE = [
    ('servo_faults.bad_crc', 0.05, 0.0, 'joint_bridge_node', 'bus', 'corrupt'),
    ('servo_faults.dropped', 0.05, 0.0, 'joint_bridge_node', 'bus', 'missing'),
    ('servo_faults.delayed', 0.05, 0.0, 'joint_bridge_node', 'bus', 'missing'),
    ('servo_faults.expire_watchdog', 3, 0, 'joint_bridge_node', 'bus', 'cycles'),
    ('board_faults.corrupt_in', 0.1, 0.0, 'rotor_bridge_node', 'board', 'lost'),
    ('board_faults.corrupt_out', 0.1, 0.0, 'rotor_bridge_node', 'board', 'bad_crc'),
    ('board_faults.drop_out', 0.1, 0.0, 'rotor_bridge_node', 'board', 'lost'),
    ('board_faults.voltage_sag', 1.0, 0.0, 'rotor_bridge_node', 'board', 'voltage'),
]


def test_faults_that_drivers_bear_do_not_end_a_flight(robot):
    graph, mechanic = robot
    for name, value, mended, node, status, text in BEARABLE:
        mechanic.set(name, value)
        assert mechanic.stays_in_the_air(1.0), name
        mechanic.set(name, mended)
        assert mechanic.says(node, status, text), name
        assert mechanic.state == FLYING, (name, mechanic.states)
    assert np.linalg.norm(mechanic.truth.velocity) < 0.3
    assert not graph.dead()


# name, value, value when mended; what joint_bridge_node's state says
LANDING = [
    ('servo_faults.silent', [2], [], 'gimbal2'),
    ('servo_faults.overheated', [3], [], 'gimbal3'),
    ('servo_faults.overload', [1], [], 'gimbal1'),
    ('servo_faults.unplugged', True, False, ''),
]


def test_a_servo_that_does_not_obey_ends_the_flight_with_a_landing(robot):
    graph, mechanic = robot
    for name, value, mended, text in LANDING:
        mechanic.set(name, value)
        assert mechanic.wait(lambda: mechanic.state == 'landing', 3), (name, mechanic.states)
        assert mechanic.bridges['joint_bridge_node'].startswith('lost') \
            or mechanic.wait(lambda: mechanic.bridges['joint_bridge_node'].startswith('lost'), 2)
        assert text in mechanic.bridges['joint_bridge_node']
        falling = []
        assert mechanic.wait(lambda: falling.append(mechanic.truth.velocity[2])
                             or mechanic.state in ('disarmed', 'emergency_stop'), 25), name
        assert mechanic.state == 'disarmed' and min(falling) > -1.5, (name, min(falling))
        mechanic.set(name, mended)
        if name != LANDING[-1][0]:
            assert mechanic.call_bridge('reboot')
            mechanic.take_off()
    assert not graph.dead()
