"""Observers of a running graph: `beetle_omni check`, the browser, RViz."""

from contextlib import closing, suppress
import threading
import time

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from beetle_omni_ros.bags.bag_writer import FRAMES
from beetle_omni_ros.bags.messages import Diagnostic, from_bytes
from beetle_omni_ros.bags.topics import SENSOR
from beetle_omni_ros.control.base import Command, PoseTarget
from beetle_omni_ros.drivers.check import check_topics
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.readings import ImuReading, JointReading, PoseReading
from beetle_omni_ros.model.rotations import BodyState
from beetle_omni_ros.ros import clients, wire
from beetle_omni_ros.ros.clients import Client, listen, LiveGraph
from beetle_omni_ros.ros.graph import claim, domains_in_use
from beetle_omni_ros.ros.nodes import viewer_node
from beetle_omni_ros.show.recorded import Newest

pytestmark = pytest.mark.real_time
UPRIGHT = np.array([0, 0, 0, 1.0])
TURNED = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])


def drive(node, twin, stop):
    """MoCap, IMU and joint bridge, the IMU with a clock that is 50 ms ahead."""
    rng = np.random.default_rng(0)
    mocap, imu, state, diagnostics, _ = (
        wire.Publisher(*made) for made in (
            (node, 'mocap/pose'), (node, 'imu/data_raw'), (node, 'joint_bridge/state'),
            (node, 'diagnostics'), (twin, 'mocap/pose')))
    joints = node.create_publisher(JointState, 'joint_states', wire.profile(SENSOR))
    node.create_publisher(String, 'battery_state', wire.profile(SENSOR))
    state.publish('ready')
    k, due = 0, time.monotonic()
    while not stop.is_set():
        now = time.time()
        imu.publish(ImuReading(now + 0.05, [0, 0, 9.81] + 0.01 * rng.normal(size=3), np.zeros(3)))
        if k % 2 == 0:
            mocap.publish(PoseReading(now - 0.008, rng.normal(size=3), UPRIGHT))
            joints.publish(JointState(name=['gimbal1'], position=[0.0]))
        if k % 100 == 0:
            diagnostics.publish([Diagnostic(now, 'joint_bridge_node: gimbal2', 2, 'overload')])
        k, due = k + 1, due + 0.005
        time.sleep(max(0.0, due - time.monotonic()))


def test_messages_of_real_publishers_are_recorded_and_checked(ros_domain):
    stop = threading.Event()
    with closing(Client('vrpn', ros_domain)) as one, \
            closing(Client('sim_node', ros_domain)) as two:
        thread = threading.Thread(target=drive, args=(one._node, two._node, stop), daemon=True)
        thread.start()
        for _ in range(5):      # discovery is slow on a busy machine
            graph = listen(3.0)
            if graph.streams['imu/data_raw'].arrivals and graph.of_bridge('joint_bridge'):
                break
        stop.set()
        thread.join()
    assert graph.domain == ros_domain
    imu, mocap = graph.streams['imu/data_raw'], graph.streams['mocap/pose']
    assert len(imu.arrivals) == pytest.approx(2 * len(mocap.arrivals), rel=0.1)
    assert -0.05 <= min(imu.ages) < 0 <= 0.008 <= min(mocap.ages)
    assert np.mean(imu.norms) == pytest.approx(9.81, abs=0.05)
    assert sorted(mocap.publishers) == ['sim_node', 'vrpn'] and imu.publishers == ['vrpn']
    assert graph.streams['battery_state'].other_types == ['std_msgs/msg/String']
    assert graph.states == {'joint_bridge': 'ready'}
    failed = {finding.item for finding in check_topics(graph, RobotParameters.load().gravity)
              if finding.level == 'fail'}
    assert failed >= {'imu/data_raw age', 'mocap/pose publishers', 'joint_states content',
                      'joint_bridge gimbal2'}


def test_the_view_names_the_domains_with_a_flight_and_shows_the_only_one(ros_domain, monkeypatch):
    assert ros_domain not in domains_in_use()
    with closing(LiveGraph(domain=ros_domain)) as graph, claim('230/robot1/ekf_node'), \
            claim('231/ekf_node'), claim('231/sim_node'), claim('229/other_node'):
        assert {230, 231} <= set(domains_in_use()) and 229 not in domains_in_use()
        assert f'in ROS domain {ros_domain}; ' in graph.waits()
        assert '--domain-id 230, --domain-id 231' in graph.waits()
    shown = []
    monkeypatch.setattr(clients, 'LiveGraph', lambda namespace, domain: shown.append(domain))
    monkeypatch.setattr(clients, 'domains_in_use', lambda: [230])
    for environment in ('', '5'):
        monkeypatch.setenv('ROS_DOMAIN_ID', environment)
        with suppress(AttributeError):      # of the graph that is not made
            clients.run_live(host='127.0.0.1', port=8080)
    assert shown == [230, None]


def test_messages_become_a_moment(make_bench, ros_domain):
    bench = make_bench(user='supervisor_node')
    odom, truth, command, target = (wire.Publisher(bench.user, topic) for topic in (
        'odom', 'ground_truth/odom', 'command', 'target_pose'))
    target.publish(PoseTarget(np.array([0, 0, 2.0]), TURNED, 6.0))
    newest = Newest()

    def complete():
        for publisher, height in ((odom, 1.01), (truth, 1.0)):
            publisher.publish(BodyState(7.0, np.array([0.5, 0, height]), np.zeros(3), TURNED,
                                   np.zeros(3)))
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
    assert text.startswith('1.0 s\n') and 'estimate 10 mm off' in text


def test_the_viewer_node_publishes_description_and_frames(bench, monkeypatch):
    monkeypatch.setattr(wire, 'message_class', lambda name, real=wire.message_class: (
        String if name.startswith('tf2') else real(name)))      # tf2_msgs is not on PyPI
    bench.add(viewer_node())
    received, odom, joints = {}, *(wire.Publisher(bench.user, name)
                                   for name in ('odom', 'joint_states'))
    for name, (kind, qos) in FRAMES.items():
        bench.user.create_subscription(
            String, name, lambda data, name=name, kind=kind: received.setdefault(
                name, from_bytes(data, kind)), wire.profile(qos), raw=True)

    def complete():
        joints.publish(JointReading(1.0, np.zeros(4), np.zeros(4)))
        odom.publish(BodyState(1.0, np.ones(3), np.zeros(3), TURNED, np.zeros(3)))
        return len(received) == 3
    assert bench.wait(complete)
    named = {frame.child_frame_id for name in ('/tf', '/tf_static')
             for frame in received[name].transforms}
    assert {'base_link', 'module4', 'rotor4'} <= named
    assert received['robot_description'].data.startswith('<?xml')
