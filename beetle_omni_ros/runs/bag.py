"""
Reading of rosbag2 folders (metadata.yaml and MCAP) without ROS, also of truncated files.

Flights are read into a log, or incrementally into a recorder.
"""

from collections import Counter
from collections.abc import Container, Iterable, Iterator
from dataclasses import replace
from itertools import islice
import json
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.writer import MCAP0_MAGIC
import numpy as np

from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.messages.bag_types import from_bytes, read_all
from beetle_omni_ros.messages.conversions import from_nanoseconds
from beetle_omni_ros.messages.topics import (
    controller_of,
    is_ambiguous,
    split_topic,
    topic_of,
    TOPICS,
)
from beetle_omni_ros.robot.schema import quoted, read_yaml
from beetle_omni_ros.runs.log import FlightLog, LogRecorder, Recorder, SERIES_OF

AT_ONCE = 4096      # messages that are read together
META_KEY = 'beetle_omni'  # under custom_data of metadata.yaml

# Text entries of the metadata that readers of a log rely on, and their longest length.
META_TEXTS = ('task', 'conditions', 'robot', 'plant', 'controller', 'guidance', 'version')
LONGEST_TEXT = 250


class BagError(ValueError):
    """A bag cannot be written or read; the text names the folder or file."""


class RawMessage(NamedTuple):
    """One message: full topic, ROS type, CDR, time of recording [s]."""

    topic: str
    type: str
    data: bytes
    received: float


class Messages(NamedTuple):
    """Messages of one topic in the order of the file: CDR, (N,) times of recording [s]."""

    topic: str
    type: str
    data: list[bytes]
    received: np.ndarray


class _WholeReads:
    """A stream whose reads are complete or raise EOFError, to detect the end of a cut file."""

    def __init__(self, stream):
        self._stream = stream

    def read(self, size):
        data = self._stream.read(size)
        if len(data) < size:
            raise EOFError
        return data


class _Records(StreamReader):
    """Records of a file, without the content of message indices, which is not needed."""

    def _read_record(self, opcode, length):
        return None if opcode == Opcode.MESSAGE_INDEX else super()._read_record(opcode, length)


def bag_files(path: str | Path) -> list[Path]:
    """
    Find the MCAP files of a RUN.

    Args:
        path: rosbag2 folder, its metadata.yaml or one of its ``.mcap`` files.

    Raises:
        BagError: no such path, or no MCAP file there.

    """
    path = Path(path)
    if not path.exists():
        raise BagError(f'{path}: no such bag')
    if path.name == 'metadata.yaml':
        path = path.absolute().parent
    if path.is_file():
        if path.suffix != '.mcap':
            raise BagError(f'{path}: expected a rosbag2 folder or a .mcap file')
        return [path]
    files = sorted(path.glob('*.mcap'), key=_split_number)
    if not files:
        other = sorted(p.name for pattern in ('*.db3', '*.mcap.*', '*.bag')
                       for p in path.glob(pattern))
        hint = f' (found {other[0]}; convert it with ros2 bag convert)' if other else ''
        raise BagError(f'{path}: no .mcap file in this folder{hint}')
    return files


def runs_in(paths: Iterable[str | Path]) -> list[Path]:
    """Paths of RUN arguments, with the bags in a folder of bags in its place."""
    runs: list[Path] = []
    for path in map(Path, paths):
        inside = []
        if path.is_dir() and not any(path.glob('*.mcap')):
            inside = sorted({file.parent for file in path.glob('*/*.mcap')})
        runs += inside or [path]
    return runs


def no_pose(path: str | Path, warnings: list[str]) -> BagError:
    """Error for a bag without a pose; ``warnings`` of its reading may give the reason."""
    return BagError('; '.join([f'{path}: no pose of the robot; expected ground_truth/odom or '
                               'odom', *warnings]))


def _split_number(file):
    """Sort key of a split bag: name_2.mcap comes before name_10.mcap."""
    number = file.stem.rpartition('_')[2]
    return (int(number) if number.isdigit() else -1, file.name)


def names_of(runs: list[Path]) -> list[str]:
    """Shortest endings of the paths that are all different, numbered if none are."""
    paths = [run.absolute().parts for run in runs]
    for depth in range(1, max((len(parts) for parts in paths), default=1) + 1):
        names = ['/'.join(parts[-depth:]) for parts in paths]
        if len(set(names)) == len(names):
            return names
    return [f'{name} ({k + 1})' for k, name in enumerate(names)] if runs else []


def read_messages(path: str | Path, warnings: list[str] | None = None) -> Iterator[RawMessage]:
    """
    Yield the messages of a bag in the order of recording, up to a truncation.

    Args:
        path: folder or file, see :func:`bag_files`.
        warnings: list to which a line is added for each truncated or damaged file.

    Raises:
        BagError: no such bag, unreadable, or not MCAP.

    """
    found, broken = 0, ''
    for file in bag_files(path):
        count, schemas, known = 0, {0: ''}, {}
        try:
            with file.open('rb') as stream:
                # A shorter file may be an MCAP file that was cut off.
                if not MCAP0_MAGIC.startswith(stream.read(MAGIC_SIZE)):
                    raise BagError(f'{file}: not an MCAP file')
                stream.seek(0)
                for record in _Records(_WholeReads(stream), validate_crcs=True).records:
                    if isinstance(record, Message):
                        count += 1
                        yield RawMessage(*known[record.channel_id], record.data,
                                         from_nanoseconds(record.log_time))
                    elif isinstance(record, Schema):
                        schemas[record.id] = record.name
                    elif isinstance(record, Channel):
                        known[record.id] = record.topic, schemas[record.schema_id]
        except OSError as error:
            raise BagError(f'{file}: {error.strerror}') from None
        except BagError:
            raise
        except Exception as error:  # broken bytes raise anything in the library
            kind = 'cut off' if isinstance(error, EOFError) else \
                f'damaged ({type(error).__name__}: {error})'
            broken = f'{file.name}: {kind} after {count} readable messages'
            if warnings is not None:
                warnings.append(broken)
        found += count
    if broken and not found:
        raise BagError(f"{path}: {broken}; 'mcap recover' of the mcap tool may save more")


def read_together(path: str | Path, warnings: list[str] | None = None
                  ) -> Iterator[list[Messages]]:
    """
    Yield the messages of a bag by topic, a few seconds at a time.

    Arguments and errors are as in :func:`read_messages`. Topics are in the order of their first
    message.
    """
    messages = read_messages(path, warnings)
    while part := list(islice(messages, AT_ONCE)):
        groups: dict[tuple[str, str], tuple[list, list]] = {}
        for topic, kind, data, received in part:
            all_data, times = groups.setdefault((topic, kind), ([], []))
            all_data.append(data)
            times.append(received)
        yield [Messages(*name, data, np.array(times)) for name, (data, times) in groups.items()]


def read_bag(path: str | Path, *, namespace: str | None = None) -> FlightLog:
    """
    Read a flight.

    Args:
        path: rosbag2 folder, or one of its files.
        namespace: namespace of the robot, if the bag contains several.

    Returns:
        The flight; its ``warnings`` list missing and unusable data.

    Raises:
        BagError: no such bag, unreadable, not MCAP, or several robots in it.

    """
    recorder, warnings = LogRecorder(), []
    for _ in replay(path, recorder, warnings, namespace=namespace):
        pass
    log = recorder.log()
    log.warnings, log.source = warnings, str(path)
    return log


def replay(path: str | Path, recorder: Recorder, warnings: list[str], *,
           namespace: str | None = None, leave_out: Container[str] | None = None
           ) -> Iterator[np.ndarray]:
    """
    Pass the messages of a bag to a recorder, a few seconds at a time, as :func:`read_bag` does.

    Args:
        path: rosbag2 folder, or one of its files.
        recorder: recorder that accepts values whose fields are arrays; texts come one by one.
        warnings: list to which missing and unusable data are added at the end.
        namespace: namespace of the robot, if the bag contains several.
        leave_out: topics without namespace to skip, beside commands of controllers; None: none.

    Yields:
        (N,) times of recording of the messages so far passed on [s].

    """
    reading = _Reading(str(path), namespace, recorder, leave_out)
    for together in read_together(path, reading.warnings):
        # Ambiguous names last: the other topics may determine the namespace.
        for messages in sorted(together, key=lambda one: is_ambiguous(one.topic)):
            reading.take(messages)
        yield np.concatenate([messages.received for messages in together])
    recorder.write_meta(_metadata(path, reading.warnings))
    warnings += reading.finish()


class _Reading:
    """Sorts messages by topic and namespace, and counts unusable ones."""

    def __init__(self, path, namespace, recorder, leave_out):
        self.warnings: list[str] = []
        self._recorder, self._left_out = recorder, leave_out
        self._path = path
        self._namespace = namespace and f"/{namespace.strip('/')}".rstrip('/')
        self._chosen = namespace is not None
        self._split = {}
        self._counts: Counter = Counter()
        self._bad: Counter = Counter()
        self._reason: dict[str, str] = {}

    def take(self, messages: Messages) -> None:
        """Read messages of one topic; those of a series together."""
        name = self._name(messages.topic)
        if name is None:
            return
        topic, count = topic_of(name), len(messages.data)
        if self._left_out is not None and (name in self._left_out or controller_of(name)):
            self._counts[name] += count
        elif messages.type != topic.type:
            self._refuse(name, f'type is {messages.type}, not {topic.type}', count)
        elif name in SERIES_OF or controller_of(name):
            rows, value, refused = read_all(topic, messages.data)
            if len(rows):
                received = messages.received[rows]
                stamp = np.where(value.stamp == 0, received, value.stamp)
                self._recorder.write(name, replace(value, stamp=stamp), received)
            self._counts[name] += len(rows)
            for reason, number in refused.items():
                self._refuse(name, reason, number)
        else:
            for data, received in zip(messages.data, messages.received.tolist(), strict=True):
                try:
                    value = topic.read(from_bytes(data, topic.type))
                    self._recorder.write(name, _stamped(value, received), received)
                    self._counts[name] += 1
                except Exception as error:  # must not prevent reading the others
                    self._refuse(name, str(error) or type(error).__name__)

    def _name(self, topic):
        """Name without namespace; None for a topic that is unknown or still ambiguous."""
        if topic not in self._split:
            if self._namespace is None and is_ambiguous(topic):
                return None     # until another topic determines the robot's namespace
            self._split[topic] = self._recognise(topic)
        return self._split[topic]

    def _refuse(self, name, reason, count=1):
        self._bad[name] += count
        self._reason.setdefault(name, reason)

    def _recognise(self, topic):
        split = split_topic(topic, () if self._namespace is None else (self._namespace,))
        if split is None:
            return None
        namespace, name = split
        if name == 'diagnostics' and namespace == '':
            return name
        if self._namespace is None:
            self._namespace = namespace
        if namespace != self._namespace:
            if self._chosen or name == 'diagnostics':
                return None
            raise BagError(f"{self._path}: holds several robots ('{self._namespace}' and "
                           f"'{namespace}'); choose one namespace")
        return name

    def finish(self):
        missing = [name for name, topic in TOPICS.items()
                   if topic.required and not self._counts[name]]
        if 'target_pose' in missing and self._counts['target_trajectory']:
            missing.remove('target_pose')
        if missing:
            self.warnings.append(f"no message on {', '.join(missing)}")
        for name, count in self._bad.items():
            self.warnings.append(f'{name}: {count} messages not used ({self._reason[name]})')
        return self.warnings


def _stamped(value, received):
    """The value; without a stamp (`ros2 topic pub`), it gets the time of receipt."""
    if isinstance(value, list):
        return [entry if entry.t else replace(entry, t=received) for entry in value]
    if isinstance(value, str) or value.stamp:
        return value
    if isinstance(value, TrajectoryTarget):
        return replace(value, stamp=received, times=value.times + received)
    return replace(value, stamp=received)


def _metadata(path, warnings):
    """Metadata of a finished bag; empty if there is none."""
    path = Path(path)
    file = (path if path.is_dir() else path.absolute().parent) / 'metadata.yaml'
    if not file.is_file():
        warnings.append('metadata.yaml is missing: the recorder did not finish')
        return {}
    try:
        custom = read_yaml(file)['rosbag2_bagfile_information']['custom_data']
        meta = dict(json.loads((custom or {}).get(META_KEY, '{}')))
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError):
        warnings.append('metadata.yaml is not readable')
        return {}
    used = {key: value for key, value in meta.items() if _usable(key, value)}
    warnings.extend(f'metadata.yaml: {quoted(key)} is not usable, found {quoted(value)}'
                    for key, value in meta.items() if key not in used)
    return used


def _usable(key, value):
    """Whether a value has the type that readers of the log rely on."""
    if value is None or key not in ('seed', *META_TEXTS):
        return True
    return isinstance(value, int) and 0 <= value < 1 << 63 if key == 'seed' else \
        isinstance(value, str) and len(value) <= LONGEST_TEXT and value.isprintable()
