"""Records the traffic of a graph for some seconds, for `beetle_omni check`; publishes nothing."""

from functools import partial
import time

import numpy as np
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.signals import SignalHandlerOptions

from beetle_omni_ros.bringup.graph import BRIDGES, ObservedGraph, Status, Stream
from beetle_omni_ros.messages.conversions import seconds as seconds_of
from beetle_omni_ros.messages.topics import LOG, TOPICS
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.nodes import runner, wire
from beetle_omni_ros.nodes.discovery import confine
from beetle_omni_ros.robot.schema import ParameterError

# Topic -> attribute of its values that changes with every sample of a working sensor.
STREAMS = {'mocap/pose': 'position', 'imu/data_raw': 'specific_force',
           'joint_states': 'position', 'battery_state': 'voltage'}


def listen(seconds: float, namespace: str = '', discovery: str | None = None) -> ObservedGraph:
    """
    Join the graph and record its messages for ``seconds``.

    Raises:
        ParameterError: invalid namespace or range of discovery.

    """
    confine(requested=discovery)
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = _node(context, namespace)
        graph = ObservedGraph(context.get_domain_id(), seconds,
                              {topic: Stream() for topic in STREAMS})
        _subscribe(node, graph)
        executor = runner.make_executor(context)
        executor.add_node(node)
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left)
        _look_at_publishers(node, graph)
        node.destroy_node()
    finally:
        context.try_shutdown()
    return graph


def _node(context, namespace):
    try:
        return rclpy.create_node('check', context=context, namespace=namespace)
    except NameValidationException as error:
        raise ParameterError(f"namespace '{namespace}': {str(error).splitlines()[0]}") from None


def _subscribe(node, graph):
    for topic, part in STREAMS.items():
        node.create_subscription(
            wire.message_class(TOPICS[topic].type), topic,
            partial(_take, node, graph.streams[topic], TOPICS[topic].take, part),
            wire.profile(LOG))
    for bridge in BRIDGES:
        wire.subscribe(node, f'{bridge}/state', partial(graph.states.__setitem__, bridge))
    wire.subscribe(node, 'diagnostics', partial(_take_diagnostics, graph))


def _take(node, stream, take, part, message):
    now = node.get_clock().now().nanoseconds * 1e-9
    stream.arrivals.append(time.monotonic())
    stream.ages.append(now - seconds_of(message.header.stamp))
    try:
        stream.norms.append(float(np.linalg.norm(getattr(take(message), part))))
    except MessageError as error:
        stream.refused[str(error)] += 1


def _take_diagnostics(graph, statuses):
    for status in statuses:
        graph.diagnostics[status.name] = Status(status.level, status.message, status.values)


def _look_at_publishers(node, graph):
    """Record the publishers of the topics, and other message types under their names."""
    for topic in STREAMS:
        wanted = TOPICS[topic].type
        for publisher in node.get_publishers_info_by_topic(topic):
            if publisher.topic_type == wanted:
                graph.streams[topic].publishers.append(publisher.node_name)
            elif publisher.topic_type not in graph.streams[topic].other_types:
                graph.streams[topic].other_types.append(publisher.topic_type)
