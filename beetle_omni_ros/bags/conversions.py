"""
Forms of messages: ROS type, class of the value, and conversion between both.

A form is one entry; a topic of :mod:`.topics` has a form. ``read`` also converts the messages of
:func:`.messages.columns`, whose numbers are arrays (N,), so that vectors have the shape (N, 3).
"""

from __future__ import annotations

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
from beetle_omni_ros.model.mode import Mode
from beetle_omni_ros.model.parameters import JOINT_NAMES, ROTOR_NAMES
from beetle_omni_ros.model.rotations import BodyState
from beetle_omni_ros.model.schema import shortened

WORLD, BODY = 'world', 'base_link'
JOINTS, ROTORS = list(JOINT_NAMES), list(ROTOR_NAMES)
COMMAND_NAMES = [*JOINTS, *ROTORS]
NO_VALUE = [float('nan')] * 4
UNIT_TOLERANCE = 0.01   # of a quaternion's length; above the rounding of any publisher
POINTS = 10_000     # of a trajectory: 100 s at 100 Hz; more would block the reading node
STRING = 'std_msgs/msg/String'
DIAGNOSTICS_TYPE = 'diagnostic_msgs/msg/DiagnosticArray'
JOINT_STATE = 'sensor_msgs/msg/JointState'
TRAJECTORY_TYPE = 'trajectory_msgs/msg/MultiDOFJointTrajectory'


# One kind of message: ROS message type; class of its values; message -> value, with a
# MessageError for another layout; value -> message; message -> value in flight, with a
# MessageError for an unusable one too
Form = tuple[str, type, Callable[[Any], Any], Callable[[Any], Any], Callable[[Any], Any]]


def form(name: str, value: type, read: Callable[[Any], Any], write: Callable[[Any], Any],
         finite: Sequence[str] = ()) -> Form:
    """Return a form whose ``finite`` attributes are checked in flight; a quaternion is unit."""
    def take(message):
        found = read(message)
        for part in finite:
            check_finite(getattr(found, part), part)
        if 'quaternion' in finite:
            unit(found.quaternion)
        return found

    return name, value, read, write, take


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


def check_finite(values: np.ndarray | float, what: str) -> None:
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

def vectors(name: str, value: type, frame: str, *, finite: Sequence[str] | None = None,
            after_read: Callable[[Any, Any], Any] = lambda value, message: value,
            after_write: Callable[[Any, Any], None] = lambda message, value: None,
            **places: str) -> Form:
    """
    Return the form of a stamped message with vectors at fixed places.

    Args:
        name: ROS message type.
        value: class of the value, with a ``stamp``.
        frame: frame_id.
        finite: attributes that must be finite in flight; default: all.
        after_read: (value, message) -> value.
        after_write: function of (message, value) that fills the rest of the message.
        **places: attribute of the value -> path of its vector in the message, followed by the
            names of its parts, 'pose.position xyz'; without parts it is a number.

    """
    vectors_at = []     # attribute, path, getter of the vector, getter of its parts
    for attribute, place in places.items():
        path, _, parts = place.partition(' ')
        vectors_at.append((attribute, path, attrgetter(path), attrgetter(
            *(f'{path}.{part}' for part in parts)) if parts else None))

    def read(message):
        return after_read(value(stamp=seconds(message.header.stamp), **{
            attribute: np.array(parts(message)).T if parts else whole(message)
            for attribute, _, whole, parts in vectors_at}), message)

    def write(value):
        message = _begin(name, value.stamp, frame)
        for attribute, path, whole, parts in vectors_at:
            if parts:
                set_parts(whole(message), getattr(value, attribute))
            else:
                setattr(message, path, float(getattr(value, attribute)))
        after_write(message, value)
        return message

    return form(name, value, read, write, tuple(places) if finite is None else finite)


def _fill_imu(message, value):
    """State that there is no orientation (REP-145)."""
    message.orientation.w = 1.0
    message.orientation_covariance[0] = -1.0


def _fill_battery(message, value):
    """State the kind of the pack; unmeasured fields are NaN."""
    message.temperature = message.charge = message.capacity = message.design_capacity \
        = message.percentage = float('nan')
    message.power_supply_status = message.POWER_SUPPLY_STATUS_DISCHARGING
    message.power_supply_technology = message.POWER_SUPPLY_TECHNOLOGY_LIPO
    message.present = True


def _in_world(odom, message):
    """Rotate the velocity (3,) or (N, 3) from base_link to world."""
    turn = rotations.matrix(odom.quaternion) if odom.velocity.ndim == 1 else np.reshape(
        rotations.entries(*odom.quaternion.T), (3, 3, -1)).transpose(2, 0, 1)
    return replace(odom, velocity=(turn @ odom.velocity[..., None])[..., 0])


def _fill_odom(message, value):
    """Write the twist in base_link, and the covariances of an estimate, which the truth lacks."""
    message.child_frame_id = BODY
    set_parts(message.twist.twist.linear, rotations.matrix(value.quaternion).T @ value.velocity)
    for part in ('pose', 'twist'):
        if (covariance := getattr(value, f'{part}_covariance', None)) is not None:
            getattr(message, part).covariance = covariance().reshape(36)


def _as_target(target, message):
    check_finite(target.position, 'position')
    _check_frame(message)
    return replace(target, quaternion=unit(target.quaternion))


POSE = vectors('geometry_msgs/msg/PoseStamped', readings.PoseReading, WORLD,
               position='pose.position xyz', quaternion='pose.orientation xyzw')
POSE_TARGET = vectors(POSE[0], PoseTarget, WORLD, after_read=_as_target,
                      position='pose.position xyz', quaternion='pose.orientation xyzw')
IMU = vectors('sensor_msgs/msg/Imu', readings.ImuReading, BODY, after_write=_fill_imu,
              specific_force='linear_acceleration xyz', angular_velocity='angular_velocity xyz')
WRENCH = vectors('geometry_msgs/msg/WrenchStamped', Wrench, WORLD,
                 force='wrench.force xyz', torque='wrench.torque xyz')
BATTERY = vectors('sensor_msgs/msg/BatteryState', readings.BatteryReading, '',
                  finite=('voltage',), after_write=_fill_battery,
                  voltage='voltage', current='current')
# The twist of the message is in base_link, the velocity of the value in world.
ODOM = vectors('nav_msgs/msg/Odometry', BodyState, WORLD, after_read=_in_world,
               after_write=_fill_odom, position='pose.pose.position xyz',
               velocity='twist.twist.linear xyz', quaternion='pose.pose.orientation xyzw',
               angular_velocity='twist.twist.angular xyz')


# --- messages of joints -------------------------------------------------------------------------

def _of(message, field, names):
    """Values (len(names),) or (N, len(names)) of a field of a JointState, by name."""
    values = getattr(message, field)
    try:
        order = range(len(names)) if message.name[:len(names)] == names else \
            [message.name.index(name) for name in names]
        return np.array([values[k] for k in order], dtype=float).T
    except ValueError:
        found, wanted = shortened(', '.join(map(str, message.name)), 60), ', '.join(names)
        raise MessageError(f'names are {found}, not {wanted}', f'names are not {wanted}') from None
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


def _read_joints(message):
    return readings.JointReading(
        seconds(message.header.stamp), _of(message, 'position', JOINTS),
        _of(message, 'velocity', JOINTS) if len(message.velocity) else None,
        _of(message, 'effort', JOINTS) if len(message.effort) else None)


def _take_joints(message):
    """Read the tilt joints for flight: NaN for a joint that is not named, 0 for missing rates."""
    names = [name for name in JOINTS if name in message.name]
    known = [name in names for name in JOINTS]
    position, velocity = np.full((2, 4), np.nan)
    position[known] = _of(message, 'position', names)
    velocity[known] = _of(message, 'velocity', names) if len(message.velocity) else 0.0
    check_finite(position[known], 'position')
    check_finite(velocity[known], 'velocity')
    return readings.JointReading(seconds(message.header.stamp), position, velocity)


JOINT: Form = (JOINT_STATE, readings.JointReading, _read_joints, lambda value: _joint_state(
    value.stamp, value.names, position=value.position, velocity=value.velocity,
    effort=value.effort), _take_joints)
ROTOR = form(JOINT_STATE, readings.RotorReading, lambda message: readings.RotorReading(
    seconds(message.header.stamp), _of(message, 'velocity', ROTORS)),
    lambda value: _joint_state(value.stamp, ROTORS, velocity=value.speed))
# Tilts are positions and thrusts are efforts; unused values are NaN.
COMMAND = form(JOINT_STATE, Command, lambda message: Command(
    seconds(message.header.stamp), _of(message, 'position', JOINTS),
    _of(message, 'effort', ROTORS)), lambda value: _joint_state(
    value.stamp, COMMAND_NAMES, position=[*value.tilt, *NO_VALUE],
    effort=[*NO_VALUE, *value.thrust]), ('tilt', 'thrust'))


# --- trajectories -------------------------------------------------------------------------------

def _read_trajectory(message):
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
    check_finite(path.positions, 'translation')
    check_finite(path.velocities, 'velocity')
    check_finite(path.angular_velocities, 'angular velocity')
    return path


def _write_trajectory(value):
    """Write a trajectory; angular velocities are in the body frame of the reference."""
    message = _begin(TRAJECTORY_TYPE, value.stamp, WORLD)
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


TRAJECTORY = form(TRAJECTORY_TYPE, TrajectoryTarget, _read_trajectory, _write_trajectory)
# The target of the supervisor is None without points.
OVERRIDE = form(
    TRAJECTORY_TYPE, TrajectoryTarget,
    lambda message: _read_trajectory(message) if message.points else None,
    lambda value: new(TRAJECTORY_TYPE) if value is None else _write_trajectory(value))


# --- text ---------------------------------------------------------------------------------------

def _write_text(value):
    message = new(STRING)
    message.data = value
    return message


def _read_health(message):
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


def _read_diagnostics(message):
    """Read all statuses; each gets the message's stamp."""
    t = seconds(message.header.stamp)
    return [Diagnostic(t, status.name, status.level, status.message,
                       {pair.key: pair.value for pair in status.values})
            for status in message.status]


def _write_diagnostics(value):
    """Write statuses into one message with the stamp of the first."""
    message = _begin(DIAGNOSTICS_TYPE, value[0].t)
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


TEXT = form(STRING, str, attrgetter('data'), _write_text)
MODE = form(STRING, Mode, lambda message: Mode(message.data), _write_text)
HEALTH = form(STRING, ActuatorHealth, _read_health,
              lambda health: _write_text(json.dumps(asdict(health))))
DIAGNOSTICS = form(DIAGNOSTICS_TYPE, Diagnostic, _read_diagnostics, _write_diagnostics)
