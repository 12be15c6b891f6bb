"""ROS clients: the operator of a graph, and listeners, `check` and the live graph of `view`."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
import math
import os
import time
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from beetle_omni_ros.bags.conversions import seconds as seconds_of
from beetle_omni_ros.bags.messages import Diagnostic, MessageError
from beetle_omni_ros.bags.topics import ALL, LOG, Qos, SENSOR, TARGETS
from beetle_omni_ros.control import registry
from beetle_omni_ros.drivers import check
from beetle_omni_ros.model.mode import DISARMED, Mode
from beetle_omni_ros.model.schema import ParameterError, RunError
from beetle_omni_ros.ros import runner, wire
from beetle_omni_ros.ros.graph import BRIDGES, confine, domains_in_use, READY


class Client:
    """
    A node with its own context; it receives messages only while it spins.

    Raises:
        ParameterError: invalid namespace.

    """

    def __init__(self, name: str, domain: int | None = None, namespace: str = ''):
        confine()
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=domain,
                   signal_handler_options=SignalHandlerOptions.NO)
        try:
            self._node = rclpy.create_node(name, context=context, namespace=namespace)
        except NameValidationException as error:
            context.try_shutdown()
            raise ParameterError(f"--namespace '{namespace}': "
                                 f'{str(error).splitlines()[0]}') from None
        self.domain: int = context.get_domain_id()
        self._executor = EventsExecutor(context=context)
        self._executor.add_node(self._node)

    def spin(self, seconds: float) -> None:
        """Process messages for ``seconds`` of steady time."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        self._node.context.try_shutdown()


# --- operator ------------------------------------------------------------------------------------

# Simulated time may be slow, or stop if the simulator dies: waiting ends after this much steady
# time for each second of the timeout.
SLOWEST = 20.0
ARM_TIMEOUT = 10.0      # s
PAUSE_TIMEOUT = 10.0    # s
PAUSE_SETTLE = 0.05     # s until the nodes have answered the last sample before a pause
TAKEOFF_TIMEOUT = 30.0  # s
TAKEOFF_ATTEMPTS = 3
SETTLE_TIME = 1.0       # s before arming, in which start-up work ends
NEVER = 1e9             # s, time at which simulated time does not stand still
SERVICES = ('arm', 'disarm', 'land', 'emergency_stop')
SUPERVISOR = 'supervisor_node'


class Operator(Client):
    """
    Calls services and watches states; with simulated time, seconds are those of /clock.

    Attributes:
        state, states: newest state of the supervisor, '' before the first message; all of them.
        progress: state of reference_node, '' before the first message.
        bridges: bridge node -> its newest state.
        controller: name of the watched controller.
        diagnostics: status name -> newest :class:`Diagnostic`.
        required: bridges whose states belong to the text of an error.
        show: called with what the operator waits for.

    """

    required: Sequence[str] = ()
    show: Callable[[str], None] = staticmethod(lambda text: None)

    def __init__(self, domain: int | None, controller: str = registry.DEFAULT):
        super().__init__('operator', domain)
        self.controller = controller
        self.state, self.progress = Mode(), ''
        self.states: list[Mode] = []
        self.bridges: dict[str, str] = {}
        self.diagnostics: dict[str, Diagnostic] = {}
        self._offset: float | None = None   # s from /clock to time(), which goes on steadily
        self._clock = self._epoch = 0.0
        node = self._node
        node.create_subscription(Clock, '/clock', self._on_clock, wire.profile(SENSOR))
        wire.subscribe(node, 'supervisor/state', self._on_state)
        wire.subscribe(node, 'reference/state', partial(setattr, self, 'progress'))
        for bridge in BRIDGES:
            wire.subscribe(node, f"{bridge.removesuffix('_node')}/state",
                           partial(self.bridges.__setitem__, bridge))
        wire.subscribe(node, 'diagnostics', lambda statuses: self.diagnostics.update(
            (status.name, status) for status in statuses))
        self._clients = {name: node.create_client(Trigger, f'{SUPERVISOR}/{name}')
                         for name in SERVICES}

    def _on_clock(self, message):
        self._clock = seconds_of(message.clock)
        if self._offset is None:
            self._offset = time.monotonic() - self._clock
            self._epoch = math.floor(self._clock)

    def _on_state(self, mode):
        self.state = Mode(mode if mode.controller else mode.state)
        self.states.append(mode)

    def time(self) -> float:
        """Return a time that passes like that of the flight, simulated or steady [s]."""
        return time.monotonic() if self._offset is None else self._clock + self._offset

    @property
    def answers(self) -> bool:
        """Whether the supervisor can be called."""
        return self._clients['arm'].service_is_ready()

    @property
    def ready(self) -> bool:
        """Whether the supervisor can be called and the controller runs."""
        return f'{self.controller}_node: controller' in self.diagnostics and self.answers

    def waits_for(self, bridges: Sequence[str]) -> str:
        """Return the states of the bridges that are not ready, '' if all are."""
        states = {name: self.bridges.get(name, 'silent') for name in bridges}
        return '; '.join(f'{name} {text}' for name, text in states.items()
                         if not text.startswith(READY))

    def wait(self, condition, timeout: float) -> bool:
        """Process messages until ``condition()`` holds; False after ``timeout`` [s]."""
        start, steady = self.time(), time.monotonic()
        while self.time() < start + timeout \
                and time.monotonic() - steady < SLOWEST * timeout + 1.0:
            if condition():
                return True
            self.spin(0.05)
        return bool(condition())

    def expect(self, text: str, condition, timeout: float, why=lambda: '') -> None:
        """Wait as :meth:`wait`; a timeout raises RunError with ``text`` and ``why()``."""
        self.show(text)
        if not self.wait(condition, timeout):
            waits = self.waits_for(self.required)
            raise RunError(f'{text}: nothing after {timeout:g} s, supervisor in '
                           f"'{self.state}'{why()}" + (waits and f'; {waits}'))

    def take_off(self) -> None:
        """Arm and take off, or raise RunError; repeat if the supervisor disarms on the ground."""
        answers = []
        for _ in range(TAKEOFF_ATTEMPTS):
            self.spin(SETTLE_TIME)
            self.expect('arming', lambda: answers.append(self.arm()) or answers[-1][0],
                        ARM_TIMEOUT, lambda: f'; supervisor_node: {answers[-1][1]}')
            self.states.clear()
            # The state may name a fault: disarmed:joint1_astray.
            self.expect('taking off', lambda: self.state.controller or any(
                mode.state == DISARMED for mode in self.states), TAKEOFF_TIMEOUT)
            if self.state.controller:
                return
        raise RunError(f'no take-off in {TAKEOFF_ATTEMPTS} attempts; see the warnings below')

    def arm(self) -> tuple[bool, str]:
        """Ask the supervisor to arm; return (accepted, answer)."""
        return self.call('arm')

    def pause_at(self, moment: float) -> None:
        """
        Let simulated time run to ``moment`` since its start [s], and stand still there.

        NEVER ends the pause. What is done meanwhile has its effect at that moment.
        """
        accepted, answer = self.set('sim_node', 'pause_at', float(moment))
        if not accepted:
            raise RunError(f'sim_node: {answer}')
        if moment < NEVER:
            self.expect(f'simulated time {moment:g} s',
                        lambda: self._clock - self._epoch > moment - 1e-3, moment + PAUSE_TIMEOUT)
            self.spin(PAUSE_SETTLE)

    def call(self, name: str, timeout: float = 2.0) -> tuple[bool, str]:
        """Call a service of the supervisor; return (accepted, answer)."""
        future = self._clients[name].call_async(Trigger.Request())
        if not self.wait(future.done, timeout):
            return False, f'{SUPERVISOR} does not answer to {name}'
        return future.result().success, future.result().message

    def request(self, service: str, kind: type, request: Any, timeout: float) -> Any:
        """Call any service; return its response, None without an answer."""
        client = self._node.create_client(kind, service)
        if not self.wait(client.service_is_ready, timeout):
            return None
        future = client.call_async(request)
        return future.result() if self.wait(future.done, timeout) else None

    def set(self, node: str, name: str, value) -> tuple[bool, str]:
        """Set a parameter of a node; return (accepted, answer)."""
        answer = self.request(f'{node}/set_parameters', SetParameters,
                              wire.parameter_request(name, value), 5.0)
        if answer is None:
            return False, f'{node} does not answer'
        return answer.results[0].successful, answer.results[0].reason

    def values(self, status: str) -> dict[str, str]:
        """Return the values of a diagnostic status, empty before the first message."""
        found = self.diagnostics.get(status)
        return found.values if found else {}


# --- beetle_omni check --------------------------------------------------------------------------

# Topic -> attribute of its values that changes with every sample of a working sensor.
SENSORS = {'mocap/pose': 'position', 'imu/data_raw': 'specific_force',
           'joint_states': 'position', 'battery_state': 'voltage'}


def listen(seconds: float, namespace: str = '') -> check.ObservedGraph:
    """Record the traffic of a graph for ``seconds``; publishes nothing."""
    client = Client('check', namespace=namespace)
    node = client._node
    try:
        graph = check.ObservedGraph(client.domain, seconds,
                                       {topic: check.Stream() for topic in SENSORS})
        for topic in SENSORS:
            wire.subscribe_raw(node, topic, partial(
                _observe, node, ALL[topic], graph.streams[topic]), LOG)
        for bridge in check.BRIDGES:
            wire.subscribe(node, f'{bridge}/state', partial(graph.states.__setitem__, bridge))
        wire.subscribe(node, 'diagnostics', lambda statuses: graph.diagnostics.update(
            (status.name, status) for status in statuses))
        client.spin(seconds)
        for topic, stream in graph.streams.items():
            for publisher in node.get_publishers_info_by_topic(topic):
                if publisher.topic_type == ALL[topic].type:
                    stream.publishers.append(publisher.node_name)
                elif publisher.topic_type not in stream.other_types:
                    stream.other_types.append(publisher.topic_type)
    finally:
        client.close()
    return graph


def _observe(node, topic, stream, data):
    now = node.get_clock().now().nanoseconds * 1e-9
    try:
        message = wire.message(topic, data)
        stream.arrivals.append(time.monotonic())
        stream.ages.append(now - seconds_of(message.header.stamp))
        norm = float(np.linalg.norm(getattr(topic.take(message), SENSORS[topic.name])))
        if np.isnan(norm):
            raise MessageError('not all joints are named')
        stream.norms.append(norm)
    except MessageError as error:
        stream.refused[str(error)] += 1


# --- beetle_omni view ---------------------------------------------------------------------------

# Only the newest message of these is read for each picture; of the others, every message is read.
SHOWN = ('odom', 'ground_truth/odom', 'joint_states', 'command', 'battery_state')
EVENTS = ('supervisor/state', 'reference/state', 'disturbance', 'diagnostics')
NEWEST = Qos(1, reliable=False)
SPIN = 0.01             # s of a picture's 33 ms in which messages are received
NICENESS = 10           # of the view; the nodes of the flight have precedence


class LiveGraph(Client):
    """ROS side of the page, which publishes nothing."""

    def __init__(self, namespace: str = '', domain: int | None = None):
        super().__init__('view', domain, namespace)
        self._newest = None
        for topic in (*SHOWN, *EVENTS, *TARGETS):
            wire.subscribe(
                self._node, topic, lambda value, topic=topic: self._newest.write(topic, value),
                NEWEST if topic in SHOWN else None)

    def take(self, newest) -> None:
        """Write the messages since the last call to a view.live.Newest."""
        self._newest = newest
        self.spin(SPIN)

    def waits(self) -> str:
        """Return what is missing before the first pose, and where there is a flight."""
        others = ', '.join(f'--domain-id {n}' for n in domains_in_use() if n != self.domain)
        return f'waiting for odom or ground_truth/odom in ROS domain {self.domain}' + (
            others and f'; flights on this computer: {others}')


def run_live(*, namespace: str = '', domain_id: int | None = None,
             host: str, port: int) -> None:
    """Show a running graph until Ctrl-C, by default that of the only domain in use."""
    from beetle_omni_ros.show.recorded import announce, draw
    from beetle_omni_ros.show.scene import close, serve
    runner.end_with_parent()
    if domain_id is None and not os.environ.get('ROS_DOMAIN_ID') and len(domains_in_use()) == 1:
        domain_id, = domains_in_use()
    with ExitStack() as stack:
        graph = LiveGraph(namespace, domain_id)
        stack.callback(graph.close)
        os.nice(NICENESS)
        server = serve(host, port, f'ROS domain {graph.domain}')
        stack.callback(close, server)
        announce(host, server.get_port())
        if graph.domain not in domains_in_use():
            print(graph.waits(), flush=True)
        with suppress(KeyboardInterrupt):       # the regular end
            draw(server, graph)
