"""The viewer's data of a graph."""

from contextlib import closing

import numpy as np
import pytest

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.operator import LiveGraph
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
