"""Data of a running graph for the browser and for RViz."""

from contextlib import closing

import numpy as np
import pytest
from std_msgs.msg import String

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages.bag_types import from_bytes
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.operator import LiveGraph
from beetle_omni_ros.nodes.side_nodes import ViewerNode
from beetle_omni_ros.robot.readings import JointReading
from beetle_omni_ros.runs.bag_writer import FRAMES
from beetle_omni_ros.view.live import Newest

pytestmark = pytest.mark.real_time
TURNED = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])


def test_messages_become_a_moment(make_bench, ros_domain):
    bench = make_bench(user='supervisor_node')
    odom, truth, command, target = (wire.Publisher(bench.user, topic) for topic in (
        'odom', 'ground_truth/odom', 'command', 'target_pose'))
    target.publish(PoseTarget(np.array([0, 0, 2.0]), TURNED, 6.0))
    newest = Newest()

    def complete():
        for publisher, height in ((odom, 1.01), (truth, 1.0)):
            publisher.publish(Odom(7.0, np.array([0.5, 0, height]), np.zeros(3), TURNED,
                                   np.zeros(3), np.zeros((6, 6)), np.zeros((6, 6))))
        command.publish(Command(7.0, np.full(4, 0.2), np.array([1.0, 2, 3, 4])))
        graph.take(newest)
        return len(newest.values) == 4
    with closing(LiveGraph(domain=ros_domain)) as graph:
        assert bench.wait(complete)
    moment = newest.moment()
    np.testing.assert_allclose(moment.position, [0.5, 0, 1.0])
    np.testing.assert_allclose(moment.target[0], [0, 0, 2])
    np.testing.assert_allclose(moment.thrust, [1, 2, 3, 4])
    text = newest.text(moment)
    assert '**7.0 s**' in text and 'estimate 10 mm off' in text


def test_the_viewer_node_publishes_description_and_frames(bench, monkeypatch):
    monkeypatch.setattr(wire, 'message_class', lambda name, real=wire.message_class: (
        String if name.startswith('tf2') else real(name)))      # tf2_msgs is not on PyPI
    bench.add(ViewerNode())
    received, odom, joints = {}, *(wire.Publisher(bench.user, name)
                                   for name in ('odom', 'joint_states'))
    for name, (kind, qos) in FRAMES.items():
        bench.user.create_subscription(
            String, name, lambda data, name=name, kind=kind: received.setdefault(
                name, from_bytes(data, kind)), wire.profile(qos), raw=True)

    def complete():
        joints.publish(JointReading(1.0, np.zeros(4), np.zeros(4)))
        odom.publish(Odom(1.0, np.ones(3), np.zeros(3), TURNED, np.zeros(3)))
        return len(received) == 3
    assert bench.wait(complete)
    named = {frame.child_frame_id for name in ('/tf', '/tf_static')
             for frame in received[name].transforms}
    assert {'base_link', 'module4', 'rotor4'} <= named
    assert received['robot_description'].data.startswith('<?xml')
