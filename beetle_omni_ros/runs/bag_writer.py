"""Writing of rosbag2 folders as ``ros2 bag record`` of Jazzy does, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import contextmanager
from io import BytesIO
import json
from math import isfinite
import os
from pathlib import Path
import struct
from typing import Any, ClassVar

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.rosbag2.storage_mcap import McapWriter, write_channel, write_string
from rosbags.serde import SerdeError
import yaml

from beetle_omni_ros.messages.bag_types import from_bytes, new, offered, to_bytes, TYPESTORE
from beetle_omni_ros.messages.conversions import BODY, nanoseconds, WORLD
from beetle_omni_ros.messages.topics import ALL, EVENT, LATCHED, Qos, topic_of, TOPICS
from beetle_omni_ros.robot.schema import read_yaml
from beetle_omni_ros.robot.urdf import description, joints
from beetle_omni_ros.runs.bag import BagError, META_KEY
from beetle_omni_ros.runs.log import Recorder, RUN_STATUS

VERSION = 9     # of metadata.yaml
DISTRIBUTION = 'jazzy'
# Compression of the chunks in the MCAP file, which every reader supports; 'zstd' is like the
# preset `zstd_fast` of rosbag2.
COMPRESSIONS = ('none', 'zstd')
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
TEXT = 'std_msgs/msg/String'
PERIOD = 0.02       # [s] between transforms


def _from_jazzy(metadata):
    return metadata.replace('ros_distro: rosbags', f'ros_distro: {DISTRIBUTION}')


class JazzyStorage(McapWriter):
    """MCAP with the hash of each type."""

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Declare a topic."""
        buffer = self.chunk.bio
        start = buffer.tell()
        super().add_connection(connection, offered_qos_profiles)
        entry = BytesIO()
        write_string(entry, 'topic_type_hash')
        write_string(entry, connection.digest)
        channel = self.channels[-1]
        self.channels[-1] = channel._replace(metadata=channel.metadata + entry.getvalue())
        buffer.seek(start)
        write_channel(buffer, self.channels[-1], self.schemas)

    def close(self, version: int, metadata: str) -> None:
        """Write index and metadata."""
        super().close(version, _from_jazzy(metadata))


class JazzyWriter(Writer):
    """rosbags' writer with :class:`JazzyStorage`."""

    STORAGE_PLUGINS: ClassVar = {StoragePlugin.MCAP: JazzyStorage}

    def close(self) -> None:
        """Finish the bag."""
        super().close()
        self.metapath.write_text(_from_jazzy(self.metapath.read_text('utf8')), 'utf8')


class FrameWriter:
    """
    Converts `odom` and `joint_states` to transforms, 50 times a second.

    Args:
        write: called with topic, ROS type, CDR and time [s].
        prefix: prefix of the robot's topics, '/' or e.g. '/robot1/'.

    """

    def __init__(self, write: Callable[[str, str, bytes, float], None], prefix: str):
        self._write, self._text = write, description()
        self._odom, self._joints = f'{prefix}odom', f'{prefix}joint_states'
        self.topics = {'/tf': (TRANSFORMS, EVENT), '/tf_static': (TRANSFORMS, LATCHED),
                       f'{prefix}robot_description': (TEXT, LATCHED)}
        tree = joints()
        self._fixed = [joint for joint in tree if joint.axis is None]
        self._moving = {joint.name: joint for joint in tree if joint.axis is not None}
        self._latest = None     # message of joint_states
        self._due = None

    def take(self, topic: str, data: bytes | memoryview, t: float) -> None:
        """Process a message recorded at ``t`` [s], and write transforms if they are due."""
        try:
            if topic == self._joints:
                self._latest = data
            elif topic == self._odom and self._latest is not None \
                    and (self._due is None or t >= self._due):
                self._follow(data, t)
        except (LookupError, TypeError, ValueError, SerdeError, struct.error):
            pass        # an unreadable message is recorded as it is, without transforms

    def _follow(self, data, t):
        joints = from_bytes(self._latest, 'sensor_msgs/msg/JointState')
        stamp, angles = joints.header.stamp, dict(zip(joints.name, joints.position))
        odom = from_bytes(data, 'nav_msgs/msg/Odometry')
        if not angles.keys() >= self._moving.keys():
            return
        if self._due is None:
            self._begin(odom.header.stamp, t)
        self._due = t + PERIOD if self._due is None else max(self._due + PERIOD, t)
        at, turn = odom.pose.pose.position, odom.pose.pose.orientation
        frames = [(WORLD, BODY, odom.header.stamp, (at.x, at.y, at.z),
                   (turn.x, turn.y, turn.z, turn.w)),
                  *((joint.parent, joint.child, stamp, joint.position, joint.turned(angles[name]))
                    for name, joint in self._moving.items())]
        if all(isfinite(x) for *_, position, quaternion in frames for x in (
                *position, *quaternion)):
            self._write('/tf', TRANSFORMS, _transforms(frames), t)

    def _begin(self, stamp, t):
        self._write('/tf_static', TRANSFORMS, _transforms(
            [(joint.parent, joint.child, stamp, joint.position, joint.quaternion)
             for joint in self._fixed]), t)
        text = new(TEXT)
        text.data = self._text
        self._write(list(self.topics)[-1], TEXT, to_bytes(text, TEXT), t)


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


class BagWriter(Recorder):
    """
    Writes one bag; a context manager, or call :meth:`close`.

    Topics are declared before the first message, because rosbag2 cannot read a chunk in which a
    declaration follows messages. A topic that is declared later starts a new chunk.
    """

    keeps_covariances = True

    def __init__(self, path: str | Path, meta: dict | None = None, *, namespace: str = '',
                 topics: Sequence[str] = tuple(TOPICS), compression: str = 'none',
                 frames: bool = False, epoch: int = 0):
        """
        Create the folder and the bag in it.

        Args:
            path: folder to create; it must not exist.
            meta: metadata of the flight: task, conditions, seed, robot, version.
            namespace: namespace of the topics, '' or e.g. '/robot1'.
            topics: names to declare, see :func:`~beetle_omni_ros.messages.topics.topic_of`.
            compression: compression of the chunks in the file, 'none' or 'zstd'.
            frames: whether the description and the frames of the robot are recorded.
            epoch: UNIX time of time 0 [s], so that a flight that begins at 0 s gets a real date.

        Raises:
            BagError: the folder exists or cannot be made.

        """
        self.path = Path(path)
        self.meta: dict = {}
        self._epoch = int(epoch)
        self._connections: dict[str, Connection] = {}
        self._prefix = '/' + namespace.strip('/') + '/' if namespace.strip('/') else '/'
        check_new(self.path)
        try:
            self._writer: JazzyWriter | None = JazzyWriter(
                self.path, version=VERSION, storage_plugin=StoragePlugin.MCAP)
            if compression == 'zstd':
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except (OSError, WriterError) as error:
            reason = getattr(error, 'strerror', None) or error
            raise BagError(f'{path}: cannot write a bag there ({reason})') from None
        for name in topics:
            self._declare(self._prefix + name, topic_of(name).type, topic_of(name).qos)
        self._frames = None
        if frames:
            self._frames = FrameWriter(self.write_raw, self._prefix)
            for name, (msgtype, qos) in self._frames.topics.items():
                self._declare(name, msgtype, qos)
        self._last_t = None      # [s] of the newest message
        if meta:
            self.write_meta(meta)

    def __enter__(self) -> BagWriter:
        return self

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
        if name not in self._connections and self._writer is not None:
            self._declare(name, entry.type, entry.qos)
        if received is None:
            received = value[0].t if isinstance(value, list) else value.stamp
        message = entry.write(value)
        if self._epoch and hasattr(message, 'header'):
            message.header.stamp.sec += self._epoch
        self.write_raw(name, entry.type, to_bytes(message, entry.type), received)

    def write_raw(self, topic: str, msgtype: str, data: bytes | memoryview, t: float) -> None:
        """
        Write one serialised message.

        Args:
            topic: full name.
            msgtype: ROS type such as 'sensor_msgs/msg/Imu'; one of Jazzy's common types.
            data: CDR.
            t: time of recording since ``epoch`` [s].

        Raises:
            BagError: unknown type, or the file cannot be written.

        """
        if self._writer is None:
            raise BagError(f'{self.path}: the bag is closed')
        connection = self._connections.get(topic)
        if connection is None:
            if msgtype not in TYPESTORE.types:
                raise BagError(f'{self.path}: topic {topic} has the unknown type {msgtype}')
            ours = ALL.get(topic.removeprefix(self._prefix))
            connection = self._declare(topic, msgtype, ours.qos if ours else EVENT)
        first, self._last_t = self._last_t is None, t
        if first and self.meta:     # now a time of the flight is known
            self._tell_meta()
        with self._disk():
            self._writer.write(connection, max(0, nanoseconds(t)) + self._epoch * 1_000_000_000,
                               data)
        if self._frames is not None:
            self._frames.take(topic, data, t)

    def flush(self) -> None:
        """Pass the written data to the operating system, so that it survives a SIGKILL."""
        if self._writer is None:
            return
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
    def _disk(self):
        try:
            yield
        except OSError as error:
            raise BagError(f'{self.path}: {error.strerror}') from error

    def write_meta(self, meta: dict) -> None:
        """Add metadata; also written as a message, for a bag without metadata.yaml."""
        self.meta.update(meta)
        if self._last_t is not None:
            self._tell_meta()

    def _tell_meta(self):
        self.write_diagnostic(self._last_t, f'recorder_node: {RUN_STATUS}', self.meta)


def check_new(path: str | Path) -> None:
    """
    Check before a flight that its bag can be written.

    Raises:
        BagError: the folder exists, or its nearest existing parent is no writable folder.

    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise BagError(f'{path}: exists already; a bag needs a new folder')
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir():
        raise BagError(f'{path}: {parent} is not a folder')
    if not os.access(parent, os.W_OK | os.X_OK):
        raise BagError(f'{path}: no permission to write in {parent}')


def add_meta(path: str | Path, meta: dict) -> None:
    """
    Add metadata of the flight to a finished bag: task, conditions, seed, robot.

    Raises:
        BagError: the folder has no usable metadata.yaml.

    """
    file = Path(path) / 'metadata.yaml'
    try:
        content = read_yaml(file)
        information = content['rosbag2_bagfile_information']
        custom = information['custom_data'] or {}
        known = json.loads(custom.get(META_KEY, '{}'))
        information['custom_data'] = {**custom, META_KEY: json.dumps({**known, **meta})}
        temporary = file.with_suffix('.yaml.tmp')
        temporary.write_text(yaml.safe_dump(content))
        temporary.replace(file)
    except OSError as error:
        raise BagError(f'{file}: {error.strerror}') from None
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError):
        raise BagError(f'{file}: not the metadata of a rosbag2 folder') from None
