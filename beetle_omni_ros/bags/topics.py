"""
The table of topics, used by nodes, bags, reports and the reference pages.

A new topic is one entry. Names are relative; a robot may have a namespace.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from beetle_omni_ros.bags import conversions as form
from beetle_omni_ros.control import registry
from beetle_omni_ros.model.schema import unknown


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
    """One topic."""

    name: str = field(compare=False)    # relative; command topics are equal otherwise
    qos: Qos            # quality of service that its publisher offers
    meaning: str        # description for the reference page
    type: str           # this and the next four: as of :data:`.conversions.Form`
    value: type
    read: Callable[[Any], Any]
    write: Callable[[Any], Any]
    take: Callable[[Any], Any]
    required: bool = False      # whether a bag without it gets a warning


def _topic(name, of, qos, meaning, **options):
    return Topic(name, qos, meaning, *of, **options)


def command_topic(controller: str) -> Topic:
    """Return the command topic of a controller."""
    return _topic(f'{controller}/command', form.COMMAND, COMMAND,
                  'command of a controller, before the supervisor')


TABLE = (
    _topic('mocap/pose', form.POSE, SENSOR,
           'pose of base_link in world, stamped at capture, 100 Hz', required=True),
    _topic('imu/data_raw', form.IMU, SENSOR, 'specific force and angular rate in base_link, '
           'without orientation (REP-145), 200 Hz', required=True),
    _topic('joint_states', form.JOINT, SENSOR, 'position, velocity and effort of `gimbal1..4`',
           required=True),
    _topic('battery_state', form.BATTERY, SENSOR,
           'pack voltage and current, negative when discharging'),
    _topic('rotor_states', form.ROTOR, SENSOR, '`velocity` of `rotor1..4` [rad/s], positive for '
           'both spins, NaN where unknown'),
    _topic('odom', form.ODOM, ESTIMATE,
           'estimate: pose in world, twist in base_link, both covariances', required=True),
    _topic('target_pose', form.POSE_TARGET, LATCHED,
           'target pose in world; `reference_node` or a user publishes it', required=True),
    _topic('target_trajectory', form.TRAJECTORY, LATCHED,
           'time-parameterised reference; `reference_node` or a user publishes it'),
    *map(command_topic, registry.STANDING_BY),      # topic_of() makes those of other controllers
    _topic('command', form.COMMAND, COMMAND,
           'selected and checked command, which the actuators execute', required=True),
    _topic('supervisor/identity', form.TEXT, LATCHED, 'identity of the supervisor; the actuators '
           'execute commands with this identity only'),
    _topic('supervisor/target', form.OVERRIDE, LATCHED, 'target of the supervisor, which replaces '
           'that of the operator; without points: no replacement'),
    _topic('supervisor/actuators', form.HEALTH, LATCHED,
           'health of joints and rotors as JSON: the fields of `ActuatorHealth`'),
    _topic('reference/state', form.TEXT, LATCHED,
           '`waiting`, `flying 3/15`, `done`, `done: control lost at level 60`, or `aborted` if '
           'the flight ended before the task'),
    _topic('joint_bridge/state', form.TEXT, LATCHED, '`ready`, `waiting: WHY` or `lost: WHY`'),
    _topic('rotor_bridge/state', form.TEXT, LATCHED,
           '`ready`, `waiting: WHY`, `silent: WHY` or `lost: WHY`'),
    _topic('ground_truth/odom', form.ODOM, ESTIMATE, 'true state of the simulated robot'),
    _topic('disturbance', form.WRENCH, EVENT, 'external wrench on the simulated robot until the '
           'next message: force in world, torque in base_link; a user or an experiment publishes '
           'it'),
    _topic('supervisor/state', form.MODE, LATCHED,
           'state, a colon, and the active controller or the last fault'),
    _topic('diagnostics', form.DIAGNOSTICS, EVENT,
           'health, rates, ages, timing and faults of each node'),
)
TARGETS = ('target_pose', 'target_trajectory')      # received with any quality of service
ALL: dict[str, Topic] = {topic.name: topic for topic in TABLE}
"""Topics that every bag declares, with those of components of others."""
# Not of a robot alone: /NAME/command may be of a controller, and other programs have the others.
TELLING = ALL.keys() - {'command', 'diagnostics', 'odom', 'rotor_states'}
"""Topics that determine the namespace of a robot in a bag."""


def register(topic: Topic) -> None:
    """Add a topic of a component of others to the table, in this process."""
    ALL[topic.name] = topic


def topic_like(known: str, name: str, meaning: str) -> Topic:
    """Return a topic with the type and values of a known one."""
    return replace(topic_of(known), name=name, meaning=meaning, required=False)


def topics_with(controllers: Iterable[str]) -> dict[str, Topic]:
    """Return name -> topic of a flight with these controllers."""
    return {**ALL, **{topic.name: topic for topic in map(command_topic, controllers)}}


def controller_of(name: str) -> str:
    """Return the controller of a topic '<controller>/command'; '' for any other name."""
    controller, _, rest = name.partition('/')
    return controller if rest == 'command' else ''


def topic_of(name: str) -> Topic:
    """Return the topic of a name without namespace; ParameterError for an unknown one."""
    controller = controller_of(name)
    if name not in ALL and not controller:
        raise unknown(f"topic '{name}'", 'topic', name, ALL)
    return ALL[name] if name in ALL else command_topic(controller)
