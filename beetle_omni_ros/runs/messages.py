"""
Values to messages, without ROS; :mod:`~beetle_omni_ros.runs.decode` is the way back.

Types come from rosbags' Jazzy type store.
"""

from __future__ import annotations

from math import floor

import numpy as np
from rosbags.typesys import get_typestore, Stores

from beetle_omni_ros.control.base import PoseTarget, Target
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import JOINT_NAMES, ROTOR_NAMES

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
NAN4 = np.full(4, np.nan)
_EMPTY = np.zeros(0)


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
    return JointState(header(t), COMMAND_NAMES, np.concatenate([_floats(tilt), NAN4]), _EMPTY,
                      np.concatenate([NAN4, _floats(thrust)]))


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
