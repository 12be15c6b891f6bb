"""Flights from bags: by topic into a log, or message by message to a recorder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
import json
from math import inf
from pathlib import Path

import numpy as np

from beetle_omni_ros.control.base import TrajectoryTarget
from beetle_omni_ros.messages.bag_types import from_bytes
from beetle_omni_ros.messages.columns import read_all
from beetle_omni_ros.messages.topics import (
    is_ambiguous,
    requester,
    split_topic,
    topic_of,
    TOPICS,
)
from beetle_omni_ros.messages.values import MessageError
from beetle_omni_ros.robot.yaml_file import quoted, read_yaml, YamlError
from beetle_omni_ros.runs.bag_files import (
    BagError,
    Messages,
    RawMessage,
    read_messages,
    read_together,
)
from beetle_omni_ros.runs.log import FlightLog, SERIES_OF
from beetle_omni_ros.runs.recorder import LogRecorder

META_KEY = 'beetle_omni'  # under custom_data of metadata.yaml

# Entries of it by which a flight is judged, and how long they may be.
META_TEXTS = ('task', 'conditions', 'robot', 'plant', 'controller', 'guidance', 'version')
LONGEST_TEXT = 250
AT_ONCE = 4096      # messages of a series that are read together


def read_bag(path: str | Path, *, namespace: str | None = None) -> FlightLog:
    """
    Read a flight.

    Args:
        path: rosbag2 folder, or one of its files.
        namespace: of the robot, where the bag holds several.

    Returns:
        The flight; what was missing or wrong stands in its ``warnings``.

    Raises:
        BagError: no such bag, unreadable, not MCAP, or several robots in it.

    """
    recorder = LogRecorder()
    reading = _Reading(str(path), namespace, recorder)
    for together in read_together(path, reading.warnings):
        # Where a namespace is not yet known, names that leave it open wait for the others.
        for messages in sorted(together, key=lambda one: is_ambiguous(one.topic)):
            reading.take_together(messages)
    reading.take_waiting()
    recorder.write_meta(_metadata(path, reading.warnings))
    log = recorder.log()
    log.warnings = reading.finish()
    log.source = str(path)
    return log


def replay(path: str | Path, recorder, warnings: list[str], *, namespace: str | None = None,
           spacing: Callable[[str], float] = lambda _: 0.0) -> Iterator[float]:
    """
    Pass the messages of a bag on to a recorder, in the order in which they were recorded.

    Args:
        path: rosbag2 folder, or one of its files.
        recorder: see :class:`~beetle_omni_ros.runs.recorder.Recorder`.
        warnings: takes what was missing or wrong, at the end.
        namespace: of the robot, where the bag holds several.
        spacing: topic without namespace -> least time between two of its messages [s]; those
            between, and all after an infinite one, are left out. For readers in a hurry.

    Yields:
        The time of recording of each message, once the recorder has it [s].

    Raises:
        BagError: no such bag, unreadable, not MCAP, or several robots in it.

    """
    reading = _Reading(str(path), namespace, recorder, spacing)
    for message in read_messages(path, reading.warnings):
        if reading.take(message):
            yield message.received
    recorder.write_meta(_metadata(path, reading.warnings))
    warnings += reading.finish()


class _Reading:
    """Sorts messages by topic and namespace, and counts what cannot be used."""

    def __init__(self, path, namespace, recorder, spacing=lambda _: 0.0):
        self.warnings: list[str] = []
        self._recorder, self._spacing = recorder, spacing
        self._taken: dict[str, float] = {}  # full topic -> time of the newest message taken
        self._path = path
        self._namespace = None if namespace is None else _rooted(namespace)
        self._chosen = namespace is not None
        self._split = {}
        self._counts: Counter = Counter()
        self._bad: Counter = Counter()
        self._reason: dict[str, str] = {}
        self._waiting: dict[str, tuple[list[bytes], list[np.ndarray]]] = {}

    def take(self, message: RawMessage) -> bool:
        """Whether the recorder was given the message."""
        name = self._name(message.topic)
        if name is None or self._follows_closely(message, self._spacing(name)):
            return False
        try:
            topic = self._topic(name, message.type)
            value = topic.read(from_bytes(message.data, message.type))
            self._recorder.write(name, _stamped(value, message.received), message.received)
            self._counts[name] += 1
        except Exception as error:  # one message that cannot be used must not lose the others
            self._refuse(name, str(error) or type(error).__name__)
            return False
        self._taken[message.topic] = message.received
        return True

    def take_together(self, messages: Messages) -> None:
        """Take messages of a topic; those of a series wait until they are many."""
        name = self._name(messages.topic)
        if name is None:
            return
        if name not in SERIES_OF and not requester(name):
            for data, received in zip(messages.data, messages.received.tolist(), strict=True):
                self.take(RawMessage(messages.topic, messages.type, data, received))
            return
        try:
            self._topic(name, messages.type)
        except MessageError as error:
            self._refuse(name, str(error), len(messages.data))
            return
        waiting, times = self._waiting.setdefault(name, ([], []))
        waiting += messages.data
        times.append(messages.received)
        if len(waiting) >= AT_ONCE:
            self.take_waiting(name)

    def take_waiting(self, *names: str) -> None:
        """Read the messages that wait, of these topics or of all."""
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
        """Name without namespace; None where it is not ours, or not known to be."""
        if topic not in self._split:
            if self._namespace is None and is_ambiguous(topic):
                return None     # until another topic shows in which namespace the robot is
            self._split[topic] = self._recognise(topic)
        return self._split[topic]

    def _topic(self, name, kind):
        topic = topic_of(name)
        if kind != topic.type:
            raise MessageError(f'type is {kind}, not {topic.type}')
        return topic

    def _refuse(self, name, reason, count=1):
        self._bad[name] += count
        self._reason.setdefault(name, reason)

    def _follows_closely(self, message, spacing):
        before = self._taken.get(message.topic, inf)    # a clock that was set back starts anew
        return before <= message.received < before + spacing

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
    """The value; where its stamp is not set, as quick tools leave it, with the time of receipt."""
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
    """Meta data that a finished bag carries; empty where there is none."""
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
    """Whether a value is of the kind that readers of the log count on."""
    if value is None:
        return True
    if key == 'seed':
        return isinstance(value, int) and 0 <= value < 1 << 63
    if key in META_TEXTS:
        return isinstance(value, str) and len(value) <= LONGEST_TEXT and value.isprintable()
    return True
