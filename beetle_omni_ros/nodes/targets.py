"""Target messages to the core's targets and back."""

from __future__ import annotations

from dataclasses import dataclass

from geometry_msgs.msg import PoseStamped, Transform, Twist
import numpy as np
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.nodes.convert import (
    BODY,
    checked_pose,
    finite,
    MessageError,
    pose_message,
    quaternion,
    seconds,
    time_message,
    unit,
    vector,
    WORLD,
    xyz,
    xyzw,
)

POINTS = 10_000     # of a trajectory: 100 s at 100 Hz; more would hold up the node that reads it


def pose_target(message: PoseStamped) -> PoseTarget:
    """Read a target pose."""
    position, rotation = checked_pose(message.pose)
    if message.header.frame_id not in ('', WORLD):
        raise MessageError(f"frame_id '{message.header.frame_id[:40]}' is not '{WORLD}'",
                           'wrong frame')
    return PoseTarget(position, rotation, seconds(message.header.stamp))


def trajectory_target(message: MultiDOFJointTrajectory) -> TrajectoryTarget:
    """Read a trajectory; times count from the header's stamp."""
    start, points = seconds(message.header.stamp), message.points
    if not 2 <= len(points) <= POINTS:
        raise MessageError(f'a trajectory of {len(points)} points: expected 2 to {POINTS}',
                           'too few or too many points')
    if message.header.frame_id not in ('', WORLD):
        raise MessageError(f"frame_id '{message.header.frame_id[:40]}' is not '{WORLD}'",
                           'wrong frame')
    for point in points:
        if len(point.transforms) != 1 or len(point.velocities) != 1:
            raise MessageError('each trajectory point needs one transform and one velocity')
    times = np.array([start + p.time_from_start.sec + p.time_from_start.nanosec * 1e-9
                      for p in points])
    if np.any(np.diff(times) <= 0):
        raise MessageError('trajectory times do not increase')
    rotation = np.array([xyzw(p.transforms[0].rotation) for p in points])
    return TrajectoryTarget(
        times,
        finite(np.array([xyz(p.transforms[0].translation) for p in points]), 'translation'),
        np.array([unit(q) for q in rotation]),
        finite(np.array([xyz(p.velocities[0].linear) for p in points]), 'velocity'),
        finite(np.array([xyz(p.velocities[0].angular) for p in points]), 'angular velocity'),
        stamp=start)


@dataclass(frozen=True)
class Wish:
    """What the supervisor wants flown in place of the operator's target, or None."""

    stamp: float
    target: TrajectoryTarget | None


def wished_target(message: MultiDOFJointTrajectory) -> Wish:
    """Read the supervisor's target; a message without points takes it back."""
    return Wish(seconds(message.header.stamp),
                trajectory_target(message) if message.points else None)


def wish_message(target: TrajectoryTarget | None) -> MultiDOFJointTrajectory:
    """Write the supervisor's target; None takes it back."""
    return MultiDOFJointTrajectory() if target is None else target_message(target)


def target_message(target: PoseTarget | TrajectoryTarget) -> PoseStamped | MultiDOFJointTrajectory:
    """Write a target; a trajectory's angular velocities stay in the reference's body frame."""
    if isinstance(target, PoseTarget):
        return pose_message(target.stamp, target.position, target.quaternion)
    message = MultiDOFJointTrajectory(joint_names=[BODY])
    message.header.stamp = time_message(target.stamp)
    message.header.frame_id = WORLD
    for k, time in enumerate(target.times):
        point = MultiDOFJointTrajectoryPoint()
        offset = round((time - target.stamp) * 1e9)
        point.time_from_start.sec = offset // 1_000_000_000
        point.time_from_start.nanosec = offset % 1_000_000_000
        point.transforms = [Transform(translation=vector(target.positions[k]),
                                      rotation=quaternion(target.quaternions[k]))]
        point.velocities = [Twist(linear=vector(target.velocities[k]),
                                  angular=vector(target.angular_velocities[k]))]
        message.points.append(point)
    return message
