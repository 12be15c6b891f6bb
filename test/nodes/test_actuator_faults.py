"""
Faults of servos and motor board in flight: reaction of the robot, report, final actuator state.

The whole graph flies through both bridges. Parameters of sim_node switch faults of the emulated
devices on. The true state of rotors and servos is read from the simulator. test/sim and
test/drivers have all faults.
"""

import numpy as np
import pytest
from std_srvs.srv import Trigger
from witness import PATIENT, running_graph, Witness

from beetle_omni_ros.nodes.graph import bridge_parameters, BRIDGES, BRIDGES_COMPOSED

pytestmark = pytest.mark.alone

FLYING = 'flying:nmpc'
DEVICES = 'sim_node: devices'


class FaultOperator(Witness):
    """Witness that sets faults of the simulated devices."""

    def set(self, name, value):
        """Set a parameter of sim_node."""
        accepted, reason = super().set('sim_node', name, value)
        assert accepted, reason

    def device(self, key):
        """Newest value of the devices' diagnostics, as number or text."""
        self.diagnostics.pop(DEVICES, None)
        assert self.wait(lambda: DEVICES in self.diagnostics, 5), 'sim_node is silent'
        return self.values(DEVICES)[key]

    def start(self):
        """Arm as soon as the bridges are ready, and wait until the controller flies."""
        assert self.wait(lambda: not self.waits_for(BRIDGES), 20), self.waits_for(BRIDGES)
        self.take_off(lambda: self.state == FLYING)

    def count(self, node, status, key):
        """A counter of a bridge's diagnostics; 0 if missing."""
        return int(self.values(f'{node}: {status}').get(key, 0))

    def ask(self, service):
        """Call a service of joint_bridge_node."""
        client = self._node.create_client(Trigger, f'joint_bridge_node/{service}')
        assert self.wait(client.service_is_ready, 5)
        future = client.call_async(Trigger.Request())
        assert self.wait(future.done, 5)
        return future.result().success


# parameters of sim_node, set and reset; bridge, status and counters of the faults
BEARABLE = [
    ({'servo_faults.bad_crc': 0.03, 'servo_faults.dropped': 0.03, 'servo_faults.delayed': 0.01,
      'servo_faults.supply_voltage': 14.5, 'servo_faults.expire_watchdog': 3},
     {'servo_faults.bad_crc': 0.0, 'servo_faults.dropped': 0.0, 'servo_faults.delayed': 0.0,
      'servo_faults.supply_voltage': 12.0}, 'joint', 'bus', ('corrupt', 'unanswered')),
    ({'board_faults.corrupt_out': 0.05, 'board_faults.corrupt_in': 0.05,
      'board_faults.drop_out': 0.05, 'board_faults.drop_in': 0.05,
      'board_faults.voltage_sag': 1.5},
     {f'board_faults.{name}': 0.0 for name in (
         'corrupt_out', 'corrupt_in', 'drop_out', 'drop_in', 'voltage_sag')}, 'rotor', 'board',
     ('bad_crc', 'board bad_crc', 'lost', 'board lost')),
    ({'board_faults.delay_in': 0.01, 'board_faults.delay_out': 0.01},
     {'board_faults.delay_in': 0.0, 'board_faults.delay_out': 0.0}, 'rotor', 'board',
     ('cycles',))]

# fault, value without fault; state of the bridge; whether it needs a reboot
LANDING = [
    ('servo_faults.overheated', [3], [], 'lost: gimbal3', True),
    ('board_faults.mute', True, False, 'silent: no message', False),
]


def test_bearable_faults_are_borne_others_land_and_killed_bridges_leave_nothing_on(
        tmp_path, ros_domain):
    """One flight for all, because its start takes longer."""
    parameters = {'sim_node': {}, 'ekf_node': {}, 'nmpc_node': {}, 'supervisor_node': PATIENT}
    for node, values in bridge_parameters(tmp_path, {}).items():
        parameters[node] = {**parameters.get(node, {}), **values}
    with running_graph(parameters, tmp_path, ros_domain, operator=FaultOperator) \
            as (graph, operator):
        operator.can_judge(graph)
        operator.start()
        for fault in BEARABLE:
            bears(operator, *fault)
        assert operator.wait(lambda: np.linalg.norm(operator.truth.velocity) < 0.1, 10)
        for fault in LANDING:
            lands(operator, *fault)
            operator.start()
        assert not graph.dead()
        graph.kill(BRIDGES_COMPOSED)
        assert operator.wait(lambda: operator.device('armed') == 'False', 10)
        assert operator.wait(lambda: 'True' not in operator.device('torque'), 10)
        assert operator.wait(
            lambda: operator.state in ('landing', 'disarmed', 'emergency_stop'), 5)


def bears(operator, switched, mended, bridge, status, counters):
    """Fly on with faults that are counted."""
    def counts():
        return np.array([operator.count(f'{bridge}_bridge_node', status, counter)
                         for counter in counters])

    before = counts()
    for name, value in switched.items():
        operator.set(name, value)
    assert operator.stays_in_the_air(1.0), switched
    assert operator.wait(lambda: np.all(counts() > before), 10), switched
    for name, value in mended.items():
        operator.set(name, value)
    assert operator.state == FLYING, (switched, operator.states)


def lands(operator, name, value, mended, text, reboot):
    """Land softly with a fault that the bridge names, and mend it."""
    states, sinking = [], []
    operator.set(name, value)
    assert operator.wait(lambda: operator.state == 'landing', 5), (name, operator.states)
    assert operator.wait(lambda: states.extend(operator.bridges.values())
                         or sinking.append(operator.truth.velocity[2])
                         or operator.state in ('disarmed', 'emergency_stop'), 30), name
    assert any(line.startswith(text) for line in states), (name, set(states))
    assert operator.state == 'disarmed' and min(sinking) > -1.0, (name, min(sinking))
    assert operator.wait(lambda: operator.device('armed') == 'False', 5), name
    operator.set(name, mended)
    if reboot:
        assert operator.ask('reboot')
