"""ROS clients outside the flight: operator, listener of `check`, live graph of `view`."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
import os
from pathlib import Path
import threading
import time

import numpy as np
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from beetle_omni_ros.bringup import findings
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.messages.bag_types import from_bytes
from beetle_omni_ros.messages.conversions import seconds as seconds_of
from beetle_omni_ros.messages.topics import (
    command_topic,
    controller_of,
    LOG,
    SENSOR,
    topic_of,
    TOPICS,
)
from beetle_omni_ros.messages.values import Diagnostic, MessageError
from beetle_omni_ros.nodes import node as nodes
from beetle_omni_ros.nodes import runner, wire
from beetle_omni_ros.nodes.graph import BRIDGES, confine, READY
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import ParameterError

# Simulated time may be slow, or stop if the simulator dies: waiting ends after this much steady
# time for each second of the timeout.
SLOWEST = 20.0
SERVICES = ('arm', 'disarm', 'land', 'emergency_stop')
SUPERVISOR = 'supervisor_node'
# Topic -> attribute of its values that changes with every sample of a working sensor.
SENSORS = {'mocap/pose': 'position', 'imu/data_raw': 'specific_force',
           'joint_states': 'position', 'battery_state': 'voltage'}
# Only the newest message of these is read for each picture; of the others, every message is read.
SHOWN = ('odom', 'ground_truth/odom', 'joint_states', 'command', 'battery_state')
EVENTS = ('supervisor/state', 'disturbance', 'diagnostics')
TARGETS = ('target_pose', 'target_trajectory')      # with any quality of service
MOST_EVENTS = 200       # of one topic that are kept until the next picture
NICENESS = 10           # of the view; the nodes of the flight have precedence


def join(name: str, domain: int | None = None, namespace: str = '',
         discovery: str | None = None):
    """
    Make a node with its own context and executor; return (node, executor).

    Raises:
        ParameterError: invalid namespace or range of discovery.

    """
    confine(requested=discovery)
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain,
               signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node(name, context=context, namespace=namespace)
    except NameValidationException as error:
        context.try_shutdown()
        raise ParameterError(f"--namespace '{namespace}': {str(error).splitlines()[0]}") from None
    executor = runner.make_executor(context)
    executor.add_node(node)
    return node, executor


def leave(node) -> None:
    """Destroy a node of :func:`join` and its context."""
    node.destroy_node()
    node.context.try_shutdown()


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
        self.controller = controller
        self._node, self._executor = join('operator', domain)
        self.state = self.progress = ''
        self.states: list[str] = []
        self.bridges: dict[str, str] = {}
        self.commands = 0
        self.diagnostics: dict[str, Diagnostic] = {}
        self._simulated: float | None = None
        node = self._node
        node.create_subscription(Clock, '/clock', self._on_clock, wire.profile(SENSOR))
        wire.subscribe(node, 'supervisor/state', self._on_state)
        wire.subscribe(node, 'reference/state', partial(setattr, self, 'progress'))
        for bridge in BRIDGES:
            wire.subscribe(node, f"{bridge.removesuffix('_node')}/state",
                           partial(self.bridges.__setitem__, bridge))
        node.create_subscription(wire.message_class(command_topic(controller).type),
                                 f'{controller}/command', self._on_command, wire.profile(SENSOR),
                                 raw=True)
        wire.subscribe(node, 'diagnostics', lambda statuses: self.diagnostics.update(
            (status.name, status) for status in statuses))
        self._diagnostics = wire.Publisher(node, 'diagnostics')
        self._clients = {name: node.create_client(Trigger, f'{SUPERVISOR}/{name}')
                         for name in SERVICES}

    def _on_clock(self, message):
        self._simulated = seconds_of(message.clock)

    def _on_state(self, text):
        state = text.partition(':')[0]
        self.state = text if state == 'flying' else state
        self.states.append(text)

    def _on_command(self, _):
        self.commands += 1

    def time(self) -> float:
        """Return simulated time if it is used, else steady time [s]."""
        return time.monotonic() if self._simulated is None else self._simulated

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
            return False, f'{SUPERVISOR} does not answer to {name}'
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
            self._node.get_clock().now().nanoseconds * 1e-9, name, nodes.OK, text,
            nodes.texts(values))])

    def close(self) -> None:
        """Leave the graph."""
        leave(self._node)


# --- beetle_omni check --------------------------------------------------------------------------

def listen(seconds: float, namespace: str = '', discovery: str | None = None
           ) -> findings.ObservedGraph:
    """
    Record the traffic of a graph for ``seconds``; publishes nothing.

    Raises:
        ParameterError: invalid namespace or range of discovery.

    """
    node, executor = join('check', namespace=namespace, discovery=discovery)
    try:
        graph = findings.ObservedGraph(node.context.get_domain_id(), seconds,
                                       {topic: findings.Stream() for topic in SENSORS})
        for topic in SENSORS:
            node.create_subscription(
                wire.message_class(TOPICS[topic].type), topic,
                partial(_observe, node, TOPICS[topic], graph.streams[topic]), wire.profile(LOG),
                raw=True)
        for bridge in findings.BRIDGES:
            wire.subscribe(node, f'{bridge}/state', partial(graph.states.__setitem__, bridge))
        wire.subscribe(node, 'diagnostics', lambda statuses: graph.diagnostics.update(
            (status.name, findings.Status(status.level, status.message, status.values))
            for status in statuses))
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left)
        for topic, stream in graph.streams.items():
            for publisher in node.get_publishers_info_by_topic(topic):
                if publisher.topic_type == TOPICS[topic].type:
                    stream.publishers.append(publisher.node_name)
                elif publisher.topic_type not in stream.other_types:
                    stream.other_types.append(publisher.topic_type)
    finally:
        leave(node)
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

class LiveGraph:
    """
    ROS side of the page; implements :class:`~beetle_omni_ros.view.live.Graph`.

    Targets and selections of a controller are sent only if ``writable``.

    Raises:
        ParameterError: invalid namespace or range of discovery.

    """

    def __init__(self, namespace: str = '', domain: int | None = None,
                 discovery: str | None = None, writable: bool = False):
        self._node, self._executor = join('view', domain, namespace, discovery)
        node = self._node
        self._lock = threading.Lock()
        self._newest: dict[str, bytes] = {}
        self._waiting: dict[str, list[bytes]] = defaultdict(list)
        for topic in SHOWN:
            self._subscribe(topic, partial(self._keep, topic), SENSOR)
        for topic in EVENTS:
            self._subscribe(topic, partial(self._queue, topic))
        for topic in TARGETS:
            wire.subscribe_any(node, topic, partial(self._queue, topic))
        self._targets = wire.Publisher(node, 'target_pose') if writable else None
        self._setting = node.create_client(SetParameters, f'{SUPERVISOR}/set_parameters') \
            if writable else None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        while not self._stopped.is_set():
            self._executor.spin_once(timeout_sec=0.2)

    def _keep(self, topic, data):
        with self._lock:
            self._newest[topic] = data

    def _subscribe(self, topic, callback, qos=None):
        entry = topic_of(topic)
        self._node.create_subscription(wire.message_class(entry.type), topic, callback,
                                       wire.profile(qos or entry.qos), raw=True)

    def _queue(self, topic, data, _=None):
        with self._lock:
            if len(self._waiting[topic]) < MOST_EVENTS:
                self._waiting[topic].append(data)

    def take(self, newest) -> None:
        """Write the messages since the last call to a view.live.Newest."""
        with self._lock:
            latest, self._newest = self._newest, {}
            waiting, self._waiting = self._waiting, defaultdict(list)
        for topic, data in (*latest.items(), *((topic, data) for topic, queue in waiting.items()
                                               for data in queue)):
            known = topic_of(topic)
            with suppress(Exception):   # broken bytes raise anything; the nodes report refusals
                newest.write(topic, known.take(from_bytes(data, known.type)))

    def controllers(self) -> list[str]:
        """Return the names of the controllers whose command topic exists."""
        prefix = self._node.get_namespace().rstrip('/') + '/'
        names = (controller_of(name.removeprefix(prefix))
                 for name, _ in self._node.get_topic_names_and_types() if name.startswith(prefix))
        return sorted(filter(None, names))

    def publish_target(self, target: PoseTarget) -> None:
        """Publish a target, latched, on target_pose."""
        if self._targets is not None:
            self._targets.publish(target)

    def select(self, controller: str, answer) -> None:
        """Set the supervisor's parameter ``controller``."""
        if self._setting is None or not self._setting.service_is_ready():
            answer(f'{SUPERVISOR} is not there')
            return

        def done(future):
            result = future.result().results[0]
            answer('' if result.successful else result.reason or 'no reason given')
        request = wire.parameter_request('controller', controller)
        self._setting.call_async(request).add_done_callback(done)

    def close(self) -> None:
        """Leave the graph."""
        self._stopped.set()
        self._thread.join(2.0)
        leave(self._node)


def run_live(*, namespace: str = '', domain_id: int | None = None, discovery: str | None = None,
             robot: Path | None = None, host: str, port: int, dark: bool = False,
             allow_targets: bool = False, console: Console | None = None) -> None:
    """
    Show a running graph until Ctrl-C; arguments are the options of `beetle_omni view`.

    Raises:
        ParameterError: unusable input.

    """
    from beetle_omni_ros.view.live import Live
    from beetle_omni_ros.view.recorded import announce
    from beetle_omni_ros.view.scene import close, serve
    runner.end_with_parent()
    parameters = RobotParameters.load(robot)
    with ExitStack() as stack:
        graph = LiveGraph(namespace, domain_id, discovery, allow_targets)
        stack.callback(graph.close)
        os.nice(NICENESS)
        server = serve(host, port, dark)
        stack.callback(close, server)
        announce(host, server.get_port(), console or Console())
        with suppress(KeyboardInterrupt):       # the regular end
            Live(server, graph, parameters, allow_targets).run()
