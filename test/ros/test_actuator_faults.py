"""
Faults of servos and motor board that end a flight of the whole graph through both bridges.

The true state of rotors and servos is read from the simulator. test/sim and test/drivers have all
faults.
"""

import numpy as np
import pytest
from std_srvs.srv import Trigger
from witness import running_graph, Witness

from beetle_omni_ros.ros.graph import bridge_parameters, BRIDGES, BRIDGES_COMPOSED

pytestmark = pytest.mark.alone

DEVICES = 'sim_node: devices'


class FaultOperator(Witness):
    """Witness that sets faults of the simulated devices."""

    def set(self, name, value):
        accepted, reason = super().set('sim_node', name, value)
        assert accepted, reason

    def device(self, key):
        self.diagnostics.pop(DEVICES, None)
        assert self.wait(lambda: DEVICES in self.diagnostics, 5), 'sim_node is silent'
        return self.values(DEVICES)[key]

    def start(self):
        """Arm as soon as the bridges are ready, and wait until the controller flies."""
        assert self.wait(lambda: not self.waits_for(BRIDGES), 20), self.waits_for(BRIDGES)
        self.take_off()


def test_a_lost_servo_lands_and_killed_bridges_leave_no_rotor_on(tmp_path, ros_domain):
    parameters = {'sim_node': {}, 'ekf_node': {}, 'nmpc_node': {}, 'supervisor_node': {}}
    for node, values in bridge_parameters(tmp_path, {}).items():
        parameters[node] = {**parameters.get(node, {}), **values}
    with running_graph(parameters, tmp_path, ros_domain, operator=FaultOperator) \
            as (graph, operator):
        operator.can_judge(graph)
        operator.start()
        lands_without_a_servo(operator)
        assert operator.request('joint_bridge_node/reboot', Trigger, Trigger.Request(), 5).success
        operator.start()
        assert not graph.dead()
        graph.kill(BRIDGES_COMPOSED)
        assert operator.wait(lambda: operator.device('armed') == 'False', 10)
        assert operator.wait(
            lambda: operator.state in ('landing', 'disarmed', 'emergency_stop'), 5)


def lands_without_a_servo(operator):
    """Land softly with an overload that the bridge names, and end it."""
    sinking = []
    assert operator.wait(lambda: np.linalg.norm(operator.truth.velocity) < 0.1, 10)
    operator.set('servo_faults.overload', [3])
    # The supervisor may notice the silence before the bridge gives its cause.
    assert operator.wait(lambda: any(line.startswith('lost: gimbal3') for line in
                                     operator.bridges.values())
                         and operator.state == 'landing', 5), operator.bridges
    assert operator.wait(lambda: sinking.append(operator.truth.velocity[2])
                         or operator.state in ('disarmed', 'emergency_stop'), 30)
    assert operator.state == 'disarmed' and min(sinking) > -1.0, min(sinking)
    assert operator.wait(lambda: operator.device('armed') == 'False', 5)
    operator.set('servo_faults.overload', [])
