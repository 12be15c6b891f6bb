"""
Conversion between messages and values, by attribute access only.

``read_*`` converts a message of rclpy, of a bag, or of :mod:`~beetle_omni_ros.messages.columns`.
The numbers of the latter are arrays over N messages, so vectors have the shape (N, 3).
``take_*`` converts one message for use in flight and raises MessageError for unusable values.
``write_*`` makes a message by a :class:`MessageFactory`. Scalars are converted to ``float``,
because ROS serialises another Python type in a float field as garbage without an error.
"""

from collections.abc import Callable, Sequence
from math import floor, isfinite, isnan
from typing import Any, Protocol, TypeVar

import numpy as np

from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.messages.values import (
    Diagnostic,
    HealthReport,
    MessageError,
    Odom,
    TargetOverride,
    Wrench,
)
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.allocation import ActuatorHealth
from beetle_omni_ros.robot.parameters import JOINT_NAMES, ROTOR_NAMES
from beetle_omni_ros.robot.readings import (
    BatteryReading,
    ImuReading,
    JointReading,
    PoseReading,
    RotorReading,
)

WORLD, BODY = 'world', 'base_link'
JOINTS, ROTORS = list(JOINT_NAMES), list(ROTOR_NAMES)
COMMAND_NAMES = [*JOINTS, *ROTORS]
HEALTH_NAMES = [*COMMAND_NAMES, *(f'{name}_zero' for name in JOINT_NAMES)]
NO_VALUE = [float('nan')] * 4
UNIT_TOLERANCE = 0.01   # of a quaternion's length; above the rounding of any publisher
POINTS = 10_000     # of a trajectory: 100 s at 100 Hz; more would block the reading node


Value = TypeVar('Value')


class MessageFactory(Protocol):
    """Constructors of messages, for the message classes of rclpy or of bags."""

    def new(self, name: str) -> Any:
        """Make a message with default values from its ROS type."""

    def doubles(self, values: Sequence[float] | np.ndarray) -> Any:
        """Return the value of a field ``float64[]``."""

    def singles(self, values: Sequence[float]) -> Any:
        """Return the value of a field ``float32[]``."""

    def byte(self, value: int) -> Any:
        """Return the value of a field ``byte``."""


# --- times, vectors, names ----------------------------------------------------------------------

def nanoseconds(t: float) -> int:
    """Convert seconds to integer nanoseconds; whole seconds separately, to keep every bit."""
    whole = floor(t)
    return whole * 1_000_000_000 + round((t - whole) * 1e9)


def from_nanoseconds(time: Any) -> Any:
    """Convert integer nanoseconds, or an array of them, to seconds."""
    whole, rest = divmod(time, 1_000_000_000)
    return whole + rest * 1e-9


def seconds(time: Any) -> float:
    """Convert a time or duration message to seconds."""
    return time.sec + time.nanosec * 1e-9


def set_time(time: Any, t: float) -> None:
    """Fill a time message; a negative time becomes 0."""
    time.sec, time.nanosec = divmod(max(0, nanoseconds(t)), 1_000_000_000)


def xyz(v: Any) -> np.ndarray:
    """Return the three fields as an array (3,) or (N, 3)."""
    return np.array([v.x, v.y, v.z]).T


def xyzw(q: Any) -> np.ndarray:
    """Return the four fields as an array (4,) or (N, 4)."""
    return np.array([q.x, q.y, q.z, q.w]).T


def set_xyz(v: Any, values: Sequence[float] | np.ndarray) -> None:
    """Fill three fields."""
    v.x, v.y, v.z = float(values[0]), float(values[1]), float(values[2])


def set_xyzw(q: Any, values: Sequence[float] | np.ndarray) -> None:
    """Fill four fields."""
    q.x, q.y, q.z, q.w = float(values[0]), float(values[1]), float(values[2]), float(values[3])


def finite(values: np.ndarray, what: str) -> np.ndarray:
    """Return the values; MessageError if one is not finite."""
    if not np.isfinite(values).all():
        raise MessageError(f'{what} is not finite')
    return values


def unit(q: np.ndarray, low: float = 1 - UNIT_TOLERANCE,
         high: float = 1 + UNIT_TOLERANCE) -> np.ndarray:
    """Normalise a quaternion; MessageError if its length is outside (low, high)."""
    norm = float(q @ q) ** 0.5
    if not low < norm < high:      # catches NaN as well
        raise MessageError('orientation is not a unit quaternion')
    return q / norm


def _begin(factory, name, stamp, frame=''):
    message = factory.new(name)
    set_time(message.header.stamp, stamp)
    message.header.frame_id = frame
    return message


def _set_pose(pose, position, quaternion):
    set_xyz(pose.position, position)
    set_xyzw(pose.orientation, quaternion)


def _order(names, wanted):
    if names == wanted:
        return range(len(wanted))
    try:
        return [names.index(name) for name in wanted]
    except ValueError:
        raise MessageError(f"names are not {', '.join(wanted)}") from None


def _values(values, order, what):
    try:
        return np.array([values[k] for k in order], dtype=float).T
    except IndexError:
        raise MessageError(f'{what} has {len(values)} values, too few for the names') from None


def _floats(values):
    return [float(v) for v in values]


def _take_finite(read: Callable[[Any], Value], **names: str) -> Callable[[Any], Value]:
    """Make ``take_*`` of ``read_*``: refuse non-finite attributes, by their names in messages."""
    def take(message: Any) -> Value:
        value = read(message)
        for attribute, name in names.items():
            finite(getattr(value, attribute), name)
        return value

    return take


# --- sensors ------------------------------------------------------------------------------------

def read_imu(message: Any) -> ImuReading:
    """Read specific force and angular rates."""
    return ImuReading(seconds(message.header.stamp), xyz(message.linear_acceleration),
                     xyz(message.angular_velocity))


take_imu = _take_finite(read_imu, specific_force='linear_acceleration',
                        angular_velocity='angular_velocity')


def write_imu(factory: MessageFactory, value: ImuReading) -> Any:
    """Write specific force and angular rates, without orientation (REP-145)."""
    message = _begin(factory, 'sensor_msgs/msg/Imu', value.stamp, BODY)
    message.orientation.w = 1.0
    message.orientation_covariance[0] = -1.0
    set_xyz(message.linear_acceleration, value.specific_force)
    set_xyz(message.angular_velocity, value.angular_velocity)
    return message


def read_pose(message: Any) -> PoseReading:
    """Read a pose of base_link in world."""
    return PoseReading(seconds(message.header.stamp), xyz(message.pose.position),
                      xyzw(message.pose.orientation))


# The estimator checks the length of the quaternion.
take_pose = _take_finite(read_pose, position='position', quaternion='orientation')


def write_pose(factory: MessageFactory, value: PoseReading | PoseTarget) -> Any:
    """Write a measured pose or a pose target."""
    message = _begin(factory, 'geometry_msgs/msg/PoseStamped', value.stamp, WORLD)
    _set_pose(message.pose, value.position, value.quaternion)
    return message


def read_joints(message: Any) -> JointReading:
    """Read the four tilt joints, in any order of names."""
    order = _order(message.name, JOINTS)
    return JointReading(
        seconds(message.header.stamp), _values(message.position, order, 'position'),
        _values(message.velocity, order, 'velocity') if len(message.velocity) else None,
        _values(message.effort, order, 'effort') if len(message.effort) else None)


def take_joints(message: Any) -> JointReading:
    """Read the four tilt joints for flight; missing rates are 0."""
    order = _order(message.name, JOINTS)
    position = _values(message.position, order, 'position')
    velocity = _values(message.velocity, order, 'velocity') if len(message.velocity) \
        else np.zeros(4)
    return JointReading(seconds(message.header.stamp), finite(position, 'position'),
                  finite(velocity, 'velocity'))


def take_known_joints(message: Any) -> JointReading:
    """Read the tilt joints that the message contains; angle and rate of the others are NaN."""
    places = [k for k, name in enumerate(JOINTS) if name in message.name]
    order = _order(message.name, [JOINTS[k] for k in places])
    position, velocity = np.full((2, 4), np.nan)
    position[places] = finite(_values(message.position, order, 'position'), 'position')
    velocity[places] = finite(_values(message.velocity, order, 'velocity'), 'velocity') \
        if len(message.velocity) else 0.0
    return JointReading(seconds(message.header.stamp), position, velocity)


def write_joints(factory: MessageFactory, value: JointReading) -> Any:
    """Write the joints that the value names."""
    message = _begin(factory, 'sensor_msgs/msg/JointState', value.stamp)
    message.name = list(value.names)
    message.position = factory.doubles(value.position)
    if value.velocity is not None:
        message.velocity = factory.doubles(value.velocity)
    if value.effort is not None:
        message.effort = factory.doubles(value.effort)
    return message


def read_rotors(message: Any) -> RotorReading:
    """Read the speeds measured by the ESCs."""
    if list(message.name) != ROTORS or len(message.velocity) != len(ROTORS):
        raise MessageError(f'expected velocities of {ROTORS}')
    return RotorReading(seconds(message.header.stamp), np.array(message.velocity, dtype=float).T)


def write_rotors(factory: MessageFactory, value: RotorReading) -> Any:
    """Write the speeds."""
    message = _begin(factory, 'sensor_msgs/msg/JointState', value.stamp)
    message.name = ROTORS
    message.velocity = factory.doubles(value.speed)
    return message


def read_battery(message: Any) -> BatteryReading:
    """Read voltage and current."""
    return BatteryReading(seconds(message.header.stamp), message.voltage, message.current)


take_battery = _take_finite(read_battery, voltage='voltage')


def write_battery(factory: MessageFactory, value: BatteryReading) -> Any:
    """Write voltage and current; unmeasured fields are NaN."""
    message = _begin(factory, 'sensor_msgs/msg/BatteryState', value.stamp)
    message.voltage, message.current = float(value.voltage), float(value.current)
    message.temperature = message.charge = message.capacity = message.design_capacity \
        = message.percentage = float('nan')
    message.power_supply_status = message.POWER_SUPPLY_STATUS_DISCHARGING
    message.power_supply_technology = message.POWER_SUPPLY_TECHNOLOGY_LIPO
    message.present = True
    message.cell_voltage = factory.singles([float('nan')] * value.cells)
    return message


# --- state and commands -------------------------------------------------------------------------

def read_odom(message: Any) -> Odom:
    """Read pose and velocity; the velocity is rotated from base_link to world."""
    return _odom(message, xyz(message.pose.pose.position), xyzw(message.pose.pose.orientation))


def take_odom(message: Any) -> Odom:
    """Read pose and velocity for flight."""
    pose = message.pose.pose
    odom = _odom(message, finite(xyz(pose.position), 'position'), unit(xyzw(pose.orientation)))
    finite(odom.velocity, 'linear velocity')
    finite(odom.angular_velocity, 'angular velocity')
    return odom


def _odom(message, position, quaternion):
    twist = message.twist.twist
    velocity = xyz(twist.linear)
    velocity = rotations.matrix(quaternion) @ velocity if velocity.ndim == 1 else \
        np.einsum('ijn,nj->ni', rotations.matrix(tuple(quaternion.T)), velocity)
    return Odom(seconds(message.header.stamp), position, velocity, quaternion, xyz(twist.angular))


def write_odom(factory: MessageFactory, value: Odom) -> Any:
    """Write pose in world, twist in base_link, and covariances."""
    message = _begin(factory, 'nav_msgs/msg/Odometry', value.stamp, WORLD)
    message.child_frame_id = BODY
    _set_pose(message.pose.pose, value.position, value.quaternion)
    set_xyz(message.twist.twist.linear, rotations.matrix(value.quaternion).T @ value.velocity)
    set_xyz(message.twist.twist.angular, value.angular_velocity)
    if value.pose_covariance is not None:
        message.pose.covariance = _flat(value.pose_covariance)
    if value.twist_covariance is not None:
        message.twist.covariance = _flat(value.twist_covariance)
    return message


def _flat(matrix):
    return np.ascontiguousarray(matrix, dtype=float).reshape(36)


def read_command(message: Any) -> Command:
    """Read four tilts and four thrusts."""
    order = _order(message.name, COMMAND_NAMES)
    return Command(seconds(message.header.stamp), _values(message.position, order[:4], 'position'),
                   _values(message.effort, order[4:], 'effort'))


take_command = _take_finite(read_command, tilt='tilt', thrust='thrust')


def write_command(factory: MessageFactory, value: Command) -> Any:
    """Write tilts as positions and thrusts as efforts, NaN for unused values."""
    message = _begin(factory, 'sensor_msgs/msg/JointState', value.stamp)
    message.name = COMMAND_NAMES
    message.position = factory.doubles([*_floats(value.tilt), *NO_VALUE])
    message.effort = factory.doubles([*NO_VALUE, *_floats(value.thrust)])
    return message


def read_health(message: Any) -> HealthReport:
    """Read the health of the actuators, as :func:`write_health` describes it."""
    if len(message.position) != len(HEALTH_NAMES) or len(message.effort) != len(HEALTH_NAMES):
        raise MessageError('expected four joints, four rotors and four zeros')
    stuck, zeros, efforts = message.position[:4], message.position[8:], message.effort[4:8]
    if any(abs(angle) > np.pi * 2 for angle in stuck) or not all(map(isfinite, zeros)):
        raise MessageError('expected angles within one turn and finite zeros')
    return HealthReport(seconds(message.header.stamp), ActuatorHealth(
        rotors=tuple(effort != 0 for effort in efforts),
        stuck=tuple(None if isnan(a) else float(a) for a in stuck),
        held=tuple(None if isnan(f) or f == 0 else float(f) for f in efforts),
        zeros=tuple(map(float, zeros)),
        thrust_limit=None if isnan(message.effort[8]) else float(message.effort[8])))


def write_health(factory: MessageFactory, value: HealthReport) -> Any:
    """
    Write the health of the actuators.

    Positions: angles of stuck joints (NaN: the joint moves), unused values of the rotors, then
    zeros of the encoders. Efforts: unused values of the joints, then NaN for a working rotor, 0
    for a lost one, else the thrust at which it is stuck. The last four efforts are the thrust
    limit of each rotor by the battery, NaN for none.
    """
    health = value.health
    stuck = [np.nan if angle is None else float(angle) for angle in health.stuck]
    efforts = [0.0 if not works else np.nan if held is None else float(held)
               for works, held in zip(health.rotors, health.held)]
    message = _begin(factory, 'sensor_msgs/msg/JointState', value.stamp)
    message.name = HEALTH_NAMES
    message.position = factory.doubles([*stuck, *NO_VALUE, *map(float, health.zeros)])
    limit = np.nan if health.thrust_limit is None else float(health.thrust_limit)
    message.effort = factory.doubles([*NO_VALUE, *efforts, *[limit] * 4])
    return message


def read_wrench(message: Any) -> Wrench:
    """Read force in world and torque in base_link; ignores the frame_id."""
    return Wrench(seconds(message.header.stamp), xyz(message.wrench.force),
                  xyz(message.wrench.torque))


take_wrench = _take_finite(read_wrench, force='force', torque='torque')


def write_wrench(factory: MessageFactory, value: Wrench) -> Any:
    """Write force in world and torque in base_link."""
    message = _begin(factory, 'geometry_msgs/msg/WrenchStamped', value.stamp, WORLD)
    set_xyz(message.wrench.force, value.force)
    set_xyz(message.wrench.torque, value.torque)
    return message


# --- targets ------------------------------------------------------------------------------------

def read_pose_target(message: Any) -> PoseTarget:
    """Read a pose target, with a wide tolerance of the quaternion's length."""
    return PoseTarget(xyz(message.pose.position), unit(xyzw(message.pose.orientation), 0.5, 2.0),
                      seconds(message.header.stamp))


def take_pose_target(message: Any) -> PoseTarget:
    """Read a pose target for flight; MessageError for another frame than world."""
    position = finite(xyz(message.pose.position), 'position')
    quaternion = unit(xyzw(message.pose.orientation))
    _check_frame(message)
    return PoseTarget(position, quaternion, seconds(message.header.stamp))


def _check_frame(message):
    if message.header.frame_id not in ('', WORLD):
        raise MessageError(f"frame_id '{message.header.frame_id[:40]}' is not '{WORLD}'",
                           'wrong frame')


def read_trajectory(message: Any) -> TrajectoryTarget:
    """Read a trajectory; the times of the points count from the header's stamp."""
    start, points = seconds(message.header.stamp), message.points
    if not points or any(len(p.transforms) != 1 or len(p.velocities) != 1 for p in points):
        raise MessageError('each trajectory point needs one transform and one velocity')
    return TrajectoryTarget(
        start + np.array([seconds(p.time_from_start) for p in points]),
        np.array([xyz(p.transforms[0].translation) for p in points]),
        np.array([xyzw(p.transforms[0].rotation) for p in points]),
        np.array([xyz(p.velocities[0].linear) for p in points]),
        np.array([xyz(p.velocities[0].angular) for p in points]), stamp=start)


def take_trajectory(message: Any) -> TrajectoryTarget:
    """Read a trajectory for flight; MessageError for another frame than world."""
    if not 2 <= len(message.points) <= POINTS:
        raise MessageError(f'a trajectory of {len(message.points)} points: expected 2 to {POINTS}',
                           'too few or too many points')
    _check_frame(message)
    path = read_trajectory(message)
    if np.any(np.diff(path.times) <= 0):
        raise MessageError('trajectory times do not increase')
    finite(path.positions, 'translation')
    finite(path.velocities, 'velocity')
    finite(path.angular_velocities, 'angular velocity')
    return TrajectoryTarget(path.times, path.positions,
                            np.array([unit(q) for q in path.quaternions]), path.velocities,
                            path.angular_velocities, path.stamp)


def write_trajectory(factory: MessageFactory, value: TrajectoryTarget) -> Any:
    """Write a trajectory; angular velocities are in the body frame of the reference."""
    message = _begin(factory, 'trajectory_msgs/msg/MultiDOFJointTrajectory', value.stamp, WORLD)
    message.joint_names = [BODY]
    message.points = [_point(factory, value, k) for k in range(len(value.times))]
    return message


def _point(factory, path, k):
    point = factory.new('trajectory_msgs/msg/MultiDOFJointTrajectoryPoint')
    transform = factory.new('geometry_msgs/msg/Transform')
    twist = factory.new('geometry_msgs/msg/Twist')
    set_xyz(transform.translation, path.positions[k])
    set_xyzw(transform.rotation, path.quaternions[k])
    set_xyz(twist.linear, path.velocities[k])
    set_xyz(twist.angular, path.angular_velocities[k])
    point.transforms, point.velocities = [transform], [twist]
    offset = point.time_from_start
    offset.sec, offset.nanosec = divmod(nanoseconds(path.times[k] - path.stamp), 1_000_000_000)
    return point


def take_override(message: Any) -> TargetOverride:
    """Read the supervisor's target; None for a message without points."""
    return TargetOverride(seconds(message.header.stamp),
                take_trajectory(message) if message.points else None)


def write_override(factory: MessageFactory, value: TargetOverride) -> Any:
    """Write the supervisor's target; a message without points for None."""
    return factory.new('trajectory_msgs/msg/MultiDOFJointTrajectory') if value.target is None \
        else write_trajectory(factory, value.target)


# --- text ---------------------------------------------------------------------------------------

def read_text(message: Any) -> str:
    """Read a text."""
    return message.data


def write_text(factory: MessageFactory, value: str) -> Any:
    """Write a text."""
    message = factory.new('std_msgs/msg/String')
    message.data = value
    return message


def read_diagnostics(message: Any) -> list[Diagnostic]:
    """Read all statuses; each gets the message's stamp."""
    t = seconds(message.header.stamp)
    return [Diagnostic(t, status.name, ord(status.level) if isinstance(status.level, bytes)
                       else int(status.level), status.message,
                       {pair.key: pair.value for pair in status.values})
            for status in message.status]


def write_diagnostics(factory: MessageFactory, value: Sequence[Diagnostic]) -> Any:
    """Write statuses into one message with the stamp of the first."""
    message = _begin(factory, 'diagnostic_msgs/msg/DiagnosticArray', value[0].t)
    for entry in value:
        status = factory.new('diagnostic_msgs/msg/DiagnosticStatus')
        status.level, status.name = factory.byte(entry.level), entry.name
        status.message, status.hardware_id = entry.message, 'beetle_omni'
        for key, text in entry.values.items():
            pair = factory.new('diagnostic_msgs/msg/KeyValue')
            pair.key, pair.value = str(key), str(text)
            status.values.append(pair)
        message.status.append(status)
    return message

