"""`beetle_omni view` without RUN: shows a running graph and sends the operator's targets to it."""

from collections import defaultdict
from contextlib import ExitStack, suppress
from functools import partial
import os
from pathlib import Path
import threading

from rcl_interfaces.srv import SetParameters
from rclpy.clock import Clock, ClockType
from rich.console import Console

from beetle_omni_ros.control.base import PoseTarget
from beetle_omni_ros.messages.bag_types import from_bytes
from beetle_omni_ros.messages.topics import controller_of, SENSOR, topic_of
from beetle_omni_ros.nodes import runner, wire
from beetle_omni_ros.nodes.operator import join, leave
from beetle_omni_ros.nodes.wire import AnyQosSubscription
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.urdf import Model
from beetle_omni_ros.view.live import Live, Newest
from beetle_omni_ros.view.recorded import announce
from beetle_omni_ros.view.scene import close, serve

# Only the newest message of these is read for each picture. Of EVENTS and TARGETS, every message
# is read.
STREAMS = ('odom', 'ground_truth/odom', 'joint_states', 'command', 'battery_state')
EVENTS = ('supervisor/state', 'disturbance', 'diagnostics')
TARGETS = ('target_pose', 'target_trajectory')      # with any quality of service
MOST_EVENTS = 200       # of one topic that are kept until the next picture
NICENESS = 10           # the nodes of the flight have precedence
SUPERVISOR = 'supervisor_node'


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
        node.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        for topic in STREAMS:
            self._subscribe(topic, partial(self._keep, topic), SENSOR)
        for topic in EVENTS:
            self._subscribe(topic, partial(self._queue, topic))
        for topic in TARGETS:
            AnyQosSubscription(node, wire.message_class(topic_of(topic).type), topic,
                       partial(self._queue, topic), raw=True)
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

    def take(self, newest: Newest) -> None:
        """Pass on the messages since the last call, without the unreadable ones."""
        with self._lock:
            latest, self._newest = self._newest, {}
            waiting, self._waiting = self._waiting, defaultdict(list)
        for topic, data in (*latest.items(), *((topic, data) for topic, queue in waiting.items()
                                               for data in queue)):
            try:
                known = topic_of(topic)
                newest.write(topic, known.take(from_bytes(data, known.type)))
            except Exception:   # broken bytes raise anything; the nodes report what they refuse
                continue

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
             robot: Path | None = None, urdf: Path | None = None, host: str, port: int,
             dark: bool = False, allow_targets: bool = False,
             console: Console | None = None) -> None:
    """
    Show a running graph until Ctrl-C; arguments are the options of `beetle_omni view`.

    Raises:
        ParameterError: unusable input.

    """
    runner.end_with_parent()
    model, parameters = Model.load(urdf), RobotParameters.load(robot)
    with ExitStack() as stack:
        graph = LiveGraph(namespace, domain_id, discovery, allow_targets)
        stack.callback(graph.close)
        os.nice(NICENESS)
        server = serve(host, port, dark)
        stack.callback(close, server)
        announce(host, server.get_port(), console or Console())
        with suppress(KeyboardInterrupt):       # the regular end
            Live(server, graph, model, parameters, allow_targets).run()
