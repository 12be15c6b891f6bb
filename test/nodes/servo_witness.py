"""Test bench of joint_bridge_node: its process, emulated servos and an operator."""

from contextlib import contextmanager
import time

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.messages.topics import SENSOR
from beetle_omni_ros.nodes import discovery, wire
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.robot.parameters import JOINT_NAMES

NODE = 'joint_bridge_node'
WITHIN = 20     # [s] timeout of expected events on a busy machine
# Answers come from a thread of the test: wait longer for them than on a robot.
PATIENT = {'timing': {'reply': 0.03, 'probe_first': 0.02, 'probe_longest': 0.1, 'health': 0.04,
                      'reconnect': 0.02}}
COUNT = 2 * np.pi / 4096    # [rad]
TRANSITIONS = {'configure': Transition.TRANSITION_CONFIGURE,
               'activate': Transition.TRANSITION_ACTIVATE,
               'deactivate': Transition.TRANSITION_DEACTIVATE,
               'cleanup': Transition.TRANSITION_CLEANUP}


class ServoWitness(Operator):
    """Operator that commands tilts and observes the joint bridge."""

    def __init__(self, number):
        super().__init__(number)
        node = self._node
        self.bridge_states, self.joints, self.arrivals = [], [], []
        self.goal, self.age = None, 0.0
        wire.subscribe(node, 'joint_bridge/state', self.bridge_states.append)
        node.create_subscription(JointState, 'joint_states', self._on_joints, wire.profile(SENSOR))
        self._command = wire.Publisher(node, 'command')
        self._clients = {}
        self.parameters = AsyncParameterClient(node, NODE)
        node.create_timer(0.01, self._publish)

    def _on_joints(self, message):
        self.joints.append(message)
        self.arrivals.append(time.time())

    def _publish(self):
        if self.goal is not None:
            self._command.publish(Command(
                time.time() - self.age, np.asarray(self.goal, float), np.zeros(4)))

    @property
    def now(self):
        """Newest state of the bridge."""
        return self.bridge_states[-1] if self.bridge_states else ''

    def ask(self, kind, name, request):
        """Call a service of the node; return its response."""
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, f'{NODE}/{name}')
        client = self._clients[name]
        assert self.wait(client.service_is_ready, WITHIN), f'no service {name}'
        future = client.call_async(request)
        assert self.wait(future.done, WITHIN), f'{name}: no answer'
        return future.result()

    def change(self, name):
        """Request a lifecycle transition; return whether it succeeded."""
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[name]
        return self.ask(ChangeState, 'change_state', request).success

    @property
    def stage(self):
        """Lifecycle state of the node."""
        return self.ask(GetState, 'get_state', GetState.Request()).current_state.label

    def trigger(self, name):
        """Call a Trigger service; return (accepted, answer)."""
        response = self.ask(Trigger, name, Trigger.Request())
        return response.success, response.message

    def set(self, **values):
        """Set parameters of the node."""
        future = self.parameters.set_parameters(
            [Parameter(name, value=value) for name, value in values.items()])
        assert self.wait(future.done, WITHIN)
        assert all(one.successful for one in future.result().results)

    def until(self, condition, why=''):
        """Wait until a condition holds."""
        assert self.wait(condition, WITHIN), f'{why} {self.bridge_states[-3:]}'

    def go_to(self, stage):
        """Bring the node to a lifecycle state from any other."""
        path = {'unconfigured': 0, 'inactive': 1, 'active': 2}
        end = time.monotonic() + WITHIN
        while (here := path[self.stage]) != path[stage]:
            name = ('configure', 'activate')[here] if here < path[stage] \
                else ('cleanup', 'deactivate')[here - 1]
            # An answer may be late on a busy machine.
            assert self.change(name) or time.monotonic() < end, f'{name}: {self.now}'

    def numbers(self, name):
        """Values of the next message of a status."""
        self.diagnostics.pop(f'{NODE}: {name}', None)
        self.until(lambda: f'{NODE}: {name}' in self.diagnostics, f'no status {name}')
        return self.diagnostics[f'{NODE}: {name}'].values

    def level(self, name):
        """Level and text of the next message of a status."""
        self.numbers(name)
        status = self.diagnostics[f'{NODE}: {name}']
        return status.level, status.message

    def angles(self):
        """Newest angles (4,), or None if the newest message is incomplete."""
        if not self.joints or list(self.joints[-1].name) != list(JOINT_NAMES):
            return None
        return np.array(self.joints[-1].position)

    def stands_at(self, goal):
        """Whether the newest angles are the goal."""
        angles = self.angles()
        return angles is not None and np.allclose(angles, goal, atol=3 * COUNT)


@contextmanager
def joint_bridge(folder, others=(), **parameters):
    """Run the node in a separate process, or composed with others; yield graph and witness."""
    with discovery.reserved_domain() as number:
        graph = Graph({NODE: {**PATIENT, **parameters}, **{name: {} for name in others}}, folder,
                      number, composed=bool(others))
        witness = None
        try:
            graph.start()
            witness = ServoWitness(number)
            witness.until(lambda: witness.bridge_states, 'no state')
            yield graph, witness
        finally:
            stubborn = graph.stop()
            if witness:
                witness.close()
        assert not stubborn
