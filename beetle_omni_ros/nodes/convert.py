"""
Messages to the core's dataclasses and back.

Every scalar that goes into a message passes through ``float``: a wrong Python type in
a float field would be serialised as garbage without a word. What comes in is checked
for shape and finiteness here, once, and refused with :class:`MessageError`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, isnan

from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    PoseStamped,
    Quaternion,
    Vector3,
    WrenchStamped,
)
from nav_msgs.msg import Odometry
import numpy as np
from sensor_msgs.msg import BatteryState, Imu, JointState

from beetle_omni_ros.control.base import Command, State
from beetle_omni_ros.estimation.samples import ImuSample, PoseSample
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.actuator_health import ActuatorHealth
from beetle_omni_ros.robot.parameters import JOINT_NAMES, ROTOR_NAMES

WORLD, BODY = 'world', 'base_link'
COMMAND_NAMES = [*JOINT_NAMES, *ROTOR_NAMES]
HEALTH_NAMES = [*COMMAND_NAMES, *(f'{name}_zero' for name in JOINT_NAMES)]
NO_VALUE = [float('nan')] * 4
# A quaternion further from unit length than this is a broken message, not a rounded one.
UNIT_TOLERANCE = 0.01


class MessageError(ValueError):
    """
    A message cannot be used; the text says why.

    Attributes:
        kind: under which it is counted: one of a few, where the text holds numbers or names.

    """

    def __init__(self, text: str, kind: str = ''):
        """Count under ``kind``, or under the text itself."""
        super().__init__(text)
        self.kind = kind or text


@dataclass(frozen=True)
class Joints:
    """Measured tilt joints: capture time [s], (4,) angles [rad], (4,) rates [rad/s]."""

    stamp: float
    position: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True)
class Battery:
    """Pack voltage under load [V] and current [A, negative when discharging]."""

    stamp: float
    voltage: float
    current: float


@dataclass(frozen=True)
class RotorSpeeds:
    """Speeds of the rotors by their ESCs (4,) [rad/s]; NaN unknown."""

    stamp: float
    speed: np.ndarray


@dataclass(frozen=True)
class ToldHealth:
    """Which actuators work, by the supervisor."""

    stamp: float
    health: ActuatorHealth


@dataclass(frozen=True)
class Wrench:
    """External force in world (3,) [N] and torque in base_link (3,) [N m]."""

    stamp: float
    force: np.ndarray
    torque: np.ndarray


@dataclass(frozen=True)
class Odom:
    """Pose in world and velocities as :class:`State` has them (linear world, angular body)."""

    stamp: float
    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    angular_velocity: np.ndarray


def seconds(stamp: Time) -> float:
    """Time message to seconds."""
    return stamp.sec + stamp.nanosec * 1e-9


def time_message(stamp: float) -> Time:
    """Seconds to a time message, rounded to a nanosecond."""
    nanoseconds = max(0, round(stamp * 1e9))
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def imu_sample(message: Imu) -> ImuSample:
    """Read one IMU message."""
    return ImuSample(seconds(message.header.stamp),
                     finite(xyz(message.linear_acceleration), 'linear_acceleration'),
                     finite(xyz(message.angular_velocity), 'angular_velocity'))


def imu_message(sample) -> Imu:
    """Write one IMU reading (REP-145: no orientation)."""
    message = Imu()
    _header(message, sample.stamp, BODY)
    message.orientation_covariance[0] = -1.0
    message.linear_acceleration = vector(sample.specific_force)
    message.angular_velocity = vector(sample.angular_velocity)
    return message


def pose_sample(message: PoseStamped) -> PoseSample:
    """Read one motion-capture pose; the estimator judges the quaternion by its own tolerance."""
    return PoseSample(seconds(message.header.stamp),
                      finite(xyz(message.pose.position), 'position'),
                      finite(xyzw(message.pose.orientation), 'orientation'))


def pose_message(stamp: float, position: np.ndarray, rotation: np.ndarray) -> PoseStamped:
    """Write one pose in world."""
    message = PoseStamped()
    _header(message, stamp, WORLD)
    _set_pose(message.pose, position, rotation)
    return message


def odometry_message(stamp, position, velocity, rotation, angular_velocity,
                     pose_covariance=None, twist_covariance=None) -> Odometry:
    """
    Write an odometry message.

    Args:
        stamp: time [s].
        position: (3,) in world [m].
        velocity: (3,) in world [m/s]; the message carries it in base_link.
        rotation: (4,) body to world.
        angular_velocity: (3,) in base_link [rad/s].
        pose_covariance: (6, 6) of position (world) and small rotation (world axes), or None.
        twist_covariance: (6, 6) of the twist in base_link, or None.

    """
    message = Odometry()
    _header(message, stamp, WORLD)
    message.child_frame_id = BODY
    _set_pose(message.pose.pose, position, rotation)
    message.twist.twist.linear = vector(rotations.matrix(rotation).T @ velocity)
    message.twist.twist.angular = vector(angular_velocity)
    if pose_covariance is not None:
        message.pose.covariance = np.ascontiguousarray(pose_covariance, dtype=float).reshape(36)
    if twist_covariance is not None:
        message.twist.covariance = np.ascontiguousarray(twist_covariance, dtype=float).reshape(36)
    return message


def odom(message: Odometry) -> Odom:
    """Read an odometry message into world velocity."""
    position, rotation = checked_pose(message.pose.pose)
    velocity = finite(xyz(message.twist.twist.linear), 'linear velocity')
    rate = finite(xyz(message.twist.twist.angular), 'angular velocity')
    return Odom(seconds(message.header.stamp), position,
                rotations.matrix(rotation) @ velocity, rotation, rate)


def state(estimate: Odom, joints: Joints, command: Command | None) -> State:
    """Join the estimate, the measured joints and the command in force."""
    return State(estimate.stamp, estimate.position, estimate.velocity, estimate.quaternion,
                 estimate.angular_velocity, joints.position, joints.velocity, joints.stamp,
                 command)


def joints(message: JointState) -> Joints:
    """Read the four tilt joints, in whatever order the message names them."""
    order = _order(message.name, JOINT_NAMES)
    position = _values(message.position, order, 'position')
    velocity = _values(message.velocity, order, 'velocity') if len(message.velocity) \
        else np.zeros(4)
    return Joints(seconds(message.header.stamp), finite(position, 'position'),
                  finite(velocity, 'velocity'))


def known_joints(message: JointState) -> Joints:
    """Read those tilt joints that the message names; angle and rate of the others are nan."""
    names = [name for name in JOINT_NAMES if name in message.name]
    order = _order(message.name, names)
    position, velocity = np.full((2, 4), np.nan)
    places = [JOINT_NAMES.index(name) for name in names]
    position[places] = finite(_values(message.position, order, 'position'), 'position')
    velocity[places] = finite(_values(message.velocity, order, 'velocity'), 'velocity') \
        if len(message.velocity) else 0.0
    return Joints(seconds(message.header.stamp), position, velocity)


def joint_message(stamp, position, velocity, effort=(), names=JOINT_NAMES) -> JointState:
    """Write the measured tilt joints, all four or those in ``names``."""
    message = JointState(name=list(names), position=_floats(position),
                         velocity=_floats(velocity), effort=_floats(effort))
    _header(message, stamp, '')
    return message


def command(message: JointState) -> Command:
    """Read a command: four tilt positions and four thrust efforts, NaN where not used."""
    order = _order(message.name, COMMAND_NAMES)
    tilt = _values(message.position, order[:4], 'position')
    thrust = _values(message.effort, order[4:], 'effort')
    return Command(seconds(message.header.stamp), finite(tilt, 'tilt'),
                   finite(thrust, 'thrust'))


def command_message(value: Command, source: str = '') -> JointState:
    """Write a command as INTERFACES lays it out; ``source`` is the publisher's identity."""
    message = JointState(name=COMMAND_NAMES, position=_floats(value.tilt) + NO_VALUE,
                         effort=NO_VALUE + _floats(value.thrust))
    _header(message, value.stamp, source)
    return message


def battery_message(stamp: float, voltage: float, current: float, cells: int) -> BatteryState:
    """Write the pack's voltage [V] and current [A, negative when discharging]."""
    nan = float('nan')
    message = BatteryState(
        voltage=float(voltage), current=float(current), charge=nan, capacity=nan,
        design_capacity=nan, percentage=nan, temperature=nan, present=True,
        power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
        power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_LIPO,
        cell_voltage=[nan] * cells)
    _header(message, stamp, '')
    return message


def rotor_message(stamp: float, speed: np.ndarray) -> JointState:
    """Write the four rotors' speeds [rad/s], positive whatever the spin; NaN unknown."""
    message = JointState(name=list(ROTOR_NAMES), velocity=_floats(speed))
    _header(message, stamp, '')
    return message


def rotors(message: JointState) -> RotorSpeeds:
    """Read the ESCs' speeds."""
    if list(message.name) != list(ROTOR_NAMES) or len(message.velocity) != len(ROTOR_NAMES):
        raise MessageError(f'expected velocities of {list(ROTOR_NAMES)}')
    return RotorSpeeds(seconds(message.header.stamp), np.array(message.velocity, dtype=float))


def health_message(stamp: float, health: ActuatorHealth) -> JointState:
    """
    Write which actuators work.

    Positions: angles of stuck joints, NaN of others, then the encoders' zeros, as if they were
    joints. Efforts: NaN of rotors that obey, 0 of lost ones, else the thrust that one holds.
    """
    stuck = [np.nan if angle is None else float(angle) for angle in health.stuck]
    efforts = [0.0 if not works else np.nan if held is None else float(held)
               for works, held in zip(health.rotors, health.held)]
    message = JointState(name=HEALTH_NAMES,
                         position=[*stuck, *[np.nan] * 4, *map(float, health.zeros)],
                         effort=[*[np.nan] * 4, *efforts, *[np.nan] * 4])
    _header(message, stamp, '')
    return message


def actuator_health(message: JointState) -> ToldHealth:
    """Read which actuators work."""
    if len(message.position) != len(HEALTH_NAMES) or len(message.effort) != len(HEALTH_NAMES):
        raise MessageError('expected four joints, four rotors and four zeros')
    stuck, zeros, efforts = message.position[:4], message.position[8:], message.effort[4:8]
    if any(abs(angle) > np.pi * 2 for angle in stuck) or not all(map(isfinite, zeros)):
        raise MessageError('expected angles within one turn and finite zeros')
    return ToldHealth(seconds(message.header.stamp), ActuatorHealth(
        rotors=tuple(effort != 0 for effort in efforts),
        stuck=tuple(None if isnan(a) else float(a) for a in stuck),
        held=tuple(None if isnan(f) or f == 0 else float(f) for f in efforts),
        zeros=tuple(map(float, zeros))))


def battery(message: BatteryState) -> Battery:
    """Read the pack."""
    if not isfinite(message.voltage):
        raise MessageError('voltage is not finite')
    return Battery(seconds(message.header.stamp), message.voltage, message.current)


def wrench(message: WrenchStamped) -> Wrench:
    """Read an external wrench: force in world, torque in base_link, whatever the frame_id."""
    return Wrench(seconds(message.header.stamp), finite(xyz(message.wrench.force), 'force'),
                  finite(xyz(message.wrench.torque), 'torque'))


def wrench_message(stamp: float, force: np.ndarray, torque: np.ndarray) -> WrenchStamped:
    """Write an external wrench: force in world, torque in base_link."""
    message = WrenchStamped()
    _header(message, stamp, WORLD)
    message.wrench.force = vector(force)
    message.wrench.torque = vector(torque)
    return message


def vector(values) -> Vector3:
    """Three numbers as a message."""
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))


def quaternion(values) -> Quaternion:
    """(x, y, z, w) as a message."""
    return Quaternion(x=float(values[0]), y=float(values[1]), z=float(values[2]),
                      w=float(values[3]))


def _header(message, stamp, frame):
    message.header.stamp = time_message(stamp)
    message.header.frame_id = frame


def _set_pose(pose, position, rotation):
    pose.position = Point(x=float(position[0]), y=float(position[1]), z=float(position[2]))
    pose.orientation = quaternion(rotation)


def checked_pose(pose) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and unit quaternion (4,) of a pose message."""
    return finite(xyz(pose.position), 'position'), unit(xyzw(pose.orientation))


def xyz(v) -> np.ndarray:
    """Three fields as an array."""
    return np.array([v.x, v.y, v.z])


def xyzw(q) -> np.ndarray:
    """Four fields as an array."""
    return np.array([q.x, q.y, q.z, q.w])


def unit(q: np.ndarray) -> np.ndarray:
    """Normalise a quaternion; refuse one that was not meant to be one."""
    norm = float(q @ q) ** 0.5
    if not abs(norm - 1) < UNIT_TOLERANCE:      # catches NaN as well
        raise MessageError('orientation is not a unit quaternion')
    return q / norm


def finite(values: np.ndarray, what: str) -> np.ndarray:
    """Refuse what is not finite."""
    if not np.isfinite(values).all():
        raise MessageError(f'{what} is not finite')
    return values


def _floats(values) -> list[float]:
    return [float(v) for v in values]


def _order(names, wanted):
    if tuple(names) == tuple(wanted):
        return range(len(wanted))
    try:
        return [names.index(name) for name in wanted]
    except ValueError:
        raise MessageError(f"names are not {', '.join(wanted)}") from None


def _values(values, order, what):
    try:
        return np.array([values[k] for k in order], dtype=float)
    except IndexError:
        raise MessageError(f'{what} has {len(values)} values, too few for the names') from None
