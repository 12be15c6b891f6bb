"""rclpy side of the table of topics: message classes, quality of service, both ends."""

from collections import deque
from collections.abc import Callable
from functools import cache
from importlib import import_module
import inspect
import math
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from beetle_omni_ros.messages.bag_types import from_bytes, to_bytes
from beetle_omni_ros.messages.topics import Qos, TARGETS, Topic, topic_of
from beetle_omni_ros.messages.values import MessageError

COPIES = 64             # newest messages that are compared to detect a copy
TWO_ARGUMENTS = inspect.Signature([
    inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY) for name in ('message', 'info')])


@cache
def message_class(name: str) -> type:
    """Return the class of a ROS type such as 'sensor_msgs/msg/Imu'."""
    package, _, message = name.split('/')
    return getattr(import_module(f'{package}.msg'), message)


def profile(qos: Qos) -> QoSProfile:
    """Return the quality of service for rclpy."""
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE)


def serialized(topic: str, value: Any, frame: str | None = None) -> bytes:
    """Make the CDR message of a topic's value; ``frame`` replaces the topic's frame_id."""
    entry = topic_of(topic)
    made = entry.write(value)
    if frame is not None:
        made.header.frame_id = frame
    return bytes(to_bytes(made, entry.type))


def message(topic: Topic, data: bytes) -> Any:
    """Decode the message of a topic; MessageError for broken bytes."""
    try:
        return from_bytes(data, topic.type)
    except Exception:       # broken bytes raise anything
        raise MessageError('not readable') from None


def parameter_request(name: str, value: Any) -> SetParameters.Request:
    """Return the request of a service ``set_parameters`` for one parameter."""
    return SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])


class Publisher:
    """Publishes the values of a topic."""

    def __init__(self, node: Node, topic: str):
        entry, self._topic = topic_of(topic), topic
        self._publisher = node.create_publisher(message_class(entry.type), topic,
                                                profile(entry.qos))

    def publish(self, value: Any, frame: str | None = None) -> None:
        """Publish one value, see :func:`serialized`."""
        self._publisher.publish(serialized(self._topic, value, frame))


def subscribe(node: Node, topic: str, handle: Callable[[Any], None],
              qos: Qos | None = None) -> None:
    """Subscribe without checks of age; ``qos`` replaces that of the table, or any of targets."""
    entry = topic_of(topic)

    def callback(data, _=None):
        try:
            handle(entry.take(message(entry, data)))
        except MessageError as error:
            node.get_logger().warning(f'{topic}: message refused, {error}')

    if topic in TARGETS and qos is None:
        subscribe_any(node, topic, callback)
    else:
        subscribe_raw(node, topic, lambda data: callback(data), qos)


def subscribe_raw(node: Node, topic: str, callback: Callable[[bytes], None],
                  qos: Qos | None = None, **more) -> None:
    """Pass the CDR messages of a topic; ``qos`` replaces that of the table."""
    entry = topic_of(topic)
    node.create_subscription(message_class(entry.type), topic, callback,
                             profile(qos or entry.qos), raw=True, **more)


def subscribe_any(node: Node, topic: str, callback: Callable[[bytes, float], None], *,
                  depth: int = 10, on_lost: Callable | None = None) -> None:
    """
    Receive the messages of publishers with any quality of service, each message once.

    A subscription of latched messages is incompatible with a volatile publisher, such as
    `ros2 topic pub`; a volatile subscription misses messages latched earlier. So there are both.
    A message that both receive is passed on once, by its time of publication [s, system time, set
    by the middleware of the publisher; nan if unknown]. ``on_lost`` gets rclpy's event of lost
    messages.
    """
    seen: deque[float] = deque(maxlen=COPIES)

    def take(*given):   # the events executor of rclpy 7.1 passes one tuple of both arguments
        data, info = given if len(given) == 2 else given[0]
        stamp = info.get('source_timestamp')
        publication = stamp * 1e-9 if stamp and stamp > 0 else math.nan
        if publication not in seen:     # nan never is
            seen.append(publication)
            callback(data, publication)

    take.__signature__ = TWO_ARGUMENTS      # rclpy passes the info of the message by this
    for is_latched in (False, True):
        subscribe_raw(node, topic, take, Qos(depth, reliable=is_latched, latched=is_latched),
                      event_callbacks=SubscriptionEventCallbacks(
                          incompatible_qos=lambda event: None, message_lost=on_lost))
