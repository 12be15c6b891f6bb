"""
Messages of nodes and bags: classes, CDR, vectorised reading, by rosbags' type store for Jazzy.

It decodes an odometry five times faster than rclpy, which makes each nested message twice.
:func:`read_all` reads each number of all messages with equal texts and array lengths as one column
of their bytes.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from functools import cache
import struct
from types import SimpleNamespace
from typing import Any, TYPE_CHECKING

import numpy as np
from rosbags import interfaces
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores

if TYPE_CHECKING:
    from beetle_omni_ros.bags.topics import Qos, Topic

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
HEADER = 4          # bytes of encapsulation before the payload, from which alignment counts
LITTLE_ENDIAN = b'\0\1'     # begin of the encapsulation of plain CDR
EMPTY: dict[str, Any] = {'bool': False, 'string': '', 'float32': 0.0, 'float64': 0.0}


def new(name: str) -> Any:
    """Make a message with zeros from its ROS type."""
    return _maker(name)()


@cache
def _maker(name: str) -> Callable[[], Any]:
    fields = [_field(*description) for _, description in TYPESTORE.fielddefs[name][1]]
    kind = TYPESTORE.types[name]
    return lambda: kind(*[field() for field in fields])


def _field(node, what):
    if node == Nodetype.NAME:
        return _maker(what)
    if node == Nodetype.BASE:
        value = EMPTY.get(what[0], 0)
        return lambda: value
    (element, inner), count = what
    if element != Nodetype.BASE or inner[0] == 'string':
        return list
    return lambda: np.zeros(count if node == Nodetype.ARRAY else 0, _dtype(inner[0]))


def _dtype(kind):
    return np.dtype('uint8' if kind in ('byte', 'octet', 'char') else kind)


def to_bytes(message: Any, name: str) -> memoryview:
    """Serialise a message of a ROS type to CDR."""
    return TYPESTORE.serialize_cdr(message, name)


def from_bytes(data: bytes | memoryview, name: str) -> Any:
    """
    Deserialise a message of a ROS type from CDR; broken bytes raise any exception.

    Bytes behind the message are ignored: rclpy's serialize_message returns its whole buffer.
    """
    if data[:2] != LITTLE_ENDIAN:
        raise ValueError('not plain CDR')
    definition = TYPESTORE.get_msgdef(name)
    return definition.deserialize_cdr_le(
        memoryview(data)[HEADER:], 0, definition.cls, TYPESTORE)[0]


def offered(qos: Qos) -> interfaces.Qos:
    """Return the quality of service for metadata.yaml."""
    # rclpy's "infinite" durations, as ros2 bag writes them
    forever = interfaces.QosTime(9223372036, 854775807)
    reliability, durability = interfaces.QosReliability, interfaces.QosDurability
    return interfaces.Qos(
        interfaces.QosHistory.KEEP_LAST, qos.depth,
        reliability.RELIABLE if qos.reliable else reliability.BEST_EFFORT,
        durability.TRANSIENT_LOCAL if qos.latched else durability.VOLATILE,
        forever, forever, interfaces.QosLiveliness.AUTOMATIC, forever, False)


# --- many messages of one type ------------------------------------------------------------------

def read_all(topic: Topic, messages: Sequence[bytes | memoryview]) -> tuple[
        np.ndarray, Any, Counter]:
    """
    Read the messages of a topic.

    Args:
        topic: topic whose values have numbers, (N,) arrays or None as fields.
        messages: CDR of each message.

    Returns:
        (M,) ascending indices of the readable messages; one value whose fields are arrays with M
        rows, or None if no message has this field; reason -> number of refused messages.

    """
    parts, refused = [], Counter()
    for rows, message in _alike(topic.type, messages, refused):
        try:
            with np.errstate(all='ignore'):     # NaN and infinity in the messages
                parts.append((rows, topic.read(message)))
        except Exception as error:      # broken bytes raise anything
            refused[str(error) or type(error).__name__] += len(rows)
    if not parts:
        return np.zeros(0, dtype=int), None, refused
    rows = np.concatenate([part for part, _ in parts])
    order = np.argsort(rows, kind='stable')
    columns = {}
    for entry in fields(topic.value):
        found = [getattr(value, entry.name) for _, value in parts]
        shapes = {one.shape[1:] for one in found if isinstance(one, np.ndarray)}
        if len(shapes) == 1:
            width, = shapes
            columns[entry.name] = np.concatenate([
                np.full((len(part), *width), np.nan) if one is None else one
                for one, (part, _) in zip(found, parts, strict=True)])[order]
    return rows[order], type(parts[0][1])(**{
        entry.name: columns.get(entry.name) for entry in fields(topic.value)
        if entry.init and (entry.name in columns or getattr(parts[0][1], entry.name) is None)
    }), refused


def _alike(name, messages, refused) -> Iterator[tuple[np.ndarray, SimpleNamespace]]:
    """Yield (rows, message with columns) of messages that have the same layout."""
    lengths = defaultdict(list)
    for row, data in enumerate(messages):
        lengths[len(data)].append(row)
    for length, rows in lengths.items():
        block = np.frombuffer(b''.join(messages[row] for row in rows), np.uint8)
        block, rows = block.reshape(len(rows), length), np.array(rows)
        while len(rows):
            alike = np.zeros(len(rows), dtype=bool)
            alike[0] = True
            try:
                _, fixed = _columns(name, block[:1])
                alike = (block[:, fixed] == block[0, fixed]).all(axis=1)
                yield rows[alike], _columns(name, block[alike])[0]
            except Exception as error:      # broken bytes raise anything
                refused[str(error) or type(error).__name__] += int(alike.sum())
            block, rows = block[~alike], rows[~alike]


def _columns(name, block) -> tuple[SimpleNamespace, list[int]]:
    """
    Read messages with the layout of the first of them, (N, length) bytes.

    Returns:
        One message with columns; offsets of the bytes that define the layout: encapsulation,
        lengths and texts.

    """
    data, at, fixed = block[0].tobytes(), HEADER, list(range(HEADER))
    if data[:2] != LITTLE_ENDIAN:
        raise ValueError('not plain CDR')

    def take(size, unit):
        """Offset of the next ``size`` bytes, aligned to ``unit``."""
        nonlocal at
        begin = HEADER + -(-(at - HEADER) // unit) * unit
        if begin + size > len(data):
            raise ValueError('the message is shorter than its type')
        at = begin + size
        return begin

    def count():
        begin = take(4, 4)
        fixed.extend(range(begin, begin + 4))
        return struct.unpack_from('<I', data, begin)[0]

    def text():
        size = count()
        begin = take(size, 1)
        fixed.extend(range(begin, begin + size))
        return data[begin:begin + max(0, size - 1)].decode()

    def numbers(kind, size):
        """(size, N) numbers."""
        if not size:
            return np.zeros((0, 1))
        dtype = _dtype(kind)
        begin = take(dtype.itemsize * size, dtype.itemsize)
        return np.ascontiguousarray(block[:, begin:at]).view(dtype).T

    def field(node, what):
        if node == Nodetype.NAME:
            return SimpleNamespace(**{name: field(*definition)
                                      for name, definition in TYPESTORE.fielddefs[what][1]})
        if node == Nodetype.BASE:
            return text() if what[0] == 'string' else numbers(what[0], 1)[0]
        (element, inner), size = what
        if node == Nodetype.SEQUENCE:
            size = count()
        if element == Nodetype.BASE and inner[0] != 'string':
            return numbers(inner[0], size)
        if size > len(data):
            raise ValueError('the message is shorter than its array length')
        return [field(element, inner) for _ in range(size)]

    return field(Nodetype.NAME, name), fixed
