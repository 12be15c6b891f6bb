"""Test bench of rotor_bridge_node: its process, an emulated board and a commanding node."""

from contextlib import contextmanager
from dataclasses import replace
import threading
import time

from lifecycle_msgs.srv import ChangeState
import numpy as np
from sensor_msgs.msg import BatteryState, JointState

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.messages.topics import SENSOR
from beetle_omni_ros.nodes import discovery, wire
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.nodes.operator import Operator
from beetle_omni_ros.sim.emulated.board_parameters import EmulatedBoardParameters
from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard

NODE = 'rotor_bridge_node'
QUICK = replace(EmulatedBoardParameters.load(), boot_time=0.05, throttle_low_time=0.2,
                reception_rate=10.0)
HOVER = np.array([7.0, 7.5, 8.0, 8.5])
START, SOON = 60, 10    # s; a busy test machine must not cause a fault


class Commander(Operator):
    """
    Stand-in for the supervisor, which stores the messages of the bridge.

    Attributes:
        thrust: thrusts that a thread commands; None: no commands.
        period: time between two commands [s].
        age: age of their stamps [s].
        stamps: stamps of the sent commands.

    """

    def __init__(self, number):
        super().__init__(number)
        node = self._node
        self.bridge_states, self.batteries, self.rotors = [], [], []
        self.thrust, self.period, self.age, self.stamps = None, 0.01, 0.0, []
        self.supervised = ''
        self._supervisor = wire.Publisher(node, 'supervisor/state')
        self._commands = wire.Publisher(node, 'command')
        wire.subscribe(node, 'rotor_bridge/state', self.bridge_states.append)
        node.create_subscription(BatteryState, 'battery_state', self.batteries.append,
                                 wire.profile(SENSOR))
        node.create_subscription(JointState, 'rotor_states', self.rotors.append,
                                 wire.profile(SENSOR))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._command, daemon=True)
        self._thread.start()

    def _command(self):
        while not self._stop.wait(self.period):
            thrust = self.thrust
            if thrust is not None:
                stamp = time.time() - self.age
                self._commands.publish(Command(stamp, np.zeros(4), thrust))
                self.stamps.append(stamp)

    def supervise(self, state):
        """Publish a state of the supervisor."""
        self.supervised = state
        self._supervisor.publish(state)

    def change(self, transition, timeout=SOON):
        """Request a lifecycle transition; return whether it succeeded."""
        client = self._node.create_client(ChangeState, f'{NODE}/change_state')
        try:
            assert self.wait(client.service_is_ready, timeout)
            future = client.call_async(ChangeState.Request(transition=transition))
            assert self.wait(future.done, timeout)
            return future.result().success
        finally:
            self._node.destroy_client(client)

    @property
    def bridge(self):
        """Newest state of the bridge."""
        return self.bridge_states[-1] if self.bridge_states else ''

    def reaches(self, state, timeout=SOON):
        """Wait for a state of the bridge."""
        return self.wait(lambda: self.bridge.startswith(state), timeout)

    def wait_for_diagnostics(self, status, key, condition, timeout=SOON):
        """Wait until a value of the bridge's diagnostics meets a condition."""
        return self.wait(lambda: condition(self.values(f'{NODE}: {status}').get(key, '')),
                         timeout)

    def close(self):
        """Stop publishing."""
        self._stop.set()
        self._thread.join()
        super().close()


class Bench:
    """One board, one bridge, one commanding node."""

    def __init__(self, board, graph, commander):
        self.board, self.graph, self.commander = board, graph, commander

    def take_off(self):
        """Take off and wait until the rotors turn as commanded."""
        commander, board = self.commander, self.board
        assert commander.reaches('ready'), (commander.bridge_states, self.log)
        commander.supervise('takeoff')
        assert commander.wait(lambda: board.armed, SOON), (commander.bridge_states, self.log)
        commander.thrust = HOVER
        assert commander.wait(lambda: self.follows(), SOON), (commander.bridge_states, self.log)

    def follows(self, thrust=HOVER):
        """Whether the rotors' targets are these thrusts within 0.1 %."""
        return np.allclose(self.board.thrust_targets, thrust, rtol=1e-3, atol=0)

    def rest(self):
        """Restore the disarmed state without faults."""
        board, commander = self.board, self.commander
        board.faults = type(board.faults)()
        board.on_target = None
        board.plug()
        board.set_battery(25.2, 0.0)
        commander.thrust, commander.period, commander.age = None, 0.01, 0.0
        flew, count = commander.supervised != 'disarmed', len(commander.bridge_states)
        commander.supervise('disarmed')
        # The 'ready' of the flight is not yet that of the ground.
        return commander.wait(lambda: not flew or len(commander.bridge_states) > count, SOON) \
            and commander.reaches('ready') and not board.armed

    @property
    def log(self):
        """Output and exit status of the bridge."""
        return self.graph.log(NODE).read_text(), self.graph.dead()


@contextmanager
def bench(folder, **parameters):
    """Start a bridge; without a parameter ``port``, on an emulated board."""
    with discovery.reserved_domain() as number, EmulatedMotorBoard(parameters=QUICK) as board:
        patient = {'port': board.port, 'reconnect_period': 0.1, 'silence': 1.0}
        graph = Graph({NODE: {**patient, **parameters}}, folder, number, composed=False)
        commander = None
        try:
            graph.start()
            commander = Commander(number)
            commander.supervise('disarmed')
            yield Bench(board, graph, commander)
        finally:
            graph.stop()
            if commander:
                commander.close()
