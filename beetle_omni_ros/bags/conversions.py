"""
Conversion between messages and values, by attribute access only.

``take_joints`` converts a message for use in flight.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
import json
from math import floor, isfinite
from operator import attrgetter
from typing import Any

import numpy as np

from beetle_omni_ros.bags.messages import Diagnostic, MessageError, new, Wrench
from beetle_omni_ros.control.base import Command, PoseTarget, TrajectoryTarget
from beetle_omni_ros.model import readings, rotations
from beetle_omni_ros.model.allocation import ActuatorHealth
from beetle_omni_ros.model.body import BodyState
from beetle_omni_ros.model.mode import Mode
from beetle_omni_ros.model.parameters import JOINT_NAMES, ROTOR_NAMES

WORLD, BODY = 'world', 'base_link'
JOINTS, ROTORS = list(JOINT_NAMES), list(ROTOR_NAMES)
COMMAND_NAMES = [*JOINTS, *ROTORS]
NO_VALUE = [float('nan')] * 4
UNIT_TOLERANCE = 0.01   # of a quaternion's length; above the rounding of any publisher
POINTS = 10_000     # of a trajectory: 100 s at 100 Hz; more would block the reading node
POSE = 'geometry_msgs/msg/PoseStamped'
JOINT_STATE = 'sensor_msgs/msg/JointState'
TRAJECTORY = 'trajectory_msgs/msg/MultiDOFJointTrajectory'


# --- times, vectors, checks ---------------------------------------------------------------------

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
    """Return the three fields as an array (3,)."""
    return np.array([v.x, v.y, v.z])


def xyzw(q: Any) -> np.ndarray:
    """Return the four fields as an array (4,)."""
    return np.array([q.x, q.y, q.z, q.w])


def set_parts(v: Any, values: Sequence[float] | np.ndarray) -> None:
    """Fill the fields x, y, z of a vector, or x, y, z, w of a quaternion."""
    v.x, v.y, v.z = float(values[0]), float(values[1]), float(values[2])
    if len(values) == 4:
        v.w = float(values[3])


def finite(values: np.ndarray | float, what: str) -> None:
    """Raise MessageError if a value is not finite, or its square is not."""
    if not isfinite(np.vdot(values, values)):
        raise MessageError(f'{what} is not finite')


def unit(q: np.ndarray) -> np.ndarray:
    """Normalise a quaternion; MessageError if it is none."""
    norm = float(q @ q) ** 0.5
    if not abs(norm - 1) < UNIT_TOLERANCE:      # catches NaN as well
        raise MessageError('orientation is not a unit quaternion')
    return q / norm


def _begin(name, stamp, frame=''):
    message = new(name)
    set_time(message.header.stamp, stamp)
    message.header.frame_id = frame
    return message


def _check_frame(message):
    if message.header.frame_id not in ('', WORLD):
        raise MessageError(f"frame_id '{message.header.frame_id[:40]}' is not '{WORLD}'",
                           'wrong frame')


# --- messages of vectors ------------------------------------------------------------------------

def vectors(value: type, name: str, frame: str, **places: str
            ) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """
    Return ``read`` and ``write`` of a stamped message with vectors at fixed places.

    Args:
        value: class of the value, with a ``stamp``.
        name: ROS message type.
        frame: frame_id.
        places: attribute of the value -> path of its vector in the message, followed by the names
            of its parts, 'pose.position xyz'; without parts it is a number.

    """
    found = []      # attribute, path, getter of the vector, getter of its parts
    for attribute, place in places.items():
        path, _, parts = place.partition(' ')
        found.append((attribute, path, attrgetter(path), attrgetter(
            *(f'{path}.{part}' for part in parts)) if parts else None))

    def read(message):
        return value(stamp=seconds(message.header.stamp), **{
            attribute: np.array(parts(message)) if parts else whole(message)
            for attribute, _, whole, parts in found})

    def write(value):
        message = _begin(name, value.stamp, frame)
        for attribute, path, whole, parts in found:
            if parts:
                set_parts(whole(message), getattr(value, attribute))
            else:
                setattr(message, path, float(getattr(value, attribute)))
        return message

    return read, write


POSE_PLACES = {'position': 'pose.position xyz', 'quaternion': 'pose.orientation xyzw'}
read_pose, write_pose = vectors(readings.PoseReading, POSE, WORLD, **POSE_PLACES)
_read_target, write_pose_target = vectors(PoseTarget, POSE, WORLD, **POSE_PLACES)
read_imu, _write_imu = vectors(
    readings.ImuReading, 'sensor_msgs/msg/Imu', BODY, specific_force='linear_acceleration xyz',
    angular_velocity='angular_velocity xyz')
read_wrench, write_wrench = vectors(Wrench, 'geometry_msgs/msg/WrenchStamped', WORLD,
                                    force='wrench.force xyz', torque='wrench.torque xyz')
read_battery, _write_battery = vectors(readings.BatteryReading, 'sensor_msgs/msg/BatteryState', '',
                                       voltage='voltage', current='current')
# The twist of the message is in base_link, the velocity of the value in world.
_read_odom, _write_odom = vectors(
    BodyState, 'nav_msgs/msg/Odometry', WORLD, position='pose.pose.position xyz',
    velocity='twist.twist.linear xyz', quaternion='pose.pose.orientation xyzw',
    angular_velocity='twist.twist.angular xyz')


def write_imu(value: readings.ImuReading) -> Any:
    """Write specific force and angular rates, without orientation (REP-145)."""
    message = _write_imu(value)
    message.orientation.w = 1.0
    message.orientation_covariance[0] = -1.0
    return message


def write_battery(value: readings.BatteryReading) -> Any:
    """Write voltage and current; unmeasured fields are NaN."""
    message = _write_battery(value)
    message.temperature = message.charge = message.capacity = message.design_capacity \
        = message.percentage = float('nan')
    message.power_supply_status = message.POWER_SUPPLY_STATUS_DISCHARGING
    message.power_supply_technology = message.POWER_SUPPLY_TECHNOLOGY_LIPO
    message.present = True
    return message


def read_odom(message: Any) -> BodyState:
    """Read pose and velocity; the velocity is rotated from base_link to world."""
    odom = _read_odom(message)
    return replace(odom, velocity=rotations.matrix(odom.quaternion) @ odom.velocity)


def write_odom(value: Any) -> Any:
    """
    Write pose in world, twist in base_link, and the covariances of an estimate.

    What has no covariances is written without them.
    """
    message = _write_odom(value)
    message.child_frame_id = BODY
    set_parts(message.twist.twist.linear, rotations.matrix(value.quaternion).T @ value.velocity)
    for part in ('pose', 'twist'):
        if (covariance := getattr(value, f'{part}_covariance', None)) is not None:
            getattr(message, part).covariance = covariance().reshape(36)
    return message


def read_pose_target(message: Any) -> PoseTarget:
    target = _read_target(message)
    finite(target.position, 'position')
    _check_frame(message)
    return replace(target, quaternion=unit(target.quaternion))


# --- messages of joints -------------------------------------------------------------------------

def _of(message, field, names):
    """Values (len(names),) of a field of a JointState, by name."""
    values = getattr(message, field)
    try:
        order = range(len(names)) if message.name[:len(names)] == names else \
            [message.name.index(name) for name in names]
        return np.array([values[k] for k in order], dtype=float)
    except ValueError:
        raise MessageError(f"names are not {', '.join(names)}") from None
    except IndexError:
        raise MessageError(f'{field} has too few values for the names') from None


def _joint_state(stamp, names, **fields):
    """Make a JointState; a field of None stays empty."""
    message = _begin(JOINT_STATE, stamp)
    message.name = list(names)
    for field, numbers in fields.items():
        if numbers is not None:
            setattr(message, field, np.array(numbers, dtype=float))
    return message


def read_joints(message: Any) -> readings.JointReading:
    return readings.JointReading(
        seconds(message.header.stamp), _of(message, 'position', JOINTS),
        _of(message, 'velocity', JOINTS) if len(message.velocity) else None,
        _of(message, 'effort', JOINTS) if len(message.effort) else None)


def take_joints(message: Any) -> readings.JointReading:
    """Read the tilt joints for flight: NaN for a joint that is not named, 0 for missing rates."""
    names = [name for name in JOINTS if name in message.name]
    known = [name in names for name in JOINTS]
    position, velocity = np.full((2, 4), np.nan)
    position[known] = _of(message, 'position', names)
    velocity[known] = _of(message, 'velocity', names) if len(message.velocity) else 0.0
    finite(position[known], 'position')
    finite(velocity[known], 'velocity')
    return readings.JointReading(seconds(message.header.stamp), position, velocity)


def write_joints(value: readings.JointReading) -> Any:
    return _joint_state(value.stamp, value.names, position=value.position,
                        velocity=value.velocity, effort=value.effort)


def read_rotors(message: Any) -> readings.RotorReading:
    return readings.RotorReading(seconds(message.header.stamp), _of(message, 'velocity', ROTORS))


def write_rotors(value: readings.RotorReading) -> Any:
    return _joint_state(value.stamp, ROTORS, velocity=value.speed)


def read_command(message: Any) -> Command:
    return Command(seconds(message.header.stamp), _of(message, 'position', JOINTS),
                   _of(message, 'effort', ROTORS))


def write_command(value: Command) -> Any:
    """Write tilts as positions and thrusts as efforts, NaN for unused values."""
    return _joint_state(value.stamp, COMMAND_NAMES, position=[*value.tilt, *NO_VALUE],
                        effort=[*NO_VALUE, *value.thrust])


# --- trajectories -------------------------------------------------------------------------------

def read_trajectory(message: Any) -> TrajectoryTarget:
    """Read a trajectory in world; the times of the points count from the header's stamp."""
    start, points = seconds(message.header.stamp), message.points
    if not 2 <= len(points) <= POINTS:
        raise MessageError(f'a trajectory of {len(points)} points: expected 2 to {POINTS}',
                           'too few or too many points')
    if any(len(p.transforms) != 1 or len(p.velocities) != 1 for p in points):
        raise MessageError('each trajectory point needs one transform and one velocity')
    _check_frame(message)
    path = TrajectoryTarget(
        start + np.array([seconds(p.time_from_start) for p in points]),
        np.array([xyz(p.transforms[0].translation) for p in points]),
        np.array([unit(xyzw(p.transforms[0].rotation)) for p in points]),
        np.array([xyz(p.velocities[0].linear) for p in points]),
        np.array([xyz(p.velocities[0].angular) for p in points]), stamp=start)
    if np.any(np.diff(path.times) <= 0):
        raise MessageError('trajectory times do not increase')
    finite(path.positions, 'translation')
    finite(path.velocities, 'velocity')
    finite(path.angular_velocities, 'angular velocity')
    return path


def write_trajectory(value: TrajectoryTarget) -> Any:
    """Write a trajectory; angular velocities are in the body frame of the reference."""
    message = _begin(TRAJECTORY, value.stamp, WORLD)
    message.joint_names = [BODY]
    for k, time in enumerate(value.times):
        point = new('trajectory_msgs/msg/MultiDOFJointTrajectoryPoint')
        transform = new('geometry_msgs/msg/Transform')
        twist = new('geometry_msgs/msg/Twist')
        set_parts(transform.translation, value.positions[k])
        set_parts(transform.rotation, value.quaternions[k])
        set_parts(twist.linear, value.velocities[k])
        set_parts(twist.angular, value.angular_velocities[k])
        point.transforms, point.velocities = [transform], [twist]
        set_time(point.time_from_start, time - value.stamp)
        message.points.append(point)
    return message


def read_override(message: Any) -> TrajectoryTarget | None:
    """Read the supervisor's target; None for a message without points."""
    return read_trajectory(message) if message.points else None


def write_override(target: TrajectoryTarget | None) -> Any:
    return new(TRAJECTORY) if target is None else write_trajectory(target)


# --- text ---------------------------------------------------------------------------------------

read_text: Callable[[Any], str] = attrgetter('data')


def read_mode(message: Any) -> Mode:
    return Mode(message.data)


def write_text(value: str) -> Any:
    message = new('std_msgs/msg/String')
    message.data = value
    return message


def read_health(message: Any) -> ActuatorHealth:
    try:
        health = ActuatorHealth(**{name: tuple(value) if isinstance(value, list) else value
                                   for name, value in json.loads(message.data).items()})
        numbers = (*health.rotors, *health.stuck, *health.held, *health.zeros)
        known = [n for n in (*numbers, health.thrust_limit) if n is not None]
        if len(numbers) == 16 and np.isfinite(np.array(known, dtype=float)).all():
            return health
    except (ValueError, TypeError, AttributeError):
        pass
    raise MessageError('expected the fields of ActuatorHealth as JSON')


def write_health(health: ActuatorHealth) -> Any:
    return write_text(json.dumps(asdict(health)))


def read_diagnostics(message: Any) -> list[Diagnostic]:
    """Read all statuses; each gets the message's stamp."""
    t = seconds(message.header.stamp)
    return [Diagnostic(t, status.name, status.level, status.message,
                       {pair.key: pair.value for pair in status.values})
            for status in message.status]


def write_diagnostics(value: Sequence[Diagnostic]) -> Any:
    """Write statuses into one message with the stamp of the first."""
    message = _begin('diagnostic_msgs/msg/DiagnosticArray', value[0].t)
    for entry in value:
        status = new('diagnostic_msgs/msg/DiagnosticStatus')
        status.level, status.name = int(entry.level), entry.name
        status.message, status.hardware_id = entry.message, 'beetle_omni'
        for key, text in entry.values.items():
            pair = new('diagnostic_msgs/msg/KeyValue')
            pair.key, pair.value = str(key), str(text)
            status.values.append(pair)
        message.status.append(status)
    return message
