"""`beetle_omni check` with real publishers: rates, ages, duplicates, wrong types, bridges."""

import threading
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
import numpy as np
import pytest
import rclpy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from beetle_omni_ros.bringup.findings import check_topics
from beetle_omni_ros.messages.topics import EVENT, LATCHED, SENSOR
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.operator import listen
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import PoseReading

pytestmark = pytest.mark.real_time
UPRIGHT = np.array([0, 0, 0, 1.0])


class Reading:
    """An IMU at rest."""

    def __init__(self, stamp, rng):
        self.stamp, self.angular_velocity = stamp, np.zeros(3)
        self.specific_force = np.array([0, 0, 9.81]) + 0.01 * rng.normal(size=3)


class Drivers:
    """MoCap, IMU and joint bridge in a thread, the IMU with a clock that is 50 ms ahead."""

    def __init__(self, domain):
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain,
                   signal_handler_options=SignalHandlerOptions.NO)
        self.node = node = rclpy.create_node('vrpn', context=self.context)
        self.twin = rclpy.create_node('sim_node', context=self.context)
        self.mocap = node.create_publisher(PoseStamped, 'mocap/pose', wire.profile(SENSOR))
        self.other = self.twin.create_publisher(PoseStamped, 'mocap/pose', wire.profile(SENSOR))
        self.imu = node.create_publisher(Imu, 'imu/data_raw', wire.profile(SENSOR))
        self.wrong = node.create_publisher(String, 'battery_state', wire.profile(SENSOR))
        self.joints = node.create_publisher(JointState, 'joint_states', wire.profile(SENSOR))
        self.state = node.create_publisher(String, 'joint_bridge/state', wire.profile(LATCHED))
        self.diagnostics = node.create_publisher(DiagnosticArray, 'diagnostics',
                                                 wire.profile(EVENT))
        self.state.publish(String(data='ready'))
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.run, daemon=True)

    def run(self):
        """Publish at 200 and 100 Hz until the exit."""
        rng, due = np.random.default_rng(0), time.monotonic()
        for k in range(10**6):
            if self.stop.is_set():
                return
            now = time.time()
            self.imu.publish(wire.serialized('imu/data_raw', Reading(now + 0.05, rng)))
            if k % 2 == 0:
                self.mocap.publish(wire.serialized('mocap/pose', PoseReading(
                    now - 0.008, rng.normal(size=3), UPRIGHT)))
                self.joints.publish(JointState(name=['gimbal1'], position=[0.0]))
            if k % 100 == 0:
                self.diagnostics.publish(DiagnosticArray(status=[DiagnosticStatus(
                    level=DiagnosticStatus.ERROR, name='joint_bridge_node: gimbal2',
                    message='overload', values=[KeyValue(key='voltage', value='11.9')])]))
            due += 0.005
            time.sleep(max(0.0, due - time.monotonic()))

    def __enter__(self):
        """Publish."""
        self.thread.start()
        return self

    def __exit__(self, *_):
        """Destroy the publishers."""
        self.stop.set()
        self.thread.join()
        self.twin.destroy_node()
        self.node.destroy_node()
        self.context.try_shutdown()


def test_messages_of_real_publishers_are_recorded_and_checked(ros_domain):
    with Drivers(ros_domain):
        for _ in range(5):      # discovery is slow on a busy machine
            graph = listen(3.0)
            if graph.streams['imu/data_raw'].arrivals and graph.of_bridge('joint_bridge'):
                break
    assert graph.domain == ros_domain
    imu, mocap = graph.streams['imu/data_raw'], graph.streams['mocap/pose']
    assert len(imu.arrivals) == pytest.approx(2 * len(mocap.arrivals), rel=0.1)
    assert -0.05 <= min(imu.ages) < 0 <= 0.008 <= min(mocap.ages)
    assert np.mean(imu.norms) == pytest.approx(9.81, abs=0.05)
    assert sorted(mocap.publishers) == ['sim_node', 'vrpn'] and imu.publishers == ['vrpn']
    assert graph.streams['battery_state'].other_types == ['std_msgs/msg/String']
    assert graph.streams['joint_states'].refused.total() > 1
    assert graph.states == {'joint_bridge': 'ready'}
    found = {finding.item: finding for finding in check_topics(
        graph, RobotParameters.load().gravity)}
    assert {item for item, finding in found.items() if finding.level == 'fail'} >= {
        'imu/data_raw age', 'mocap/pose publishers', 'joint_states content',
        'joint_bridge gimbal2'}
    assert found['joint_bridge gimbal2'].values == {'voltage': '11.9'}
