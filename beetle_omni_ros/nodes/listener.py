"""Listens to the graph for some seconds, for `beetle_omni check`; publishes nothing."""

from __future__ import annotations

from functools import partial
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
import numpy as np
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import BatteryState, Imu, JointState
from std_msgs.msg import String

from beetle_omni_ros.bringup.heard import BRIDGES, Heard, Status, Stream
from beetle_omni_ros.nodes import convert, qos, runner
from beetle_omni_ros.nodes.discovery import confine
from beetle_omni_ros.robot.schema import ParameterError

# Topic -> type, how it is read, what of it no living sensor repeats.
STREAMS = {
    'mocap/pose': (PoseStamped, convert.pose_sample, lambda pose: pose.position),
    'imu/data_raw': (Imu, convert.imu_sample, lambda imu: imu.specific_force),
    'joint_states': (JointState, convert.joints, lambda joints: joints.position),
    'battery_state': (BatteryState, convert.battery, lambda battery: battery.voltage)}


def listen(seconds: float, namespace: str = '', discovery: str | None = None) -> Heard:
    """
    Join the graph and take in what comes.

    Args:
        seconds: how long.
        namespace: of the robot's topics.
        discovery: who is looked for, see :mod:`discovery`; default this computer alone.

    Raises:
        ParameterError: no such namespace or range of discovery is possible.

    """
    confine(asked=discovery)
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = _node(context, namespace)
        heard = Heard(context.get_domain_id(), seconds, {topic: Stream() for topic in STREAMS})
        _subscribe(node, heard)
        executor = runner.make_executor(context)
        executor.add_node(node)
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left)
        _look_at_publishers(node, heard)
        node.destroy_node()
    finally:
        context.try_shutdown()
    return heard


def _node(context, namespace):
    try:
        return rclpy.create_node('check', context=context, namespace=namespace)
    except NameValidationException as error:
        raise ParameterError(f"namespace '{namespace}': {str(error).splitlines()[0]}") from None


def _subscribe(node, heard):
    for topic, (kind, read, of_it) in STREAMS.items():
        node.create_subscription(kind, topic, partial(_take, node, heard.streams[topic], read,
                                                      of_it), qos.LOG)
    for bridge in BRIDGES:
        node.create_subscription(String, f'{bridge}/state', partial(_take_state, heard, bridge),
                                 qos.LATCHED)
    node.create_subscription(DiagnosticArray, 'diagnostics', partial(_take_diagnostics, heard),
                             qos.EVENT)


def _take(node, stream, read, of_it, message):
    now = node.get_clock().now().nanoseconds * 1e-9
    stream.arrivals.append(time.monotonic())
    stream.ages.append(now - convert.seconds(message.header.stamp))
    try:
        stream.sizes.append(float(np.linalg.norm(of_it(read(message)))))
    except convert.MessageError as error:
        stream.refused[str(error)] += 1


def _take_state(heard, bridge, message):
    heard.states[bridge] = message.data


def _take_diagnostics(heard, message):
    for status in message.status:
        heard.diagnostics[status.name] = Status(
            ord(status.level), status.message, {pair.key: pair.value for pair in status.values})


def _look_at_publishers(node, heard):
    """Who publishes the topics, and who something else under their name."""
    for topic, (kind, _, _) in STREAMS.items():
        wanted = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
        for publisher in node.get_publishers_info_by_topic(topic):
            if publisher.topic_type == wanted:
                heard.streams[topic].publishers.append(publisher.node_name)
            elif publisher.topic_type not in heard.streams[topic].other_types:
                heard.streams[topic].other_types.append(publisher.topic_type)
