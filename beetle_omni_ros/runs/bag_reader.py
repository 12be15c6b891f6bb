"""Reading of flights from bags: into a log, or incrementally into a recorder."""

from collections import Counter
from collections.abc import Container, Iterator
from dataclasses import replace
import json
from pathlib import Path

import numpy as np

from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.messages.bag_types import from_bytes
from beetle_omni_ros.messages.columns import read_all
from beetle_omni_ros.messages.topics import (
    controller_of,
    is_ambiguous,
    split_topic,
    topic_of,
    TOPICS,
)
from beetle_omni_ros.robot.yaml_file import quoted, read_yaml, YamlError
from beetle_omni_ros.runs.bag_files import BagError, Messages, read_together
from beetle_omni_ros.runs.log import FlightLog, SERIES_OF
from beetle_omni_ros.runs.recorder import LogRecorder, Recorder

META_KEY = 'beetle_omni'  # under custom_data of metadata.yaml

# Text entries of the metadata that readers of a log rely on, and their longest length.
META_TEXTS = ('task', 'conditions', 'robot', 'plant', 'controller', 'guidance', 'version')
LONGEST_TEXT = 250
AT_ONCE = 4096      # messages of a series that are read together


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
    recorder = LogRecorder()
    reading = _Reading(str(path), namespace, recorder)
    for together in read_together(path, reading.warnings):
        reading.take(together)
    reading.take_waiting()
    recorder.write_meta(_metadata(path, reading.warnings))
    log = recorder.log()
    log.warnings = reading.finish()
    log.source = str(path)
    return log


def replay(path: str | Path, recorder: Recorder, warnings: list[str], *,
           namespace: str | None = None, leave_out: Container[str] = ()) -> Iterator[np.ndarray]:
    """
    Pass the messages of a bag to a recorder, a few seconds at a time.

    Args:
        path: rosbag2 folder, or one of its files.
        recorder: recorder that accepts series as values whose fields are arrays; other values
            come one by one.
        warnings: list to which missing and unusable data are added at the end.
        namespace: namespace of the robot, if the bag contains several.
        leave_out: topics without namespace to skip; commands of controllers are always skipped.

    Yields:
        (N,) times of recording of the messages so far passed on [s].

    Raises:
        BagError: no such bag, unreadable, not MCAP, or several robots in it.

    """
    reading = _Reading(str(path), namespace, recorder, leave_out)
    for together in read_together(path, reading.warnings):
        reading.take(together)
        reading.take_waiting()
        yield np.concatenate([np.zeros(0), *(messages.received for messages in together)])
    recorder.write_meta(_metadata(path, reading.warnings))
    warnings += reading.finish()


class _Reading:
    """Sorts messages by topic and namespace, and counts unusable ones."""

    def __init__(self, path, namespace, recorder, leave_out=None):
        self.warnings: list[str] = []
        self._recorder, self._left_out = recorder, leave_out
        self._path = path
        self._namespace = None if namespace is None else _rooted(namespace)
        self._chosen = namespace is not None
        self._split = {}
        self._counts: Counter = Counter()
        self._bad: Counter = Counter()
        self._reason: dict[str, str] = {}
        self._waiting: dict[str, tuple[list[bytes], list[np.ndarray]]] = {}

    def take(self, together: list[Messages]) -> None:
        """Read messages; those of a series are collected first, to be read together."""
        # Ambiguous names last: the other topics may determine the namespace.
        for messages in sorted(together, key=lambda one: is_ambiguous(one.topic)):
            name = self._name(messages.topic)
            if name is None:
                continue
            if self._left_out is not None and (name in self._left_out or controller_of(name)):
                self._counts[name] += len(messages.data)
                continue
            kind = topic_of(name).type
            if messages.type != kind:
                self._refuse(name, f'type is {messages.type}, not {kind}', len(messages.data))
            elif name in SERIES_OF or controller_of(name):
                waiting, times = self._waiting.setdefault(name, ([], []))
                waiting += messages.data
                times.append(messages.received)
                if len(waiting) >= AT_ONCE:
                    self.take_waiting(name)
            else:
                for data, received in zip(messages.data, messages.received.tolist(),
                                          strict=True):
                    self._take_one(name, data, received)

    def _take_one(self, name, data, received):
        topic = topic_of(name)
        try:
            value = topic.read(from_bytes(data, topic.type))
            self._recorder.write(name, _stamped(value, received), received)
            self._counts[name] += 1
        except Exception as error:  # an unusable message must not prevent reading the others
            self._refuse(name, str(error) or type(error).__name__)

    def take_waiting(self, *names: str) -> None:
        """Read the collected messages of these topics, or of all."""
        for name in names or list(self._waiting):
            waiting, times = self._waiting.pop(name)
            rows, value, refused = read_all(topic_of(name), waiting)
            if len(rows):
                received = np.concatenate(times)[rows]
                stamp = np.where(value.stamp == 0, received, value.stamp)
                self._recorder.write(name, replace(value, stamp=stamp), received)
            self._counts[name] += len(rows)
            for reason, count in refused.items():
                self._refuse(name, reason, count)

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


def _rooted(namespace):
    return '/' + namespace.strip('/') if namespace.strip('/') else ''


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
    except (YamlError, KeyError, TypeError, AttributeError, ValueError, RecursionError):
        warnings.append('metadata.yaml is not readable')
        return {}
    unusable = [key for key, value in meta.items() if not _usable(key, value)]
    warnings.extend(f'metadata.yaml: {quoted(key)} is not usable, found {quoted(meta[key])}'
                    for key in unusable)
    return {key: value for key, value in meta.items() if key not in unusable}


def _usable(key, value):
    """Whether a value has the type that readers of the log rely on."""
    if value is None:
        return True
    if key == 'seed':
        return isinstance(value, int) and 0 <= value < 1 << 63
    if key in META_TEXTS:
        return isinstance(value, str) and len(value) <= LONGEST_TEXT and value.isprintable()
    return True
