"""The topics of a bag: names, types and offered quality of service, as the graph has them."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from beetle_omni_ros.control import registry


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


REQUEST = Topic('sensor_msgs/msg/JointState', COMMAND)     # `<controller>/command`

# Those of the controllers that stand by; topic_of() knows any controller's.
TOPICS: dict[str, Topic] = {
    'mocap/pose': Topic('geometry_msgs/msg/PoseStamped', SENSOR, True),
    'imu/data_raw': Topic('sensor_msgs/msg/Imu', SENSOR, True),
    'joint_states': Topic('sensor_msgs/msg/JointState', SENSOR, True),
    'battery_state': Topic('sensor_msgs/msg/BatteryState', SENSOR),
    'odom': Topic('nav_msgs/msg/Odometry', COMMAND, True),
    'target_pose': Topic('geometry_msgs/msg/PoseStamped', LATCHED, True),
    'target_trajectory': Topic('trajectory_msgs/msg/MultiDOFJointTrajectory', LATCHED),
    **{f'{name}/command': REQUEST for name in registry.standing_by()},
    'command': Topic('sensor_msgs/msg/JointState', COMMAND, True),
    'ground_truth/odom': Topic('nav_msgs/msg/Odometry', COMMAND),
    'disturbance': Topic('geometry_msgs/msg/WrenchStamped', EVENT),
    'supervisor/state': Topic('std_msgs/msg/String', LATCHED),
    'diagnostics': Topic('diagnostic_msgs/msg/DiagnosticArray', EVENT),
}


def topics_with(controllers: Iterable[str]) -> dict[str, Topic]:
    """Name -> topic of a graph with these controllers, by their names."""
    return {**TOPICS, **{f'{name}/command': REQUEST for name in controllers}}


def requester(name: str) -> str:
    """Controller of a topic '<controller>/command'; '' for any other name."""
    controller, _, rest = name.partition('/')
    return controller if rest == 'command' else ''


def topic_of(name: str) -> Topic:
    """
    Topic of a name without namespace.

    Raises:
        KeyError: it is none of ours.

    """
    return REQUEST if requester(name) else TOPICS[name]


def is_ambiguous(topic: str) -> bool:
    """Whether '/name/command' may be a controller's or a robot's, as nobody knows ``name``."""
    _, _, name = topic.removesuffix('/command').rpartition('/')
    return topic.endswith('/command') and bool(name) and name not in registry.names()


def split_topic(topic: str, namespaces: Container[str] = ()) -> tuple[str, str] | None:
    """
    Take a bag's topic apart.

    Args:
        topic: full name.
        namespaces: of the robots that are known to be in the bag, as '' or '/robot1'. Without,
            '/name/command' is a controller's where one of that name is registered, else the
            command of a robot in '/name'.

    Returns:
        (namespace, name): '/robot1/nmpc/command' -> ('/robot1', 'nmpc/command');
        None for a topic that is not one of ours. ``diagnostics`` may also be the global one.

    """
    space, _, last = topic.rpartition('/')
    if last == 'command':
        above, _, controller = space.rpartition('/')
        is_one = above in namespaces and space not in namespaces or controller in registry.names()
        if controller and is_one:
            return above, f'{controller}/command'
    for name in sorted(TOPICS, key=len, reverse=True):
        if topic == name or topic == '/' + name:
            return '', name
        if topic.endswith('/' + name):
            return topic[:-len(name) - 1], name
    return None
