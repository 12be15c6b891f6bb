"""Targets are received once with any quality of service, without warnings."""

import time

from geometry_msgs.msg import PoseStamped
import pytest
import rclpy
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from beetle_omni_ros.messages.topics import EVENT, LATCHED
from beetle_omni_ros.nodes import runner, wire
from beetle_omni_ros.nodes.recorder_node import RecorderNode
from beetle_omni_ros.runs.bag import read_bag

pytestmark = pytest.mark.real_time
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
SOON = 10       # s


class Bench:
    """A recorder, and a node that publishes targets."""

    def __init__(self, domain, bag):
        rclpy.init(args=['--ros-args', '-p', f'bag:={bag}'], domain_id=domain)
        self.recorder, self.user = RecorderNode(), rclpy.create_node('user')
        self.executor = runner.make_executor()
        self.executor.add_node(self.recorder)
        self.executor.add_node(self.user)
        self.incompatible = []

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)

    def publisher(self, profile):
        return self.user.create_publisher(
            PoseStamped, 'target_pose', profile, event_callbacks=PublisherEventCallbacks(
                incompatible_qos=self.incompatible.append))

    def written(self):
        return self.recorder._bag.counts['/target_pose']

    def publish(self, publisher, height):
        """Publish after the subscription; wait until the message is written."""
        before, end = self.written(), time.monotonic() + SOON
        message = PoseStamped()
        message.pose.position.z, message.pose.orientation.w = height, 1.0
        while not publisher.get_subscription_count() and time.monotonic() < end:
            self.spin(0.05)
        publisher.publish(message)
        while self.written() == before and time.monotonic() < end:
            self.spin(0.05)
        return self.written() - before


@pytest.fixture
def bench(ros_domain, tmp_path):
    made = Bench(ros_domain, tmp_path / 'bag')
    yield made
    made.recorder.destroy_node()
    made.user.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.parametrize('profile', [wire.profile(EVENT), wire.profile(LATCHED), BEST_EFFORT])
def test_each_target_is_recorded_once_with_any_quality_of_service(bench, tmp_path, profile):
    publisher, heights = bench.publisher(profile), [1.0, 1.1, 1.2]
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    if latched:
        publisher.publish(PoseStamped())        # before the subscription
    bench.spin(1.2)     # the required subscriptions exist; two checks of the offered topics
    assert [bench.publish(publisher, height) for height in heights] == [1, 1, 1]
    bench.spin(0.3)
    assert not bench.incompatible or profile is BEST_EFFORT
    bench.recorder.close()
    targets = read_bag(tmp_path / 'bag').targets
    assert [target.position[2] for target in targets] == [0.0] * latched + heights
    assert targets[-1].stamp == pytest.approx(time.time(), abs=60)   # time of receipt
