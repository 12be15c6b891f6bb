"""`beetle_omni check` with real publishers: rates, ages, duplicates, wrong types, bridges."""

from contextlib import contextmanager
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
from beetle_omni_ros.robot.readings import ImuReading, PoseReading

pytestmark = pytest.mark.real_time
UPRIGHT = np.array([0, 0, 0, 1.0])


@contextmanager
def drivers(domain):
    """MoCap, IMU and joint bridge in a thread, the IMU with a clock that is 50 ms ahead."""
    context, stop, rng = rclpy.Context(), threading.Event(), np.random.default_rng(0)
    rclpy.init(args=[], context=context, domain_id=domain,
               signal_handler_options=SignalHandlerOptions.NO)
    node, twin = (rclpy.create_node(name, context=context) for name in ('vrpn', 'sim_node'))

    def publisher(kind, topic, qos=SENSOR, of=node):
        return of.create_publisher(kind, topic, wire.profile(qos))

    mocap, _, imu, _, joints, state, diagnostics = (
        publisher(PoseStamped, 'mocap/pose'), publisher(PoseStamped, 'mocap/pose', of=twin),
        publisher(Imu, 'imu/data_raw'), publisher(String, 'battery_state'),
        publisher(JointState, 'joint_states'), publisher(String, 'joint_bridge/state', LATCHED),
        publisher(DiagnosticArray, 'diagnostics', EVENT))
    state.publish(String(data='ready'))

    def run():
        k, due = 0, time.monotonic()
        while not stop.is_set():
            now = time.time()
            imu.publish(wire.serialized('imu/data_raw', ImuReading(
                now + 0.05, np.array([0, 0, 9.81]) + 0.01 * rng.normal(size=3), np.zeros(3))))
            if k % 2 == 0:
                mocap.publish(wire.serialized('mocap/pose', PoseReading(
                    now - 0.008, rng.normal(size=3), UPRIGHT)))
                joints.publish(JointState(name=['gimbal1'], position=[0.0]))
            if k % 100 == 0:
                diagnostics.publish(DiagnosticArray(status=[DiagnosticStatus(
                    level=DiagnosticStatus.ERROR, name='joint_bridge_node: gimbal2',
                    message='overload', values=[KeyValue(key='voltage', value='11.9')])]))
            k, due = k + 1, due + 0.005
            time.sleep(max(0.0, due - time.monotonic()))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield
    stop.set()
    thread.join()
    twin.destroy_node()
    node.destroy_node()
    context.try_shutdown()


def test_messages_of_real_publishers_are_recorded_and_checked(ros_domain):
    with drivers(ros_domain):
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
    assert graph.states == {'joint_bridge': 'ready'}
    failed = {finding.item for finding in check_topics(graph, RobotParameters.load().gravity)
              if finding.level == 'fail'}
    assert failed >= {'imu/data_raw age', 'mocap/pose publishers', 'joint_states content',
                      'joint_bridge gimbal2'}
