"""rclpy side of the table of topics: message classes, quality of service, both ends."""

from array import array
from collections import deque
from collections.abc import Callable, Sequence
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

from beetle_omni_ros.messages.topics import Qos, topic_of

CHECK_PERIOD = 0.5      # s between checks of the publishers' quality of service
COPIES = 64             # newest messages that are compared to detect a copy
TWO_ARGUMENTS = inspect.Signature([
    inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY) for name in ('message', 'info')])


@cache
def message_class(name: str) -> type:
    """Return the class of a ROS type such as 'sensor_msgs/msg/Imu'."""
    package, _, message = name.split('/')
    return getattr(import_module(f'{package}.msg'), message)


class RclpyFactory:
    """See :class:`~beetle_omni_ros.messages.conversions.MessageFactory`."""

    def new(self, name: str) -> Any:
        """Make a message with default values, by its ROS type."""
        return message_class(name)()

    def doubles(self, values: Sequence[float]) -> array:
        """Return an array of doubles."""
        return array('d', values)

    def singles(self, values: Sequence[float]) -> array:
        """Return an array of floats."""
        return array('f', values)

    def byte(self, value: int) -> bytes:
        """Return one byte."""
        return bytes((value,))


RCLPY = RclpyFactory()


def profile(qos: Qos) -> QoSProfile:
    """Return the quality of service for rclpy."""
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE)


def message(topic: str, value: Any, frame: str | None = None) -> Any:
    """Make the message of a topic's value; ``frame`` replaces the topic's frame_id."""
    made = topic_of(topic).write(RCLPY, value)
    if frame is not None:
        made.header.frame_id = frame
    return made


def parameter_request(name: str, value: Any) -> SetParameters.Request:
    """Return the request of a service ``set_parameters`` for one parameter."""
    return SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])


class Publisher:
    """Publishes the values of a topic; ``qos`` replaces the quality of service of the table."""

    def __init__(self, node: Node, topic: str, qos: Qos | None = None):
        entry, self._topic = topic_of(topic), topic
        self._publisher = node.create_publisher(message_class(entry.type), topic,
                                                profile(qos or entry.qos))

    def publish(self, value: Any, frame: str | None = None) -> None:
        """Publish one value, see :func:`message`."""
        self._publisher.publish(message(self._topic, value, frame))

    def get_subscription_count(self) -> int:
        """Return the number of matched subscriptions."""
        return self._publisher.get_subscription_count()


def subscribe(node: Node, topic: str, handle: Callable[[Any], None], *, qos: Qos | None = None,
              read: Callable[[Any], Any] | None = None) -> None:
    """
    Subscribe a topic without checks of age.

    ``qos`` replaces the quality of service of the table, ``read`` its ``take``.
    """
    entry = topic_of(topic)
    take = read or entry.take
    node.create_subscription(message_class(entry.type), topic,
                             lambda received: handle(take(received)), profile(qos or entry.qos))


def with_publication(callback: Callable) -> Callable:
    """
    Make a subscription callback that also gets the time of publication.

    rclpy passes the message's info if the signature has two arguments. The single-threaded
    executor then passes two arguments, the events executor of Jazzy one tuple of both.

    Args:
        callback: called with (message, time of publication [s, system time, set by the middleware
            of the publisher; nan if unknown]).

    """
    def take(*given):
        message, info = given if len(given) == 2 else given[0]
        stamp = info.get('source_timestamp')
        callback(message, stamp * 1e-9 if stamp and stamp > 0 else math.nan)

    take.__signature__ = TWO_ARGUMENTS
    return take


class AnyQosSubscription:
    """
    Receives the messages of publishers with any quality of service, each message once.

    A subscription of latched messages is incompatible with a volatile publisher, such as
    `ros2 topic pub`; a volatile subscription misses messages latched earlier. So there is a
    volatile one at first, and others follow as soon as a publisher offers what needs them. This
    way neither end logs a warning about incompatible quality of service.

    A message that two subscriptions receive is passed on once, by its time of publication.

    Args:
        node: subscribing FlightNode.
        message_type: ROS message class.
        topic: name.
        callback: called with (message, time of publication [s, system time, or nan]).
        depth: depth of the queues.
        raw: whether the callback gets serialized messages.
        on_lost: called with rclpy's event of lost messages.

    """

    def __init__(self, node: Node, message_type: type, topic: str, callback: Callable, *,
                 depth: int = 10, raw: bool = False, on_lost: Callable | None = None):
        self._node, self._type, self._topic = node, message_type, topic
        self._depth, self._raw, self._on_lost = depth, raw, on_lost
        self._callback = callback
        self._seen: deque[float] = deque(maxlen=COPIES)     # times of publication
        self._profiles: set[tuple[ReliabilityPolicy, DurabilityPolicy]] = set()
        self._subscribe(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
        node.create_timer(CHECK_PERIOD, self._check_publishers, clock=node.steady_clock)

    def _subscribe(self, reliability, durability):
        if (reliability, durability) in self._profiles:
            return
        self._profiles.add((reliability, durability))
        self._node.create_subscription(
            self._type, self._topic, with_publication(self._take),
            QoSProfile(depth=self._depth, reliability=reliability, durability=durability),
            raw=self._raw, event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda event: None, message_lost=self._on_lost))

    def _take(self, message, publication):
        if publication in self._seen:       # never true for nan
            return
        self._seen.append(publication)
        self._callback(message, publication)

    def _check_publishers(self):
        """Add the subscriptions that the present publishers need."""
        for publisher in self._node.get_publishers_info_by_topic(self._topic):
            offer = publisher.qos_profile
            if offer.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                self._subscribe(ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
            if offer.reliability == ReliabilityPolicy.BEST_EFFORT:
                self._subscribe(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
