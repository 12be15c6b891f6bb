"""Subscribing a topic whose publishers may offer any durability and reliability."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from beetle_omni_ros.nodes import arrival

LOOK_PERIOD = 0.5       # s between looks at what publishers offer
COPIES = 64             # newest messages among which a copy is looked for


class EveryOffer:
    """
    Hears every publisher of one topic once, and none of them warns.

    A subscription that asks for latched messages is incompatible with a volatile publisher, and
    one that does not misses what was latched before it came. So there is a volatile one at first,
    and others follow as soon as a publisher offers what needs them. Both ends are then silent
    about volatile publishers, which is what `ros2 topic pub` makes.

    A message that two of them hear is passed on once, by its time of publication.

    Args:
        node: that subscribes, a FlightNode.
        message_type: ROS message class.
        topic: name.
        callback: called with (message, publication [s, system time, or nan]).
        depth: of the queues.
        raw: give the callback bytes.
        on_lost: called with the event of messages that were lost on the way.

    """

    def __init__(self, node: Node, message_type: type, topic: str, callback: Callable, *,
                 depth: int = 10, raw: bool = False, on_lost: Callable | None = None):
        """Subscribe, and look for offers from now on."""
        self._node, self._type, self._topic = node, message_type, topic
        self._depth, self._raw, self._on_lost = depth, raw, on_lost
        self._callback = callback
        self._seen: deque[float] = deque(maxlen=COPIES)     # times of publication
        self._heard: set[tuple[ReliabilityPolicy, DurabilityPolicy]] = set()
        self._subscribe(ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
        node.create_timer(LOOK_PERIOD, self._look, clock=node.steady_clock)

    def _subscribe(self, reliability, durability):
        if (reliability, durability) in self._heard:
            return
        self._heard.add((reliability, durability))
        self._node.create_subscription(
            self._type, self._topic, arrival.with_publication(self._take),
            QoSProfile(depth=self._depth, reliability=reliability, durability=durability),
            raw=self._raw, event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda event: None, message_lost=self._on_lost))

    def _take(self, message, publication):
        if publication in self._seen:       # nan never is
            return
        self._seen.append(publication)
        self._callback(message, publication)

    def _look(self):
        """Add what publishers need."""
        for publisher in self._node.get_publishers_info_by_topic(self._topic):
            offer = publisher.qos_profile
            if offer.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                self._subscribe(ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
            if offer.reliability == ReliabilityPolicy.BEST_EFFORT:
                self._subscribe(ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)


