"""Recordings as rosbag2 folders, and the ways in which such a folder gets damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from gap_data.sensors import Recording

STORE = get_typestore(Stores.ROS2_JAZZY)
T = STORE.types
GIMBALS = [f'gimbal{i}' for i in range(1, 5)]
ROTORS = [f'rotor{i}' for i in range(1, 5)]
VERSION = 9  # of metadata.yaml, as Jazzy writes it
TOPICS = {'mocap/pose': 'geometry_msgs/msg/PoseStamped', 'imu/data_raw': 'sensor_msgs/msg/Imu',
          'joint_states': 'sensor_msgs/msg/JointState',
          'battery_state': 'sensor_msgs/msg/BatteryState',
          'command': 'sensor_msgs/msg/JointState',
          'target_pose': 'geometry_msgs/msg/PoseStamped'}
DAMAGES = ('missing_imu', 'missing_mocap', 'missing_command', 'missing_joints', 'clock_jump',
           'duplicates', 'cut', 'gaps')


def write_bag(path: str | Path, recording: Recording, *, epoch: float,
              damage: str | None = None, rng: np.random.Generator | None = None) -> None:
    """
    Write one flight.

    Args:
        path: folder to create.
        recording: see :mod:`gap_data.sensors`.
        epoch: [s] what the clock showed when the flight began.
        damage: one of ``DAMAGES``; None is a sound bag.
        rng: where the damage sits.

    """
    entries = _entries(recording)
    if damage and damage.startswith('missing_'):
        topic = {'imu': 'imu/data_raw', 'mocap': 'mocap/pose', 'command': 'command',
                 'joints': 'joint_states'}[damage.removeprefix('missing_')]
        entries = [e for e in entries if e[1] != topic]
    elif damage in ('clock_jump', 'duplicates', 'gaps'):
        entries = _damage(entries, damage, rng, recording.imu[-1, 0])
    entries.sort(key=lambda entry: entry[0])
    present = {topic for _, topic, _, _ in entries}
    with Writer(Path(path), version=VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {topic: writer.add_connection('/' + topic, kind, typestore=STORE)
                 for topic, kind in TOPICS.items() if topic in present}
        for received, topic, stamp, fields in entries:
            message = MAKERS[topic](_header(epoch + stamp, topic), fields)
            writer.write(links[topic], _nanoseconds(epoch + received),
                         STORE.serialize_cdr(message, TOPICS[topic]))
    if damage == 'cut':
        file = next(Path(path).glob('*.mcap'))
        data = file.read_bytes()
        file.write_bytes(data[:int(len(data) * rng.uniform(0.5, 0.8))])
        (Path(path) / 'metadata.yaml').unlink()


def _entries(recording):
    """(arrival [s], topic, stamp [s], fields) of every message."""
    names = {'imu': 'imu/data_raw', 'mocap': 'mocap/pose', 'joints': 'joint_states',
             'battery': 'battery_state', 'commands': 'command'}
    entries = [(float(row[0]) + recording.ages[name], topic, float(row[0]), row[1:])
               for name, topic in names.items() for row in getattr(recording, name)]
    entries += [(t, 'target_pose', t, np.concatenate([position, quaternion]))
                for t, position, quaternion in recording.targets
                if t <= recording.imu[-1, 0]]
    return entries


def _damage(entries, damage, rng, duration):
    at = rng.uniform(0.3, 0.6) * duration
    if damage == 'clock_jump':
        jump = float(rng.choice([-4.0, 7.0, 3600.0]))
        return [(received, topic, stamp + (jump if stamp > at else 0.0), fields)
                for received, topic, stamp, fields in entries]
    if damage == 'gaps':
        lost = rng.uniform(0.3, 0.5) * duration
        return [e for e in entries if e[1] not in ('mocap/pose', 'imu/data_raw')
                or not at < e[2] < at + lost]
    again = [e for e in entries if e[1] in ('imu/data_raw', 'joint_states')
             and rng.random() < 0.25]
    return entries + [(received + 0.002, topic, stamp, fields)
                      for received, topic, stamp, fields in again]


def _nanoseconds(t):
    whole = int(t // 1)
    return whole * 1_000_000_000 + int(round((t - whole) * 1e9))


def _header(t, topic):
    frame = {'mocap/pose': 'world', 'target_pose': 'world', 'imu/data_raw': 'base_link'}
    return T['std_msgs/msg/Header'](
        T['builtin_interfaces/msg/Time'](*divmod(_nanoseconds(t), 1_000_000_000)),
        frame.get(topic, ''))


_NONE = np.zeros(0)
_NAN4 = np.full(4, np.nan)
_UNKNOWN = np.zeros(9)
_NO_ORIENTATION = np.array([-1.0, *[0.0] * 8])


def _pose(header, fields):
    f = [float(x) for x in fields]
    return T['geometry_msgs/msg/PoseStamped'](header, T['geometry_msgs/msg/Pose'](
        T['geometry_msgs/msg/Point'](*f[:3]), T['geometry_msgs/msg/Quaternion'](*f[3:])))


def _imu(header, fields):
    f = [float(x) for x in fields]
    vector = T['geometry_msgs/msg/Vector3']
    return T['sensor_msgs/msg/Imu'](
        header, T['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0), _NO_ORIENTATION,
        vector(*f[3:]), _UNKNOWN, vector(*f[:3]), _UNKNOWN)


def _joints(header, fields):
    return T['sensor_msgs/msg/JointState'](header, GIMBALS, fields[:4].copy(), fields[4:].copy(),
                                           _NONE)


def _command(header, fields):
    return T['sensor_msgs/msg/JointState'](
        header, GIMBALS + ROTORS, np.concatenate([fields[:4], _NAN4]), _NONE,
        np.concatenate([_NAN4, fields[4:]]))


def _battery(header, fields):
    nan, cells = float('nan'), np.zeros(0, np.float32)
    return T['sensor_msgs/msg/BatteryState'](
        header, float(fields[0]), nan, float(fields[1]), nan, nan, nan, nan, 2, 0, 3, True,
        cells, cells, '', '')


MAKERS = {'mocap/pose': _pose, 'target_pose': _pose, 'imu/data_raw': _imu,
          'joint_states': _joints, 'command': _command, 'battery_state': _battery}
