"""Writing rosbag2 folders (metadata.yaml and MCAP) without ROS."""

from __future__ import annotations

from collections.abc import Sequence
import json
import os
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag2 import WriterError
import yaml

from beetle_omni_ros.control.base import Target
from beetle_omni_ros.robot.yaml_file import read_yaml
from beetle_omni_ros.runs import messages
from beetle_omni_ros.runs.bag_reader import BagError, META_KEY, read_bag, read_messages
from beetle_omni_ros.runs.log import COMPUTE_KEYS
from beetle_omni_ros.runs.rosbag2_writer import COMPRESSIONS, JazzyWriter
from beetle_omni_ros.runs.topics import EVENT, Topic, topic_of, TOPICS


class BagWriter:
    """
    Writes one bag; takes the same ``write_*`` calls as ``LogRecorder``.

    Use it as a context manager, or call :meth:`close`. All topics are declared before the
    first message, because rosbag2 cannot read a chunk in which a declaration follows
    messages; a topic that turns up later starts a new chunk.
    """

    keeps_covariances = True

    def __init__(self, path: str | Path, meta: dict | None = None, *, namespace: str = '',
                 topics: Sequence[str] = tuple(TOPICS), compression: str = 'none'):
        """
        Create the folder and the bag in it.

        Args:
            path: folder to create; it must not exist.
            meta: what is known of the flight: task, conditions, seed, robot, version.
            namespace: of the topics, '' or e.g. '/robot1'.
            topics: names to declare, see :func:`~beetle_omni_ros.runs.topics.topic_of`.
            compression: of the chunks in the file, 'none' or 'zstd'.

        Raises:
            BagError: the folder exists or cannot be made; unknown compression.

        """
        self.path = Path(path)
        self.meta: dict = {}
        self._connections: dict[str, Connection] = {}
        self._prefix = '/' + namespace.strip('/') + '/' if namespace.strip('/') else '/'
        self._writer = _open(self.path, compression)
        for name in topics:
            self._declare(self._prefix + name, topic_of(name))
        self._last_t = None      # [s] of the newest message
        if meta:
            self.write_meta(meta)

    def __enter__(self) -> BagWriter:
        """Return self."""
        return self

    def __exit__(self, *exception) -> None:
        """Close the bag, also after an error, so that what was recorded stays readable."""
        self.close()

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {topic: self._writer.counts[c.id] for topic, c in self._connections.items()}

    def _declare(self, topic, entry):
        storage = self._writer.storage
        if storage.chunk.msgs:
            storage.close_chunk()
        self._connections[topic] = self._writer.add_connection(
            topic, entry.type, typestore=messages.TYPESTORE, offered_qos_profiles=[entry.qos])
        return self._connections[topic]

    def write(self, name: str, message, t: float) -> None:
        """
        Write one message of rosbags' type store.

        Args:
            name: without namespace, see :func:`~beetle_omni_ros.runs.topics.topic_of`.
            message: see :mod:`~beetle_omni_ros.runs.messages`.
            t: time of recording [s].

        """
        topic, entry = self._prefix + name, topic_of(name)
        if topic not in self._connections and self._writer is not None:
            self._declare(topic, entry)
        self.write_raw(topic, entry.type, messages.TYPESTORE.serialize_cdr(message, entry.type),
                       t)

    def write_raw(self, topic: str, msgtype: str, data: bytes | memoryview, t: float) -> None:
        """
        Write one message as it came from the wire.

        Args:
            topic: full name.
            msgtype: ROS type, 'sensor_msgs/msg/Imu'; must be one of Jazzy's common types.
            data: CDR.
            t: time of recording [s].

        Raises:
            BagError: unknown type, or the file cannot be written.

        """
        if self._writer is None:
            raise BagError(f'{self.path}: the bag is closed')
        connection = self._connections.get(topic)
        if connection is None:
            if msgtype not in messages.TYPESTORE.types:
                raise BagError(f'{self.path}: topic {topic} has the unknown type {msgtype}')
            connection = self._declare(topic, Topic(msgtype, EVENT))
        first, self._last_t = self._last_t is None, t
        if first and self.meta:     # with a time of the flight
            self._tell_meta()
        try:
            self._writer.write(connection, max(0, messages.nanoseconds(t)), data)
        except OSError as error:
            raise BagError(f'{self.path}: {error.strerror}') from error

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it survives a SIGKILL."""
        if self._writer is None:
            return
        storage = self._writer.storage
        try:
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
        except OSError as error:
            raise BagError(f'{self.path}: {error.strerror}') from error

    def close(self) -> None:
        """Finish the bag: index and metadata.yaml. A second call does nothing."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        if self.meta:
            writer.set_custom_data(META_KEY, json.dumps(self.meta))
        if not any(writer.counts.values()):
            writer.min_timestamp = writer.storage.message_start_time = 0
            writer.storage.chunk.message_start_time = 0
        try:
            writer.close()
        except OSError as error:
            raise BagError(f'{self.path}: {error.strerror}') from error

    def write_meta(self, meta: dict) -> None:
        """Add to what is known of the flight; also in the bag itself, for a cut-off one."""
        self.meta.update(meta)
        if self._last_t is not None:
            self._tell_meta()

    def _tell_meta(self):
        self.write_diagnostic(self._last_t, f'recorder_node: {messages.RUN_STATUS}', self.meta)

    def write_truth(self, t, position, quaternion, velocity, angular_velocity) -> None:
        """Simulated truth; velocity in world, angular velocity in base_link."""
        self.write('ground_truth/odom', messages.odometry(t, position, quaternion, velocity,
                                                          angular_velocity), t)

    def write_odom(self, t, position, quaternion, velocity, angular_velocity,
                   pose_covariance=None, twist_covariance=None) -> None:
        """Record an estimate; velocity in world; covariances (6, 6) as in nav_msgs/Odometry."""
        self.write('odom', messages.odometry(t, position, quaternion, velocity, angular_velocity,
                                             pose_covariance, twist_covariance), t)

    def write_imu(self, t, specific_force, angular_velocity) -> None:
        """One IMU sample in base_link."""
        self.write('imu/data_raw', messages.imu(t, specific_force, angular_velocity), t)

    def write_mocap(self, t, position, quaternion, received=None) -> None:
        """One MoCap pose, captured at ``t``, available at ``received``."""
        self.write('mocap/pose', messages.pose_stamped(t, position, quaternion),
                   t if received is None else received)

    def write_joints(self, t, position, velocity, effort=None, received=None) -> None:
        """One joint feedback, captured at ``t``, available at ``received``."""
        self.write('joint_states', messages.joint_state(t, position, velocity, effort),
                   t if received is None else received)

    def write_battery(self, t, voltage, current) -> None:
        """Pack voltage [V] and current [A, negative when discharging]."""
        self.write('battery_state', messages.battery(t, voltage, current), t)

    def write_command(self, t, tilt, thrust, received=None) -> None:
        """Record the selected command; ``t`` is the stamp of the estimate that it answers."""
        self.write('command', messages.command(t, tilt, thrust),
                   t if received is None else received)

    def write_request(self, controller: str, t, tilt, thrust, received=None) -> None:
        """What one controller asked for, before the supervisor."""
        self.write(f'{controller}/command', messages.command(t, tilt, thrust),
                   t if received is None else received)

    def write_wrench(self, t, force_world, torque_body) -> None:
        """External wrench from ``t`` until the next."""
        self.write('disturbance', messages.wrench(t, force_world, torque_body), t)

    def write_target(self, target: Target, received=None) -> None:
        """One pose or trajectory target, in force from its stamp."""
        name, message = messages.target_message(target)
        self.write(name, message, target.stamp if received is None else received)

    def write_state(self, t, state: str) -> None:
        """Record the supervisor's state, e.g. 'flying:nmpc', whenever it changes."""
        self.write('supervisor/state', messages.String(state), t)

    def write_compute(self, t, controller: str, **times) -> None:
        """CPU time of one controller's steps since its start, as ``LogRecorder`` takes it."""
        values = {key: times[name] for key, name in COMPUTE_KEYS.items()}
        self.write_diagnostic(t, f'{controller}_node: {messages.COMPUTE_STATUS}', values)

    def write_diagnostic(self, t, name: str, values: dict, level: int = 0,
                         message: str = '') -> None:
        """One status of one node."""
        self.write('diagnostics', messages.diagnostic(t, name, values, level, message), t)


def check_new(path: str | Path, compression: str = 'none') -> None:
    """
    Refuse a bag that cannot be written, before the flight.

    Raises:
        BagError: the folder exists, or its nearest existing parent is no writable folder;
            unknown compression.

    """
    if compression not in COMPRESSIONS:
        raise BagError(f"compression '{compression}': expected {' or '.join(COMPRESSIONS)}")
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise BagError(f'{path}: exists already; a bag needs a new folder')
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir():
        raise BagError(f'{path}: {parent} is not a folder')
    if not os.access(parent, os.W_OK | os.X_OK):
        raise BagError(f'{path}: no permission to write in {parent}')


def _open(path, compression):
    check_new(path, compression)
    try:
        writer = JazzyWriter(path, compression)
        writer.open()
    except (OSError, WriterError) as error:
        reason = getattr(error, 'strerror', None) or error
        raise BagError(f'{path}: cannot write a bag there ({reason})') from None
    return writer


def add_meta(path: str | Path, meta: dict) -> None:
    """
    Add to a finished bag what is known of its flight: task, conditions, seed, robot.

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


__all__ = ['add_meta', 'BagError', 'BagWriter', 'check_new', 'read_bag', 'read_messages']
