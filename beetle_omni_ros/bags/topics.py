"""
The table of topics, used by nodes, bags, reports and the reference pages.

A new topic is one entry. Names are relative; a robot may have a namespace.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

from beetle_omni_ros.bags import conversions as c
from beetle_omni_ros.bags.messages import Diagnostic, Wrench
from beetle_omni_ros.control import registry
from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.model.allocation import ActuatorHealth
from beetle_omni_ros.model.body import BodyState
from beetle_omni_ros.model.mode import Mode
from beetle_omni_ros.model.readings import (
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


# Sensors are best effort: a repeated sample would delay the next one. Commands and the estimate
# are offered reliably, so that both kinds of subscription match. States and targets are latched,
# so that a node that starts late, or again, receives them at once.
SENSOR = Qos(5, reliable=False)
COMMAND = ESTIMATE = Qos(1)
EVENT = Qos(10)
LATCHED = Qos(1, latched=True)
# For recorders: matches every publisher, with room for bursts.
LOG = Qos(200, reliable=False)
LATCHED_LOG = Qos(50, latched=True)


@dataclass(frozen=True)
class Topic:
    """
    One topic.

    Attributes:
        name: relative name.
        type: ROS message type.
        qos: quality of service that its publisher offers.
        value: class of its values.
        read: message -> value; MessageError for another layout.
        write: value -> message.
        meaning: description for the reference page.
        finite: attributes that must be finite in flight; `quaternion` must have length 1.
        take: message -> value for use in flight; MessageError for unusable values. Default: read,
            with these checks.
        required: whether a bag without it gets a warning.
        in_flight: whether every bag declares it.

    """

    name: str = field(compare=False)    # command topics of two controllers are equal otherwise
    type: str
    qos: Qos
    value: type
    read: Callable[[Any], Any]
    write: Callable[[Any], Any]
    meaning: str
    finite: tuple[str, ...] = ()
    take: Callable[[Any], Any] = None
    required: bool = False
    in_flight: bool = True

    def __post_init__(self):
        if self.take is None:
            object.__setattr__(self, 'take', partial(_checked, self.read, self.finite))


def _checked(read, names, message):
    value = read(message)
    for name in names:
        c.finite(getattr(value, name), name)
    if 'quaternion' in names:
        c.unit(value.quaternion)
    return value


def _text(name, meaning, in_flight=False):
    return Topic(name, 'std_msgs/msg/String', LATCHED, str, c.read_text, c.write_text, meaning,
                 in_flight=in_flight)


def _command(name, meaning, required=False):
    return Topic(name, c.JOINT_STATE, COMMAND, Command, c.read_command, c.write_command, meaning,
                 ('tilt', 'thrust'), required=required)


def _odom(name, meaning, required=False):
    return Topic(name, 'nav_msgs/msg/Odometry', ESTIMATE, BodyState, c.read_odom, c.write_odom,
                 meaning, ('position', 'velocity', 'quaternion', 'angular_velocity'),
                 required=required)


def command_topic(controller: str) -> Topic:
    """Return the command topic of a controller."""
    return _command(f'{controller}/command', 'command of a controller, before the supervisor')


TABLE = (
    Topic('mocap/pose', c.POSE, SENSOR, PoseReading, c.read_pose, c.write_pose,
          'pose of base_link in world, stamped at capture, 100 Hz', ('position', 'quaternion'),
          required=True),
    Topic('imu/data_raw', 'sensor_msgs/msg/Imu', SENSOR, ImuReading, c.read_imu, c.write_imu,
          'specific force and angular rate in base_link, without orientation (REP-145), 200 Hz',
          ('specific_force', 'angular_velocity'), required=True),
    Topic('joint_states', c.JOINT_STATE, SENSOR, JointReading, c.read_joints, c.write_joints,
          'position, velocity and effort of `gimbal1..4`', take=c.take_joints, required=True),
    Topic('battery_state', 'sensor_msgs/msg/BatteryState', SENSOR, BatteryReading, c.read_battery,
          c.write_battery, 'pack voltage and current, negative when discharging', ('voltage',)),
    Topic('rotor_states', c.JOINT_STATE, SENSOR, RotorReading, c.read_rotors, c.write_rotors,
          '`velocity` of `rotor1..4` [rad/s], positive for both spins, NaN where unknown',
          in_flight=False),
    _odom('odom', 'estimate: pose in world, twist in base_link, both covariances', required=True),
    Topic('target_pose', c.POSE, LATCHED, PoseTarget, c.read_pose_target, c.write_pose_target,
          'target pose in world; `reference_node` or a user publishes it', required=True),
    Topic('target_trajectory', c.TRAJECTORY, LATCHED, TrajectoryTarget, c.read_trajectory,
          c.write_trajectory,
          'time-parameterised reference; `reference_node` or a user publishes it'),
    *map(command_topic, registry.STANDING_BY),      # topic_of() makes those of other controllers
    _command('command', 'selected and checked command, which the actuators execute', True),
    _text('supervisor/identity',
          'identity of the supervisor; the actuators execute commands with this identity only'),
    Topic('supervisor/target', c.TRAJECTORY, LATCHED, TrajectoryTarget, c.read_override,
          c.write_override,
          'target of the supervisor, which replaces that of the operator; without points: no '
          'replacement', in_flight=False),
    Topic('supervisor/actuators', 'std_msgs/msg/String', LATCHED, ActuatorHealth, c.read_health,
          c.write_health, 'health of joints and rotors as JSON: the fields of `ActuatorHealth`',
          in_flight=False),
    _text('reference/state', '`waiting`, `flying 3/15`, `done`, `done: control lost at level 60`, '
          'or `aborted` if the flight ended before the task'),
    _text('joint_bridge/state', '`ready`, `waiting: WHY` or `lost: WHY`'),
    _text('rotor_bridge/state', '`ready`, `waiting: WHY`, `silent: WHY` or `lost: WHY`'),
    _odom('ground_truth/odom', 'true state of the simulated robot'),
    Topic('disturbance', 'geometry_msgs/msg/WrenchStamped', EVENT, Wrench, c.read_wrench,
          c.write_wrench,
          'external wrench on the simulated robot until the next message: force in world, torque '
          'in base_link; a user or an experiment publishes it', ('force', 'torque')),
    Topic('supervisor/state', 'std_msgs/msg/String', LATCHED, Mode, c.read_mode, c.write_text,
          'state, a colon, and the active controller or the last fault'),
    Topic('diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', EVENT, Diagnostic,
          c.read_diagnostics, c.write_diagnostics,
          'health, rates, ages, timing and faults of each node'),
)
TARGETS = ('target_pose', 'target_trajectory')      # received with any quality of service
ALL: dict[str, Topic] = {topic.name: topic for topic in TABLE}
TOPICS: dict[str, Topic] = {topic.name: topic for topic in TABLE if topic.in_flight}
"""Topics that every bag declares, with the commands of the standby controllers."""
# Not of a robot alone: /NAME/command may be of a controller, and other programs have the others.
TELLING = TOPICS.keys() - {'command', 'diagnostics', 'odom'}
"""Topics that determine the namespace of a robot in a bag."""


def register(topic: Topic) -> None:
    """Add a topic of a component of others to the table, in this process."""
    ALL[topic.name] = topic


def topic_like(known: str, name: str, meaning: str) -> Topic:
    """Return a topic with the type and values of a known one."""
    return replace(topic_of(known), name=name, meaning=meaning, required=False, in_flight=False)


def topics_with(controllers: Iterable[str]) -> dict[str, Topic]:
    """Return name -> topic of a flight with these controllers."""
    return {**TOPICS, **{topic.name: topic for topic in map(command_topic, controllers)}}


def controller_of(name: str) -> str:
    """Return the controller of a topic '<controller>/command'; '' for any other name."""
    controller, _, rest = name.partition('/')
    return controller if rest == 'command' else ''


def topic_of(name: str) -> Topic:
    """Return the topic of a name without namespace; KeyError for an unknown one."""
    controller = controller_of(name)
    return command_topic(controller) if controller and name not in ALL else ALL[name]
