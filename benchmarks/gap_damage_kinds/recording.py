"""A bag as messages that can be changed singly, and written again."""

from __future__ import annotations

from collections import Counter
from copy import copy
import json
from pathlib import Path

import numpy as np
import yaml

from beetle_omni_ros.messages.bag_types import TYPESTORE
from beetle_omni_ros.messages.conversions import nanoseconds
from beetle_omni_ros.messages.topics import split_topic, TOPICS
from beetle_omni_ros.robot.parameters import JOINT_NAMES, ROTOR_NAMES
from beetle_omni_ros.runs.bag import BagWriter
from beetle_omni_ros.runs.bag_files import read_messages
from beetle_omni_ros.runs.bag_reader import META_KEY

MOCAP, IMU, JOINTS, COMMAND = 'mocap/pose', 'imu/data_raw', 'joint_states', 'command'
BATTERY = 'battery_state'
MEASURED = (MOCAP, IMU, JOINTS, COMMAND)    # topics of the analysis
WITHHELD = ('odom', 'ground_truth/odom', 'nmpc/command', 'rl/command')
SECOND = 1_000_000_000  # [ns]


class Message:
    """
    One message.

    Attributes:
        name: name in ``TOPICS``, or the whole topic if it is not there.
        topic: full recorded name.
        type: ROS type.
        received: time of recording [s].

    """

    __slots__ = ('_content', '_data', 'name', 'received', 'topic', 'type')

    def __init__(self, topic: str, msgtype: str, data: bytes, received: float):
        split = split_topic(topic)
        self.name = split[1] if split else topic
        self.topic, self.type, self.received = topic, msgtype, received
        self._data, self._content = data, None

    def __copy__(self) -> Message:
        """A copy that can be changed independently."""
        return Message(self.topic, self.type, self.data, self.received)

    @property
    def content(self):
        """The message of rosbags' type store; changes of it are written."""
        if self._content is None:
            self._content = TYPESTORE.deserialize_cdr(self._data, self.type)
        return self._content

    @property
    def data(self) -> bytes:
        """Unchanged CDR."""
        if self._content is None:
            return self._data
        return bytes(TYPESTORE.serialize_cdr(self._content, self.type))

    @property
    def stamp(self) -> float:
        """Header stamp [s]."""
        stamp = self.content.header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec

    @stamp.setter
    def stamp(self, t: float) -> None:
        stamp = self.content.header.stamp
        stamp.sec, stamp.nanosec = divmod(nanoseconds(t), SECOND)

    def numbers(self) -> list[np.ndarray]:
        """Values of this topic, see ``Recording.values``."""
        m = self.content
        if self.name == MOCAP:
            p, q = m.pose.position, m.pose.orientation
            return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        if self.name == IMU:
            f, w = m.linear_acceleration, m.angular_velocity
            return [f.x, f.y, f.z, w.x, w.y, w.z]
        if self.name == JOINTS:
            return [*m.position[self._order(JOINT_NAMES)],
                    *(m.velocity[self._order(JOINT_NAMES)] if len(m.velocity) else ())]
        return [*m.position[self._order(JOINT_NAMES)], *m.effort[self._order(ROTOR_NAMES)]]

    def put_numbers(self, values: np.ndarray) -> None:
        """Set the values of :meth:`numbers`."""
        m, values = self.content, [float(value) for value in values]
        if self.name == MOCAP:
            p, q = m.pose.position, m.pose.orientation
            p.x, p.y, p.z, q.x, q.y, q.z, q.w = values
        elif self.name == IMU:
            f, w = m.linear_acceleration, m.angular_velocity
            f.x, f.y, f.z, w.x, w.y, w.z = values
        elif self.name == JOINTS:
            m.position = _with(m.position, self._order(JOINT_NAMES), values[:4])
            if len(m.velocity):
                m.velocity = _with(m.velocity, self._order(JOINT_NAMES), values[4:])
        else:
            m.position = _with(m.position, self._order(JOINT_NAMES), values[:4])
            m.effort = _with(m.effort, self._order(ROTOR_NAMES), values[4:])

    def _order(self, names):
        return [self.content.name.index(name) for name in names]


def _with(array, places, values):
    changed = array.copy()
    changed[places] = values
    return changed


class Recording:
    """
    The messages of one bag, in the order of recording.

    Attributes:
        messages: messages in the order of writing.
        meta: metadata of the flight.
        keep: kept share of the file's bytes; below 1 the bag is cut off.

    """

    def __init__(self, messages: list[Message], meta: dict | None = None):
        self.messages, self.meta, self.keep = messages, meta or {}, 1.0

    @classmethod
    def read(cls, path: str | Path, withheld: tuple[str, ...] = WITHHELD) -> Recording:
        """
        Read a bag.

        Args:
            path: path of a rosbag2 folder.
            withheld: ignored topics, with knowledge of a simulator or an estimate.

        """
        found = (Message(m.topic, m.type, m.data, m.received) for m in read_messages(path))
        return cls([m for m in found if m.name not in withheld], _meta(path))

    def write(self, path: str | Path) -> Path:
        """Write a new bag."""
        topics = {m.topic for m in self.messages}
        split = {found for topic in topics if (found := split_topic(topic))}
        namespace = next((space for space, name in split if name in MEASURED), '')
        with BagWriter(path, namespace=namespace,
                       topics=[name for name in TOPICS if (namespace, name) in split]) as writer:
            for m in self.messages:
                writer.write_raw(m.topic, m.type, m.data, m.received)
            writer.meta = self.meta
        if self.keep < 1:
            _cut(Path(path), self.keep)
        return Path(path)

    def copy(self) -> Recording:
        """A copy that can be changed independently."""
        made = Recording([copy(m) for m in self.messages], dict(self.meta))
        made.keep = self.keep
        return made

    def counts(self) -> Counter:
        """Number of messages by topic."""
        return Counter(m.topic for m in self.messages)

    def on(self, name: str) -> list[Message]:
        """Messages of a topic of ``TOPICS``."""
        return [m for m in self.messages if m.name == name]

    def drop(self, *names: str) -> None:
        """Remove topics."""
        self.messages = [m for m in self.messages if m.name not in names]

    def in_order(self) -> None:
        """Sort by time of recording."""
        self.messages.sort(key=lambda m: m.received)

    def stamps(self, name: str) -> np.ndarray:
        """(N,) header stamps [s] of a topic."""
        return np.array([m.stamp for m in self.on(name)])

    def put_stamps(self, name: str, stamps: np.ndarray) -> None:
        """Set the header stamps of a topic; times of recording stay."""
        for m, t in zip(self.on(name), stamps, strict=True):
            m.stamp = float(t)

    def values(self, name: str) -> np.ndarray:
        """
        All values of a topic.

        Returns:
            MoCap (N, 7) position [m] and quaternion xyzw; IMU (N, 6) specific force [m/s^2] and
            rates [rad/s]; joints (N, 8) positions [rad] and velocities [rad/s], (N, 4) without
            recorded velocities; commands (N, 8) tilts [rad] and thrusts [N].

        """
        return np.array([m.numbers() for m in self.on(name)], dtype=float)

    def put(self, name: str, values: np.ndarray) -> None:
        """Set all values of a topic."""
        for m, row in zip(self.on(name), values, strict=True):
            m.put_numbers(row)

    def moment(self, part: float) -> float:
        """Stamp [s] at which ``part`` of the recording is over."""
        stamps = [m.stamp for m in (self.on(MOCAP)[0], self.on(MOCAP)[-1])]
        return stamps[0] + part * (stamps[1] - stamps[0])


def _meta(path):
    file = Path(path) / 'metadata.yaml'
    if not file.is_file():
        return {}
    custom = yaml.safe_load(file.read_text())['rosbag2_bagfile_information']['custom_data']
    return json.loads((custom or {}).get(META_KEY, '{}'))


def _cut(folder, keep):
    """Keep the first bytes, as after a recorder was killed."""
    (folder / 'metadata.yaml').unlink()
    for file in folder.glob('*.mcap'):
        data = file.read_bytes()
        file.write_bytes(data[:int(keep * len(data))])
