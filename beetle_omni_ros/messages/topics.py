"""
The topics: one table from which nodes, bags, reports and the reference pages take them.

A new topic is one entry. Names are relative; a robot may have a namespace.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages import conversions as c
from beetle_omni_ros.messages.values import Diagnostic, Odom, ToldHealth, Wish, Wrench
from beetle_omni_ros.robot.readings import (
    BatteryReading,
    ImuReading,
    JointReading,
    PoseReading,
    RotorReading,
)


class Qos(NamedTuple):
    """Quality of service that a publisher offers; the history keeps the last ``depth``."""

    depth: int
    reliable: bool = True
    latched: bool = False


# Sensors are best effort: a late sample is worth less than the next one. Commands and the
# estimate are offered reliably, so that both kinds of subscriber match them. State and
# targets are latched, so that a node that starts late, or again, knows them at once.
SENSOR = Qos(5, reliable=False)
COMMAND = ESTIMATE = Qos(1)
EVENT = Qos(10)
LATCHED = Qos(1, latched=True)
# For a recorder: whatever the publisher offers matches, and bursts fit.
LOG = Qos(200, reliable=False)
LATCHED_LOG = Qos(50, latched=True)


@dataclass(frozen=True)
class Topic:
    """
    One topic.

    Attributes:
        name: relative.
        type: ROS message type.
        qos: what its publisher offers.
        value: class of the values in it.
        read: message -> value as it stands; MessageError where the layout is another.
        write: (kind of message classes, value) -> message.
        meaning: for the reference page.
        take: message -> value that can be flown with; MessageError where it cannot.
        required: whether a flight without it is worth a warning.
        in_flight: whether every bag declares it; the others are told by nodes to each other.

    """

    name: str = field(compare=False)    # two controllers' requests are of one kind
    type: str
    qos: Qos
    value: type
    read: Callable[[Any], Any]
    write: Callable[[c.Kind, Any], Any]
    meaning: str
    take: Callable[[Any], Any] | None = None
    required: bool = False
    in_flight: bool = True

    def __post_init__(self):
        """Fly with what is read, unless there is more to check."""
        if self.take is None:
            object.__setattr__(self, 'take', self.read)


POSE, JOINT_STATE = 'geometry_msgs/msg/PoseStamped', 'sensor_msgs/msg/JointState'
TRAJECTORY = 'trajectory_msgs/msg/MultiDOFJointTrajectory'


def _text(name, meaning, in_flight=False):
    return Topic(name, 'std_msgs/msg/String', LATCHED, str, c.read_text, c.write_text, meaning,
                 in_flight=in_flight)


def request(controller: str) -> Topic:
    """What a controller asks for."""
    return Topic(f'{controller}/command', JOINT_STATE, COMMAND, Command, c.read_command,
                 c.write_command, 'command that a controller asks for, under its own name',
                 c.take_command)


TABLE = (
    Topic('mocap/pose', POSE, SENSOR, PoseReading, c.read_pose, c.write_pose,
          'pose of base_link in world, stamped at capture, 100 Hz', c.take_pose, required=True),
    Topic('imu/data_raw', 'sensor_msgs/msg/Imu', SENSOR, ImuReading, c.read_imu, c.write_imu,
          'specific force and angular rate in base_link, without orientation (REP-145), 200 Hz',
          c.take_imu, required=True),
    Topic('joint_states', JOINT_STATE, SENSOR, JointReading, c.read_joints, c.write_joints,
          'position, velocity and effort of `gimbal1..4`', c.take_joints, required=True),
    Topic('battery_state', 'sensor_msgs/msg/BatteryState', SENSOR, BatteryReading, c.read_battery,
          c.write_battery, 'pack voltage and current, negative when discharging', c.take_battery),
    Topic('rotor_states', JOINT_STATE, SENSOR, RotorReading, c.read_rotors, c.write_rotors,
          '`velocity` of `rotor1..4` [rad/s], positive for both spins, NaN where unknown',
          in_flight=False),
    Topic('odom', 'nav_msgs/msg/Odometry', ESTIMATE, Odom, c.read_odom, c.write_odom,
          'estimate: pose in world, twist in base_link, both covariances', c.take_odom,
          required=True),
    Topic('target_pose', POSE, LATCHED, PoseTarget, c.read_pose_target, c.write_pose,
          'target pose in world; `reference_node` or a user publishes it', c.take_pose_target,
          required=True),
    Topic('target_trajectory', TRAJECTORY, LATCHED, TrajectoryTarget, c.read_trajectory,
          c.write_trajectory,
          'time-parameterised reference; `reference_node` or a user publishes it',
          c.take_trajectory),
    *map(request, registry.standing_by()),      # topic_of() knows any controller's
    Topic('command', JOINT_STATE, COMMAND, Command, c.read_command, c.write_command,
          'the selected and checked command that the actuators execute', c.take_command,
          required=True),
    _text('supervisor/identity',
          'identity of the supervisor; actuators obey its commands alone'),
    Topic('supervisor/target', TRAJECTORY, LATCHED, Wish, c.take_wish, c.write_wish,
          'what controllers fly to in place of the target of the operator; nothing where it has '
          'no points', in_flight=False),
    Topic('supervisor/actuators', JOINT_STATE, LATCHED, ToldHealth, c.read_health, c.write_health,
          '`gimbal1..4`, `rotor1..4`, `gimbal1_zero..4_zero`: `position` holds true angles of '
          'stuck joints (NaN: the joint moves) and the zeros of encoders that jumped, reading '
          'minus true tilt; `effort` is NaN for a rotor that obeys, 0 for a lost one, else the '
          'thrust that it holds', in_flight=False),
    _text('reference/state', '`waiting`, `flying 3/15`, `done`, `done: control lost at level 60`, '
          'or `aborted` when the flight ended before the task'),
    _text('joint_bridge/state', '`ready`, `waiting: WHY` or `lost: WHY`'),
    _text('rotor_bridge/state', '`ready`, `waiting: WHY`, `silent: WHY` or `lost: WHY`'),
    Topic('ground_truth/odom', 'nav_msgs/msg/Odometry', ESTIMATE, Odom, c.read_odom, c.write_odom,
          'the simulated truth', c.take_odom),
    Topic('disturbance', 'geometry_msgs/msg/WrenchStamped', EVENT, Wrench, c.read_wrench,
          c.write_wrench, 'external wrench on the simulated robot until the next message: force '
          'in world, torque in base_link; a user or an experiment publishes it', c.take_wrench),
    _text('supervisor/state', 'state, a colon, and the active controller or the last fault',
          in_flight=True),
    Topic('diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', EVENT, Diagnostic,
          c.read_diagnostics, c.write_diagnostics,
          'health, rates, ages, timing and faults of each node'),
)
ALL: dict[str, Topic] = {topic.name: topic for topic in TABLE}
TOPICS: dict[str, Topic] = {topic.name: topic for topic in TABLE if topic.in_flight}
"""Those that every bag declares, with the requests of the controllers that stand by."""


def topics_with(controllers: Iterable[str]) -> dict[str, Topic]:
    """Name -> topic of a flight with these controllers, by their names."""
    return {**TOPICS, **{topic.name: topic for topic in map(request, controllers)}}


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
    known = ALL.get(name)
    if known is None and requester(name):
        return request(requester(name))
    return ALL[name] if known is None else known


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
        None for a topic that no flight has. ``diagnostics`` may also be the global one.

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
