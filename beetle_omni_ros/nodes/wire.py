"""The table of topics in the terms of rclpy: message classes, quality of service, publishers."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from beetle_omni_ros.messages.topics import Qos, topic_of


@cache
def message_class(name: str) -> type:
    """Find the class of a ROS type, 'sensor_msgs/msg/Imu'."""
    package, _, message = name.split('/')
    return getattr(import_module(f'{package}.msg'), message)


class RclpyKind:
    """See :class:`~beetle_omni_ros.messages.conversions.Kind`."""

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


RCLPY = RclpyKind()


def profile(qos: Qos) -> QoSProfile:
    """Quality of service for rclpy."""
    return QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy.RELIABLE if qos.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else DurabilityPolicy.VOLATILE)


def message(topic: str, value: Any, frame: str | None = None) -> Any:
    """
    Make the message of a value.

    Args:
        topic: see :func:`~beetle_omni_ros.messages.topics.topic_of`.
        value: of that topic.
        frame: another frame_id than the topic's.

    """
    made = topic_of(topic).write(RCLPY, value)
    if frame is not None:
        made.header.frame_id = frame
    return made


class Publisher:
    """
    Publishes the values of one topic.

    Args:
        node: that publishes.
        topic: relative name.
        qos: other than the table's.

    """

    def __init__(self, node: Node, topic: str, qos: Qos | None = None):
        """Advertise the topic."""
        entry, self._topic = topic_of(topic), topic
        self._publisher = node.create_publisher(message_class(entry.type), topic,
                                                profile(qos or entry.qos))

    def publish(self, value: Any, frame: str | None = None) -> None:
        """Publish one value, see :func:`message`."""
        self._publisher.publish(message(self._topic, value, frame))

    def get_subscription_count(self) -> int:
        """How many hear it."""
        return self._publisher.get_subscription_count()


def subscribe(node: Node, topic: str, handle: Callable[[Any], None], *, qos: Qos | None = None,
              read: Callable[[Any], Any] | None = None) -> None:
    """
    Subscribe a topic without checks of age.

    Args:
        node: that subscribes.
        topic: relative name.
        handle: called with the value.
        qos: other than what the topic's publisher offers.
        read: other than the table's ``take``.

    """
    entry = topic_of(topic)
    take = read or entry.take
    node.create_subscription(message_class(entry.type), topic,
                             lambda received: handle(take(received)), profile(qos or entry.qos))
