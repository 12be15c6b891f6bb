"""
A fault of a servo that ends a flight of the whole graph through both bridges.

The true state of rotors and servos is read from the simulator. test/sim and test/drivers have all
faults, test_joint_bridge and test_rotor_bridge the ends of the bridges.
"""

import numpy as np
import pytest
from std_srvs.srv import Trigger
from witness import running_graph, Witness

from beetle_omni_ros.ros.graph import bridge_parameters, BRIDGES

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


def test_the_robot_lands_without_a_servo_which_restarts_by_the_service(tmp_path, ros_domain):
    parameters = {'sim_node': {}, 'ekf_node': {}, 'nmpc_node': {}, 'supervisor_node': {}}
    for node, values in bridge_parameters(tmp_path, {}).items():
        parameters[node] = {**parameters.get(node, {}), **values}
    with running_graph(parameters, tmp_path, ros_domain, operator=FaultOperator) \
            as (graph, operator):
        operator.can_judge(graph)
        assert operator.wait(lambda: not operator.waits_for(BRIDGES), 20)
        operator.take_off()
        lands_without_a_servo(operator)
        assert operator.request('joint_bridge_node/reboot', Trigger, Trigger.Request(), 5).success
        assert operator.wait(lambda: not operator.waits_for(BRIDGES), 20)
        assert not graph.dead()


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
