"""
Messages of a bag to ``write_*`` calls of a recorder, and values to messages; without ROS.

Both directions stand side by side, so that the layout of each message is written once
in each direction. Types come from rosbags' Jazzy type store.
"""

from __future__ import annotations

from math import floor

import numpy as np
from rosbags.typesys import get_typestore, Stores

from beetle_omni_ros.control.base import PoseTarget, Target, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import JOINT_NAMES, ROTOR_NAMES
from beetle_omni_ros.runs.log import COMPUTE_KEYS

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
WORLD, BODY = 'world', 'base_link'
COMMAND_NAMES = [*JOINT_NAMES, *ROTOR_NAMES]
RUN_STATUS = 'run'  # diagnostic status '<node>: run' that carries a flight's meta data
COMPUTE_STATUS = 'compute'  # diagnostic status '<name>_node: compute'

_T = TYPESTORE.types
Time = _T['builtin_interfaces/msg/Time']
Duration = _T['builtin_interfaces/msg/Duration']
Header = _T['std_msgs/msg/Header']
String = _T['std_msgs/msg/String']
Point = _T['geometry_msgs/msg/Point']
Quaternion = _T['geometry_msgs/msg/Quaternion']
Vector3 = _T['geometry_msgs/msg/Vector3']
Pose = _T['geometry_msgs/msg/Pose']
PoseStamped = _T['geometry_msgs/msg/PoseStamped']
PoseWithCovariance = _T['geometry_msgs/msg/PoseWithCovariance']
Twist = _T['geometry_msgs/msg/Twist']
TwistWithCovariance = _T['geometry_msgs/msg/TwistWithCovariance']
Transform = _T['geometry_msgs/msg/Transform']
Wrench = _T['geometry_msgs/msg/Wrench']
WrenchStamped = _T['geometry_msgs/msg/WrenchStamped']
Odometry = _T['nav_msgs/msg/Odometry']
Imu = _T['sensor_msgs/msg/Imu']
JointState = _T['sensor_msgs/msg/JointState']
BatteryState = _T['sensor_msgs/msg/BatteryState']
Trajectory = _T['trajectory_msgs/msg/MultiDOFJointTrajectory']
TrajectoryPoint = _T['trajectory_msgs/msg/MultiDOFJointTrajectoryPoint']
DiagnosticArray = _T['diagnostic_msgs/msg/DiagnosticArray']
DiagnosticStatus = _T['diagnostic_msgs/msg/DiagnosticStatus']
KeyValue = _T['diagnostic_msgs/msg/KeyValue']

_NO_COVARIANCE = np.zeros(36)
_NAN4 = np.full(4, np.nan)
_EMPTY = np.zeros(0)


class LayoutError(ValueError):
    """A message does not have the layout of its topic."""


def nanoseconds(t: float) -> int:
    """Seconds to integer nanoseconds, whole seconds apart: an epoch time keeps every bit."""
    whole = floor(t)
    return whole * 1_000_000_000 + round((t - whole) * 1e9)


def seconds(time: int) -> float:
    """Integer nanoseconds to seconds, the inverse of :func:`nanoseconds`."""
    whole, rest = divmod(time, 1_000_000_000)
    return whole + rest * 1e-9


def header(t: float, frame: str = '') -> Header:
    """Header with stamp ``t`` [s]."""
    return Header(Time(*divmod(max(0, nanoseconds(t)), 1_000_000_000)), frame)


def stamp(message, received: float) -> float:
    """Stamp of a message [s]; an unset one, as quick tools send, is the time of receipt."""
    time = message.header.stamp
    return time.sec + time.nanosec * 1e-9 if time.sec or time.nanosec else received


def pose_stamped(t, position, quaternion) -> PoseStamped:
    """Pose in world."""
    return PoseStamped(header(t, WORLD), Pose(Point(*map(float, position)),
                                              Quaternion(*map(float, quaternion))))


def odometry(t, position, quaternion, velocity, angular_velocity,
             pose_covariance=None, twist_covariance=None) -> Odometry:
    """Odometry: velocity comes in world and is carried in base_link; covariances (6, 6)."""
    twist = Twist(Vector3(*map(float, rotations.matrix(quaternion).T @ velocity)),
                  Vector3(*map(float, angular_velocity)))
    return Odometry(
        header(t, WORLD), BODY,
        PoseWithCovariance(Pose(Point(*map(float, position)), Quaternion(*map(float, quaternion))),
                           _covariance(pose_covariance)),
        TwistWithCovariance(twist, _covariance(twist_covariance)))


def _covariance(matrix):
    if matrix is None:
        return _NO_COVARIANCE
    return np.ascontiguousarray(matrix, dtype=np.float64).reshape(36)


def imu(t, specific_force, angular_velocity) -> Imu:
    """IMU sample after REP-145, without orientation."""
    none = np.zeros(9)
    none[0] = -1.0
    return Imu(header(t, BODY), Quaternion(0.0, 0.0, 0.0, 1.0), none,
               Vector3(*map(float, angular_velocity)), np.zeros(9),
               Vector3(*map(float, specific_force)), np.zeros(9))


def joint_state(t, position, velocity, effort=None) -> JointState:
    """Joint feedback of gimbal1..4."""
    return JointState(header(t), list(JOINT_NAMES), _floats(position), _floats(velocity),
                      _EMPTY if effort is None else _floats(effort))


def command(t, tilt, thrust) -> JointState:
    """Command as INTERFACES lays it out: tilts in position, thrusts in effort."""
    return JointState(header(t), COMMAND_NAMES, np.concatenate([_floats(tilt), _NAN4]), _EMPTY,
                      np.concatenate([_NAN4, _floats(thrust)]))


def _floats(values):
    return np.array(values, dtype=np.float64)


def battery(t, voltage, current) -> BatteryState:
    """Pack voltage and current; everything else unmeasured."""
    nan = float('nan')
    return BatteryState(header(t), float(voltage), nan, float(current), nan, nan, nan, nan,
                        BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
                        BatteryState.POWER_SUPPLY_HEALTH_UNKNOWN,
                        BatteryState.POWER_SUPPLY_TECHNOLOGY_LIPO, True,
                        np.zeros(0, np.float32), np.zeros(0, np.float32), '', '')


def wrench(t, force_world, torque_body) -> WrenchStamped:
    """External wrench: force in world, torque in base_link."""
    return WrenchStamped(header(t, WORLD), Wrench(Vector3(*map(float, force_world)),
                                                  Vector3(*map(float, torque_body))))


def target_message(target: Target) -> tuple[str, object]:
    """Topic and message of a target."""
    if isinstance(target, PoseTarget):
        return 'target_pose', pose_stamped(target.stamp, target.position, target.quaternion)
    points = []
    for k, time in enumerate(target.times):
        offset = divmod(nanoseconds(time - target.stamp), 1_000_000_000)
        points.append(TrajectoryPoint(
            [Transform(Vector3(*map(float, target.positions[k])),
                       Quaternion(*map(float, target.quaternions[k])))],
            [Twist(Vector3(*map(float, target.velocities[k])),
                   Vector3(*map(float, target.angular_velocities[k])))], [], Duration(*offset)))
    return 'target_trajectory', Trajectory(header(target.stamp, WORLD), [BODY], points)


def diagnostic(t, name, values: dict, level=0, message='') -> DiagnosticArray:
    """One status."""
    pairs = [KeyValue(str(key), str(value)) for key, value in values.items()]
    return DiagnosticArray(header(t), [DiagnosticStatus(int(level), name, message, 'beetle_omni',
                                                        pairs)])


def record(recorder, topic: str, message, received: float) -> None:
    """
    Pass one decoded message on to a recorder.

    Args:
        recorder: takes ``write_*`` calls, see :class:`~beetle_omni_ros.runs.recorder.LogRecorder`.
        topic: name in ``TOPICS``.
        message: decoded by ``TYPESTORE``.
        received: time of recording [s].

    Raises:
        LayoutError: the message lacks names or values that the topic needs.

    """
    _READERS[topic](recorder, message, received)


def _read_body(write):
    def read(recorder, message, received):
        position, quaternion = _pose(message.pose.pose)
        twist = message.twist.twist
        velocity = rotations.matrix(quaternion) @ _xyz(twist.linear)
        getattr(recorder, write)(stamp(message, received), position, quaternion, velocity,
                                 _xyz(twist.angular))
    return read


def _read_imu(recorder, message, received):
    recorder.write_imu(stamp(message, received), _xyz(message.linear_acceleration),
                       _xyz(message.angular_velocity))


def _read_mocap(recorder, message, received):
    recorder.write_mocap(stamp(message, received), *_pose(message.pose), received=received)


def _read_joints(recorder, message, received):
    order = _order(message.name, JOINT_NAMES)
    position = _pick(message.position, order, 'position')
    velocity = _pick(message.velocity, order, 'velocity') if len(message.velocity) else _NAN4
    effort = _pick(message.effort, order, 'effort') if len(message.effort) else None
    recorder.write_joints(stamp(message, received), position, velocity, effort, received=received)


def _read_battery(recorder, message, received):
    recorder.write_battery(stamp(message, received), message.voltage, message.current)


def _read_command(controller):
    def read(recorder, message, received):
        order = _order(message.name, COMMAND_NAMES)
        values = (stamp(message, received), _pick(message.position, order[:4], 'position'),
                  _pick(message.effort, order[4:], 'effort'), received)
        if controller:
            recorder.write_request(controller, *values)
        else:
            recorder.write_command(*values)
    return read


def _read_pose_target(recorder, message, received):
    position, quaternion = _pose(message.pose)
    norm = float(np.linalg.norm(quaternion))
    if not 0.5 < norm < 2:
        raise LayoutError('the orientation is not a unit quaternion')
    recorder.write_target(PoseTarget(position, quaternion / norm, stamp(message, received)),
                          received)


def _read_trajectory(recorder, message, received):
    start, points = stamp(message, received), message.points
    if not points or any(len(p.transforms) != 1 or len(p.velocities) != 1 for p in points):
        raise LayoutError('each trajectory point needs one transform and one velocity')
    recorder.write_target(TrajectoryTarget(
        start + np.array([p.time_from_start.sec + p.time_from_start.nanosec * 1e-9
                          for p in points]),
        np.array([_xyz(p.transforms[0].translation) for p in points]),
        np.array([_xyzw(p.transforms[0].rotation) for p in points]),
        np.array([_xyz(p.velocities[0].linear) for p in points]),
        np.array([_xyz(p.velocities[0].angular) for p in points]), start), received)


def _read_wrench(recorder, message, received):
    recorder.write_wrench(stamp(message, received), _xyz(message.wrench.force),
                          _xyz(message.wrench.torque))


def _read_state(recorder, message, received):
    recorder.write_state(received, message.data)


def _read_diagnostics(recorder, message, received):
    t = stamp(message, received)
    for status in message.status:
        values = {pair.key: pair.value for pair in status.values}
        node, _, kind = status.name.rpartition(': ')
        if kind == RUN_STATUS:
            if values.get('seed', '').isdigit():
                values['seed'] = int(values['seed'])
            recorder.write_meta(values)
        name = node.rpartition('/')[2].removesuffix('_node')
        if kind == COMPUTE_STATUS and set(COMPUTE_KEYS) <= set(values):
            recorder.write_compute(t, name, **{
                field: int(values[key]) if field in ('deadline_misses', 'count')
                else float(values[key]) for key, field in COMPUTE_KEYS.items()})
        elif kind != RUN_STATUS:
            recorder.write_diagnostic(t, status.name, values, status.level, status.message)


_READERS = {
    'mocap/pose': _read_mocap, 'imu/data_raw': _read_imu, 'joint_states': _read_joints,
    'battery_state': _read_battery, 'odom': _read_body('write_odom'),
    'ground_truth/odom': _read_body('write_truth'), 'target_pose': _read_pose_target,
    'target_trajectory': _read_trajectory, 'command': _read_command(None),
    'nmpc/command': _read_command('nmpc'), 'rl/command': _read_command('rl'),
    'disturbance': _read_wrench, 'supervisor/state': _read_state,
    'diagnostics': _read_diagnostics}


def _xyz(v):
    return np.array((v.x, v.y, v.z))


def _xyzw(q):
    return np.array((q.x, q.y, q.z, q.w))


def _pose(pose):
    return _xyz(pose.position), _xyzw(pose.orientation)


def _order(names, wanted):
    if names == list(wanted):
        return range(len(wanted))
    try:
        return [names.index(name) for name in wanted]
    except ValueError:
        raise LayoutError(f"names are not {', '.join(wanted)}") from None


def _pick(values, order, what):
    if len(values) <= max(order):
        raise LayoutError(f'{what} has {len(values)} values, too few for the names')
    return values[order] if not isinstance(order, range) else values[order.start:order.stop]
