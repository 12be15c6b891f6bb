"""`beetle_omni check` with real publishers: rates, ages, duplicates, wrong types, bridges."""

from contextlib import closing
import threading
import time

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from beetle_omni_ros.bringup.findings import check_topics
from beetle_omni_ros.messages.topics import SENSOR
from beetle_omni_ros.messages.values import Diagnostic
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.operator import Client, listen
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import ImuReading, PoseReading

pytestmark = pytest.mark.real_time
UPRIGHT = np.array([0, 0, 0, 1.0])


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
