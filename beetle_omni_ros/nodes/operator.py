"""ROS client of an operator: services, parameters, states and diagnostics of a flight."""

from collections.abc import Iterator, Sequence
import time

from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from beetle_omni_ros.control import registry
from beetle_omni_ros.messages.conversions import seconds
from beetle_omni_ros.messages.topics import command_topic, SENSOR
from beetle_omni_ros.messages.values import Diagnostic
from beetle_omni_ros.nodes import health, runner, wire
from beetle_omni_ros.nodes.discovery import confine
from beetle_omni_ros.nodes.plan import READY, STATES

# Simulated time may be slow, or stop if the simulator dies: waiting ends after this much steady
# time for each second of the timeout.
SLOWEST = 20.0
SERVICES = ('arm', 'disarm', 'land', 'emergency_stop')


class Operator:
    """
    A node with its own context; it receives messages only during calls of its methods.

    With simulated time, seconds are those of /clock.

    Attributes:
        controller: name of the watched controller.
        state: state of the supervisor, '' before the first message.
        progress: state of reference_node, '' before the first message.
        bridges: bridge node -> its newest state.
        commands: number of commands of the watched controller.
        diagnostics: status name -> newest :class:`Diagnostic`.

    """

    def __init__(self, domain: int, controller: str = registry.DEFAULT):
        """Join ``domain`` and count the commands of ``controller``."""
        confine()
        self.controller = controller
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, domain_id=domain,
                   signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('operator', context=self._context)
        self._executor = runner.make_executor(self._context)
        self._executor.add_node(self._node)
        self.state = self.progress = ''
        self.states: list[str] = []
        self.bridges: dict[str, str] = {}
        self.commands = 0
        self.diagnostics: dict[str, Diagnostic] = {}
        self._simulated: float | None = None
        node = self._node
        node.create_subscription(Clock, '/clock', self._on_clock, wire.profile(SENSOR))
        wire.subscribe(node, 'supervisor/state', self._on_state)
        wire.subscribe(node, 'reference/state', self._on_progress)
        for bridge, topic in STATES.items():
            wire.subscribe(node, topic, self._on_bridge(bridge))
        node.create_subscription(wire.message_class(command_topic(controller).type),
                                 f'{controller}/command', self._on_command, wire.profile(SENSOR),
                                 raw=True)
        wire.subscribe(node, 'diagnostics', self._on_diagnostics)
        self._diagnostics = wire.Publisher(node, 'diagnostics')
        self._clients = {name: node.create_client(Trigger, f'supervisor_node/{name}')
                         for name in SERVICES}

    def _on_clock(self, message):
        self._simulated = seconds(message.clock)

    def time(self) -> float:
        """Return simulated time if it is used, else steady time [s]."""
        return time.monotonic() if self._simulated is None else self._simulated

    def _on_state(self, text):
        state = text.partition(':')[0]
        self.state = text if state == 'flying' else state
        self.states.append(text)

    def _on_progress(self, progress):
        self.progress = progress

    def _on_bridge(self, name):
        def handle(state):
            self.bridges[name] = state
        return handle

    def _on_command(self, _):
        self.commands += 1

    def _on_diagnostics(self, statuses):
        self.diagnostics.update((status.name, status) for status in statuses)

    @property
    def answers(self) -> bool:
        """Whether the supervisor can be called."""
        return self._clients['arm'].service_is_ready()

    @property
    def ready(self) -> bool:
        """Whether the supervisor can be called and the controller commands."""
        return self.commands > 0 and self.answers

    def waits_for(self, bridges: Sequence[str]) -> str:
        """Return the states of the bridges that are not ready, '' if all are."""
        states = {name: self.bridges.get(name, 'silent') for name in bridges}
        return '; '.join(f'{name} {text}' for name, text in states.items()
                         if not text.startswith(READY))

    def spin(self, seconds: float) -> None:
        """Process messages for ``seconds``."""
        for left in self.countdown(seconds):
            self._executor.spin_once(timeout_sec=min(left, 0.1))

    def countdown(self, seconds: float) -> Iterator[float]:
        """Yield the remaining time [s], steady or simulated, until it is over."""
        simulated, start = self._simulated is not None, self.time()
        steady = time.monotonic()
        while True:
            if simulated != (self._simulated is not None):      # the clock has just appeared
                simulated, start, steady = True, self.time(), time.monotonic()
            left = start + seconds - self.time()
            if left <= 0 or time.monotonic() - steady > SLOWEST * seconds + 1.0:
                return
            yield left

    def wait(self, condition, timeout: float) -> bool:
        """Process messages until ``condition()`` holds; False after ``timeout`` [s]."""
        left = self.countdown(timeout)
        while not condition():
            if next(left, None) is None:
                return False
            self.spin(0.05)
        return True

    def call(self, name: str, timeout: float = 2.0) -> tuple[bool, str]:
        """Call a service of the supervisor; return (accepted, answer)."""
        future = self._clients[name].call_async(Trigger.Request())
        if not self.wait(future.done, timeout):
            return False, f'supervisor_node does not answer to {name}'
        return future.result().success, future.result().message

    def set(self, node: str, name: str, value, timeout: float = 5.0) -> tuple[bool, str]:
        """Set a parameter of a node; return (accepted, answer)."""
        client = self._node.create_client(SetParameters, f'{node}/set_parameters')
        if not self.wait(client.service_is_ready, timeout):
            return False, f'{node} is not there'
        future = client.call_async(wire.parameter_request(name, value))
        if not self.wait(future.done, timeout):
            return False, f'{node} does not answer'
        return future.result().results[0].successful, future.result().results[0].reason

    def values(self, status: str) -> dict[str, str]:
        """Return the values of a diagnostic status, empty before the first message."""
        found = self.diagnostics.get(status)
        return found.values if found else {}

    def report(self, name: str, text: str, values: dict) -> None:
        """Publish a status on ``diagnostics``, from where it gets into the bag."""
        self._diagnostics.publish([Diagnostic(
            self._node.get_clock().now().nanoseconds * 1e-9, name, health.OK, text,
            health.texts(values))])

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        self._context.try_shutdown()
