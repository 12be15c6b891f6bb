"""The time of publication reaches the callback."""

import time

import pytest
from std_msgs.msg import String

from beetle_omni_ros.messages.topics import COMMAND
from beetle_omni_ros.nodes import wire

pytestmark = pytest.mark.real_time


def test_a_callback_gets_the_time_at_which_its_message_was_published(bench):
    received = []
    bench.user.create_subscription(String, 'word', wire.with_publication(
        lambda message, published: received.append((message.data, published))),
        wire.profile(COMMAND))
    publisher = bench.publisher(String, 'word', wire.profile(COMMAND))
    before = time.time()
    publisher.publish(String(data='now'))
    after = time.time()
    assert bench.wait(lambda: received)
    assert received[0][0] == 'now'
    assert before - 1e-3 <= received[0][1] <= after + 1e-3
