"""Messages of a bag to ``write_*`` calls of a recorder, by topic; without ROS."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.control.base import PoseTarget, TrajectoryTarget
from beetle_omni_ros.robot import rotations
from beetle_omni_ros.robot.parameters import JOINT_NAMES
from beetle_omni_ros.runs.log import COMPUTE_KEYS
from beetle_omni_ros.runs.messages import COMMAND_NAMES, COMPUTE_STATUS, NAN4, RUN_STATUS
from beetle_omni_ros.runs.topics import requester


class LayoutError(ValueError):
    """A message does not have the layout of its topic."""


def stamp(message, received: float) -> float:
    """Stamp of a message [s]; an unset one, as quick tools send, is the time of receipt."""
    time = message.header.stamp
    return time.sec + time.nanosec * 1e-9 if time.sec or time.nanosec else received


def record(recorder, topic: str, message, received: float) -> None:
    """
    Pass one decoded message on to a recorder.

    Args:
        recorder: takes ``write_*`` calls, see :class:`~beetle_omni_ros.runs.recorder.LogRecorder`.
        topic: name in ``TOPICS``, or '<controller>/command'.
        message: decoded by ``TYPESTORE``.
        received: time of recording [s].

    Raises:
        LayoutError: the message lacks names or values that the topic needs.

    """
    controller = requester(topic)
    read = _read_command(controller) if controller else _READERS[topic]
    read(recorder, message, received)


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
    velocity = _pick(message.velocity, order, 'velocity') if len(message.velocity) else NAN4
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
