"""Test bench of the bridges: a process, an emulated device and an operator that commands."""

from contextlib import contextmanager
import threading
import time

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
from std_srvs.srv import Trigger
from witness import running_graph

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.ros import wire
from beetle_omni_ros.ros.clients import Operator
from beetle_omni_ros.ros.graph import reserved_domain

JOINT, ROTOR = 'joint_bridge_node', 'rotor_bridge_node'
WITHIN = 40     # [s] timeout of expected events on a busy machine
# Answers come from a thread of the test: wait longer for them than on a robot.
PATIENT = {JOINT: {'reply_time': 0.03}, ROTOR: {'silence': 1.0}}
QUICK = {'boot_time': 0.05, 'throttle_low_time': 0.2, 'reception_rate': 10.0}
COUNT = 2 * np.pi / 4096    # [rad]


class BridgeOperator(Operator):
    """
    Operator that commands a bridge, stands in for the supervisor, and stores messages.

    Attributes:
        tilt, thrust: what a thread commands; both None: no commands.
        period: time between two commands [s].
        age: age of their stamps [s].

    """

    def __init__(self, number, bridge):
        super().__init__(number)
        self.bridge, node = bridge, self._node
        self.bridge_states, self.batteries, self.joints = [], [], []
        self.tilt = self.thrust = None
        self.period, self.age = 0.01, 0.0
        self._supervisor = wire.Publisher(node, 'supervisor/state')
        self._commands = wire.Publisher(node, 'command')
        self._supervisor.publish('disarmed')
        wire.subscribe(node, f'{bridge.removesuffix("_node")}/state', self.bridge_states.append)
        wire.subscribe(node, 'battery_state', self.batteries.append)
        wire.subscribe(node, 'joint_states', self.joints.append)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._command, daemon=True)
        self._thread.start()

    def _command(self):
        while not self._stop.wait(self.period):
            tilt, thrust = self.tilt, self.thrust
            if tilt is not None or thrust is not None:
                self._commands.publish(Command(time.time() - self.age, *(
                    np.zeros(4) if part is None else np.array(part, float)
                    for part in (tilt, thrust))))

    def supervise(self, state):
        self._supervisor.publish(state)

    def ask(self, name, kind=Trigger, request=None):
        answer = self.request(f'{self.bridge}/{name}', kind, request or kind.Request(), WITHIN)
        assert answer, f'{name}: no answer'
        return answer

    def change(self, name):
        """Request a lifecycle transition such as 'configure'; return whether it succeeded."""
        number = getattr(Transition, f'TRANSITION_{name.upper()}')
        return self.ask('change_state', ChangeState, ChangeState.Request(
            transition=Transition(id=number))).success

    @property
    def stage(self):
        return self.ask('get_state', GetState).current_state.label

    def go_to(self, stage):
        stages, end = ['unconfigured', 'inactive', 'active'], time.monotonic() + WITHIN
        while (here := stages.index(self.stage)) != (there := stages.index(stage)):
            name = ('configure', 'activate')[here] if here < there \
                else ('cleanup', 'deactivate')[here - 1]
            # An answer may be late on a busy machine.
            assert self.change(name) or time.monotonic() < end, f'{name}: {self.now}'

    @property
    def now(self):
        return self.bridge_states[-1] if self.bridge_states else ''

    def until(self, condition, why=''):
        assert self.wait(condition, WITHIN), f'{why} {self.bridge_states[-3:]}'

    def reaches(self, state):
        self.until(lambda: self.now.startswith(state), state)

    def status(self, name):
        self.diagnostics.pop(f'{self.bridge}: {name}', None)
        self.until(lambda: f'{self.bridge}: {name}' in self.diagnostics, f'no status {name}')
        return self.diagnostics[f'{self.bridge}: {name}']

    def counts(self, name, key, above=0):
        self.until(lambda: int(self.status(name).values.get(key, 0)) > above, f'{name} {key}')

    def stands_at(self, goal):
        """Whether the newest message has these angles of all joints."""
        return bool(self.joints) and np.allclose(self.joints[-1].position, goal, atol=3 * COUNT)

    def close(self):
        self._stop.set()
        self._thread.join()
        super().close()


@contextmanager
def running_bridge(folder, bridge, others=(), **parameters):
    """Run a bridge in a separate process, or composed with others; yield graph and operator."""
    nodes = {bridge: {**PATIENT[bridge], **parameters}, **{name: {} for name in others}}
    with reserved_domain() as number, running_graph(
            nodes, folder, number, operator=lambda domain: BridgeOperator(domain, bridge),
            ready=lambda one: one.bridge_states, groups={bridge: list(nodes)}) as made:
        yield made
