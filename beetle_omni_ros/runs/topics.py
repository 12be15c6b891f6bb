"""The topics of a bag: names, types and offered quality of service, as the graph has them."""

from __future__ import annotations

from dataclasses import dataclass

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)


def _qos(depth, reliability=QosReliability.RELIABLE, durability=QosDurability.VOLATILE):
    # rclpy's "infinite" durations, as ros2 bag writes them
    forever = QosTime(9223372036, 854775807)
    return Qos(QosHistory.KEEP_LAST, depth, reliability, durability, forever, forever,
               QosLiveliness.AUTOMATIC, forever, False)


SENSOR = _qos(5, QosReliability.BEST_EFFORT)
COMMAND = _qos(1)
EVENT = _qos(10)
LATCHED = _qos(1, durability=QosDurability.TRANSIENT_LOCAL)


@dataclass(frozen=True)
class Topic:
    """
    One topic.

    Attributes:
        type: ROS message type.
        qos: what its publisher offers.
        required: whether a flight without it is worth a warning.

    """

    type: str
    qos: Qos
    required: bool = False


TOPICS: dict[str, Topic] = {
    'mocap/pose': Topic('geometry_msgs/msg/PoseStamped', SENSOR, True),
    'imu/data_raw': Topic('sensor_msgs/msg/Imu', SENSOR, True),
    'joint_states': Topic('sensor_msgs/msg/JointState', SENSOR, True),
    'battery_state': Topic('sensor_msgs/msg/BatteryState', SENSOR),
    'odom': Topic('nav_msgs/msg/Odometry', COMMAND, True),
    'target_pose': Topic('geometry_msgs/msg/PoseStamped', LATCHED, True),
    'target_trajectory': Topic('trajectory_msgs/msg/MultiDOFJointTrajectory', LATCHED),
    'nmpc/command': Topic('sensor_msgs/msg/JointState', COMMAND),
    'rl/command': Topic('sensor_msgs/msg/JointState', COMMAND),
    'command': Topic('sensor_msgs/msg/JointState', COMMAND, True),
    'ground_truth/odom': Topic('nav_msgs/msg/Odometry', COMMAND),
    'disturbance': Topic('geometry_msgs/msg/WrenchStamped', EVENT),
    'supervisor/state': Topic('std_msgs/msg/String', LATCHED),
    'diagnostics': Topic('diagnostic_msgs/msg/DiagnosticArray', EVENT),
}


def split_topic(topic: str) -> tuple[str, str] | None:
    """
    Take a bag's topic apart.

    Returns:
        (namespace, name in ``TOPICS``): '/robot1/nmpc/command' -> ('/robot1', 'nmpc/command');
        None for a topic that is not one of ours. ``diagnostics`` may also be the global one.

    """
    for name in sorted(TOPICS, key=len, reverse=True):
        if topic == name or topic == '/' + name:
            return '', name
        if topic.endswith('/' + name):
            return topic[:-len(name) - 1], name
    return None
