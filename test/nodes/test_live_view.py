"""The viewer's data of a graph, and its targets and selections."""

import threading
import time

import numpy as np
import pytest
from rcl_interfaces.msg import SetParametersResult
import rclpy

from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.messages.values import Odom
from beetle_omni_ros.nodes import runner, wire
from beetle_omni_ros.nodes.live_view import LiveGraph
from beetle_omni_ros.view.frames import COLUMNS, pose, Sampler

pytestmark = pytest.mark.real_time
TIMEOUT = 20.0      # [s]
TURNED = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])


@pytest.fixture
def graph(ros_domain):
    """A node in place of a graph, spun in a thread."""
    rclpy.init(domain_id=ros_domain)
    node = rclpy.create_node('supervisor_node')
    executor = runner.make_executor()
    executor.add_node(node)
    stop = threading.Event()

    def spin():
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.05)
    thread = threading.Thread(target=spin)
    thread.start()
    yield node
    stop.set()
    thread.join()
    node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def listener(graph, ros_domain):
    made = LiveGraph(domain=ros_domain, writable=True)
    yield made
    made.close()


def wait(condition):
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.05)
    return False


def test_messages_become_a_row(graph, listener):
    odom, truth, command, target = (wire.Publisher(graph, topic) for topic in (
        'odom', 'ground_truth/odom', 'command', 'target_pose'))
    target.publish(PoseTarget(np.array([0, 0, 2.0]), TURNED, 6.0))
    sampler = Sampler()

    def complete():
        for publisher, height in ((odom, 1.01), (truth, 1.0)):
            publisher.publish(Odom(7.0, np.array([0.5, 0, height]), np.zeros(3), TURNED,
                                   np.zeros(3), np.zeros((6, 6)), np.zeros((6, 6))))
        command.publish(Command(7.0, np.full(4, 0.2), np.array([1.0, 2, 3, 4])))
        listener.take(sampler)
        row = sampler.row(8.0)
        return not np.isnan(row[COLUMNS['thrust']]).any() and \
            pose(row, 'estimate_') and pose(row, 'target_')
    assert wait(complete)
    row = sampler.row(8.0)
    np.testing.assert_allclose(row[COLUMNS['position']], [0.5, 0, 1.0])
    np.testing.assert_allclose(row[COLUMNS['estimate_position']], [0.5, 0, 1.01])
    np.testing.assert_allclose(row[COLUMNS['target_position']], [0, 0, 2])
    np.testing.assert_allclose(row[COLUMNS['thrust']], [1, 2, 3, 4])
    assert sampler.clock == pytest.approx(7.0)


def test_a_target_arrives_latched_and_unchanged(graph, listener):
    target = PoseTarget(np.array([0.4, -0.2, 1.5]), TURNED, 12.25)
    listener.publish_target(target)
    received = []      # of a later subscriber
    wire.subscribe(graph, 'target_pose', received.append)
    assert wait(lambda: received)
    found = received[0]
    np.testing.assert_allclose(found.position, target.position)
    np.testing.assert_allclose(found.quaternion, target.quaternion)
    assert found.stamp == target.stamp


def test_the_supervisor_accepts_or_refuses_a_controller(graph, listener):
    answers = []
    graph.declare_parameter('controller', 'nmpc')
    graph.add_on_set_parameters_callback(lambda given: SetParametersResult(
        successful=given[0].value == 'rl', reason='rl alone'))
    wire.Publisher(graph, 'rl/command')
    assert wait(lambda: listener.controllers() == ['rl'])
    assert wait(lambda: listener._setting.service_is_ready())
    listener.select('rl', answers.append)
    assert wait(lambda: answers == [''])
    assert graph.get_parameter('controller').value == 'rl'
    listener.select('hover', answers.append)
    assert wait(lambda: answers == ['', 'rl alone'])
    assert graph.get_parameter('controller').value == 'rl'


def test_a_read_only_graph_publishes_no_target(graph, ros_domain):
    silent = LiveGraph(domain=ros_domain)
    try:
        silent.publish_target(PoseTarget(np.zeros(3), TURNED, 1.0))
        answers = []
        silent.select('rl', answers.append)
        assert answers == ['supervisor_node is not there']
        assert wait(lambda: graph.count_subscribers('odom'))    # it is in the graph
        assert not graph.count_publishers('target_pose')
    finally:
        silent.close()
