"""The time of publication reaches the callback."""

import time

import pytest
import rclpy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String

from beetle_omni_ros.messages.topics import COMMAND
from beetle_omni_ros.nodes import runner, wire

pytestmark = pytest.mark.real_time
PATIENCE = 20           # s


def test_a_callback_gets_the_time_at_which_its_message_was_published(ros_domain):
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=ros_domain,
               signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('listener', context=context)
    executor = runner.make_executor(context=context)
    executor.add_node(node)
    received = []
    node.create_subscription(String, 'word', wire.with_publication(
        lambda message, published: received.append((message.data, published))),
        wire.profile(COMMAND))
    publisher = node.create_publisher(String, 'word', wire.profile(COMMAND))
    try:
        deadline = time.monotonic() + PATIENCE
        while not received and time.monotonic() < deadline:
            before = time.time()
            publisher.publish(String(data='now'))
            after = time.time()
            executor.spin_once(timeout_sec=0.2)
        assert received[0][0] == 'now'
        assert before - 1e-3 <= received[0][1] <= after + 1e-3
    finally:
        node.destroy_node()
        context.try_shutdown()
