"""Writing of rosbag2 folders as ``ros2 bag record`` of Jazzy does, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
import json
from math import isfinite
import os
from pathlib import Path
import struct
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.serde import SerdeError
import yaml

from beetle_omni_ros.bags.conversions import BODY, nanoseconds, WORLD
from beetle_omni_ros.bags.log import META_KEY, Recorder
from beetle_omni_ros.bags.messages import from_bytes, new, offered, to_bytes, TYPESTORE
from beetle_omni_ros.bags.topics import ALL, EVENT, LATCHED, Qos, topic_of
from beetle_omni_ros.model.files import write_text
from beetle_omni_ros.model.schema import ParameterError, read_yaml, RunError
from beetle_omni_ros.model.urdf import description, links

VERSION = 9     # of metadata.yaml
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
TEXT = 'std_msgs/msg/String'
# Topic -> type and quality of service of what FrameWriter writes.
FRAMES = {'/tf': (TRANSFORMS, EVENT), '/tf_static': (TRANSFORMS, LATCHED),
          'robot_description': (TEXT, LATCHED)}
PERIOD = 0.02       # [s] between transforms


class FrameWriter:
    """Converts `odom` and `joint_states` to transforms, 50 times a second; writes the URDF too."""

    def __init__(self, write: Callable[[str, str, bytes, float], None], prefix: str):
        self._write, self._text, self._prefix = write, description(), prefix
        tree = [link for link in links() if link.parent]
        self._fixed = [link for link in tree if not link.joint]
        self._moving = {link.joint: link for link in tree if link.joint}
        self._latest = None     # message of joint_states
        self._due = None

    def take(self, topic: str, data: bytes | memoryview, t: float) -> None:
        """Process a message recorded at ``t`` [s], and write transforms if they are due."""
        if topic == f'{self._prefix}joint_states':
            self._latest = data
        elif topic == f'{self._prefix}odom' and self._latest is not None \
                and (self._due is None or t >= self._due):
            # An unreadable message is recorded as it is, without transforms.
            with suppress(LookupError, TypeError, ValueError, SerdeError, struct.error):
                self._follow(data, t)

    def _follow(self, data, t):
        joints = from_bytes(self._latest, 'sensor_msgs/msg/JointState')
        stamp, angles = joints.header.stamp, dict(zip(joints.name, joints.position))
        odom = from_bytes(data, 'nav_msgs/msg/Odometry')
        at, turn = odom.pose.pose.position, odom.pose.pose.orientation
        frames = [(WORLD, BODY, odom.header.stamp, (at.x, at.y, at.z),
                   (turn.x, turn.y, turn.z, turn.w)),
                  *((link.parent, link.name, stamp, link.position, link.turned(angles[name]))
                    for name, link in self._moving.items())]
        if not all(isfinite(x) for *_, position, quaternion in frames
                   for x in (*position, *quaternion)):
            return
        if self._due is None:
            self._write('/tf_static', TRANSFORMS, _transforms(
                [(link.parent, link.name, odom.header.stamp, link.position, link.quaternion)
                 for link in self._fixed]), t)
            text = new(TEXT)
            text.data = self._text
            self._write(f'{self._prefix}robot_description', TEXT, to_bytes(text, TEXT), t)
        self._due = t + PERIOD if self._due is None else max(self._due + PERIOD, t)
        self._write('/tf', TRANSFORMS, _transforms(frames), t)


def _transforms(frames):
    """CDR of frames: parent, child, stamp, position, quaternion."""
    message = new(TRANSFORMS)
    for parent, child, stamp, position, quaternion in frames:
        frame = new('geometry_msgs/msg/TransformStamped')
        frame.header.frame_id, frame.child_frame_id, frame.header.stamp = parent, child, stamp
        at, turn = frame.transform.translation, frame.transform.rotation
        at.x, at.y, at.z = map(float, position)
        turn.x, turn.y, turn.z, turn.w = map(float, quaternion)
        message.transforms.append(frame)
    return to_bytes(message, TRANSFORMS)


class BagWriter(Recorder, AbstractContextManager):
    """
    Writes one bag; a context manager, or call :meth:`close`.

    Topics are declared before the first message, because rosbag2 cannot read a chunk in which a
    declaration follows messages. A topic that is declared later starts a new chunk.
    """

    def __init__(self, path: str | Path, meta: dict | None = None, *, namespace: str = '',
                 topics: Sequence[str] | None = None, frames: bool = False):
        """
        Create the folder and the bag in it.

        Args:
            path: folder to create; it must not exist.
            meta: metadata of the flight: task, conditions, seed, robot, version.
            namespace: namespace of the topics, '' or e.g. '/robot1'.
            topics: names to declare; default: those of the table.
            frames: whether the description and the frames of the robot are recorded.

        Raises:
            ParameterError: as of :func:`check_new`.

        """
        self.path = Path(path)
        self.meta = dict(meta or {})
        self._connections: dict[str, Connection] = {}
        self._prefix = '/' + namespace.strip('/') + '/' if namespace.strip('/') else '/'
        check_new(self.path)
        self._writer: Writer | None = Writer(self.path, version=VERSION,
                                             storage_plugin=StoragePlugin.MCAP)
        with self._disk(ParameterError):
            self._writer.open()
        for name in ALL if topics is None else topics:
            self._declare(self._prefix + name, topic_of(name).type, topic_of(name).qos)
        self._frames = None
        if frames:
            self._frames = FrameWriter(self.write_raw, self._prefix)
            for name, kind in FRAMES.items():
                self._declare(name if name.startswith('/') else self._prefix + name, *kind)

    def __exit__(self, *exception) -> None:
        """Close the bag, also after an error, so that it is readable."""
        self.close()

    @property
    def counts(self) -> dict[str, int]:
        """Topic -> number of messages written so far."""
        return {topic: self._writer.counts[c.id] for topic, c in self._connections.items()}

    def _declare(self, topic: str, msgtype: str, qos: Qos) -> Connection:
        storage = self._writer.storage
        if storage.chunk.msgs:
            storage.close_chunk()
        self._connections[topic] = self._writer.add_connection(
            topic, msgtype, typestore=TYPESTORE, offered_qos_profiles=[offered(qos)])
        return self._connections[topic]

    def write(self, topic: str, value: Any, received: float | None = None) -> None:
        """Write one value, see :class:`Recorder`."""
        name, entry = self._prefix + topic, topic_of(topic)
        if name not in self._connections:
            self._declare(name, entry.type, entry.qos)
        if received is None:
            received = value[0].t if isinstance(value, list) else value.stamp
        try:
            message = entry.write(value)
        except AttributeError:      # of a component of a user
            raise ParameterError(f"topic '{topic}': expected a {entry.value.__name__}, "
                                 f'found {type(value).__name__}') from None
        self.write_raw(name, entry.type, to_bytes(message, entry.type), received)

    def write_raw(self, topic: str, msgtype: str, data: bytes | memoryview, t: float) -> None:
        """
        Write one serialised message.

        Args:
            topic: full name.
            msgtype: ROS type such as 'sensor_msgs/msg/Imu'; one of Jazzy's common types.
            data: CDR.
            t: time of recording [s].

        Raises:
            RunError: the file cannot be written.

        """
        connection = self._connections.get(topic)
        if connection is None:
            ours = ALL.get(topic.removeprefix(self._prefix))
            connection = self._declare(topic, msgtype, ours.qos if ours else EVENT)
        with self._disk():
            self._writer.write(connection, max(0, nanoseconds(t)), data)
        if self._frames is not None:
            self._frames.take(topic, data, t)

    def flush(self) -> None:
        """Pass the written data to the operating system, so that it survives a SIGKILL."""
        storage = self._writer.storage
        with self._disk():
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()

    def close(self) -> None:
        """Write index and metadata.yaml. A second call does nothing."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        if self.meta:
            writer.set_custom_data(META_KEY, json.dumps(self.meta))
        if not any(writer.counts.values()):
            writer.min_timestamp = writer.storage.message_start_time = 0
            writer.storage.chunk.message_start_time = 0
        with self._disk():
            writer.close()

    @contextmanager
    def _disk(self, kind=RunError):
        try:
            yield
        except OSError as error:
            raise kind(f'{self.path}: {error.strerror}') from error

    def write_meta(self, meta: dict) -> None:
        """Add metadata."""
        self.meta.update(meta)


def check_new(path: str | Path) -> None:
    """
    Check before a flight that its bag can be written.

    Raises:
        ParameterError: the folder exists, or its nearest existing parent is no writable folder.

    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise ParameterError(f'{path}: exists already; a bag needs a new folder')
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise ParameterError(f'{path}: {parent} is not a folder that can be written')


def set_meta(path: str | Path, meta: dict) -> None:
    """Set the metadata of the flight in a finished bag of a :class:`BagWriter`."""
    file = Path(path) / 'metadata.yaml'
    content = read_yaml(file)
    content['rosbag2_bagfile_information']['custom_data'] = {META_KEY: json.dumps(meta)}
    write_text(file, yaml.safe_dump(content), 'metadata')
