"""rclpy side of the table of topics: message classes, quality of service, both ends."""

from collections import deque
from collections.abc import Callable
from functools import cache
from importlib import import_module
import inspect
import math
import time
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from beetle_omni_ros.bags.messages import from_bytes, MessageError, to_bytes
from beetle_omni_ros.bags.topics import Qos, TARGETS, Topic, topic_of

COPIES = 64             # newest messages that are compared to detect a copy
QUIET = 2.0             # s between two warnings of a kind
TARGET_DEPTH = 10       # messages of a target at least that wait for a slow reader
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


def warner(node: Node) -> Callable[[str, str], None]:
    """Return a function (kind, text) that logs one warning of a kind every ``QUIET`` s at most."""
    kinds: dict[str, tuple[float, int]] = {}        # time of the last line, number left out since

    def warn(kind, text):
        now, (last, left_out) = time.monotonic(), kinds.get(kind, (-math.inf, 0))
        kinds[kind] = (now, 0) if now >= last + QUIET else (last, left_out + 1)
        if not kinds[kind][1]:
            node.get_logger().warning(f'{text} ({left_out} more before)' if left_out else text)

    return warn


def subscribe(node: Node, topic: str, handle: Callable[[Any], None],
              qos: Qos | None = None) -> None:
    """Pass the values of a topic to ``handle``, without checks of age."""
    entry, warn = topic_of(topic), warner(node)

    def callback(data, *_):
        try:
            handle(entry.take(message(entry, data)))
        except MessageError as error:
            warn(error.kind, f'{topic}: message refused, {error}')

    subscribe_raw(node, topic, callback, qos)


def subscribe_raw(node: Node, topic: str, callback: Callable, qos: Qos | None = None,
                  on_lost: Callable | None = None) -> None:
    """
    Pass the CDR messages of a topic; those of targets with any quality of service, each once.

    A subscription of latched messages is incompatible with a volatile publisher, such as
    `ros2 topic pub`; a volatile subscription misses messages latched earlier. So targets have
    both. A message that both receive is passed on once, by its time of publication.

    ``callback`` gets the bytes, and for targets the time of publication [s, system time, set by
    the middleware of the publisher; nan if unknown], ``on_lost`` rclpy's event of lost messages.
    ``qos`` replaces that of the table.
    """
    qos, seen = qos or topic_of(topic).qos, deque(maxlen=COPIES)

    def take(*given):   # the events executor of rclpy 7.1 passes one tuple of both arguments
        data, info = given if len(given) == 2 else given[0]
        stamp = info.get('source_timestamp')
        publication = stamp * 1e-9 if stamp and stamp > 0 else math.nan
        if publication not in seen:     # nan never is
            seen.append(publication)
            callback(data, publication)

    take.__signature__ = TWO_ARGUMENTS      # rclpy passes the info of the message by this
    is_target = topic in TARGETS
    for one in [Qos(max(qos.depth, TARGET_DEPTH), reliable=latched, latched=latched)
                for latched in (False, True)] if is_target else [qos]:
        node.create_subscription(
            message_class(topic_of(topic).type), topic, take if is_target else callback,
            profile(one), raw=True, event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=(lambda event: None) if is_target else None,
                message_lost=on_lost))
