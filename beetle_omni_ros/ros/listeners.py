"""ROS clients that listen: the base of all clients, `check`, the live graph of `view`."""

from contextlib import ExitStack, suppress
from functools import partial
import os
import time

import numpy as np
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions

from beetle_omni_ros.bags.conversions import seconds as seconds_of
from beetle_omni_ros.bags.messages import MessageError
from beetle_omni_ros.bags.topics import ALL, LOG, Qos, TARGETS
from beetle_omni_ros.drivers import check
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.ros import runner, wire
from beetle_omni_ros.ros.graph import confine, domains_in_use

# Topic -> attribute of its values that changes with every sample of a working sensor.
SENSORS = {'mocap/pose': 'position', 'imu/data_raw': 'specific_force',
           'joint_states': 'position', 'battery_state': 'voltage'}
# Only the newest message of these is read for each picture; of the others, every message is read.
SHOWN = ('odom', 'ground_truth/odom', 'joint_states', 'command', 'battery_state')
EVENTS = ('supervisor/state', 'reference/state', 'disturbance', 'diagnostics')
NEWEST = Qos(1, reliable=False)
SPIN = 0.01             # s of a picture's 33 ms in which messages are received
NICENESS = 10           # of the view; the nodes of the flight have precedence


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

    def spin_steadily(self, seconds: float) -> None:
        """Process messages for ``seconds`` of steady time."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        self._node.context.try_shutdown()


# --- beetle_omni check --------------------------------------------------------------------------

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
        client.spin_steadily(seconds)
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
        self.spin_steadily(SPIN)

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
