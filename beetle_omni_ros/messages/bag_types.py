"""
Messages of nodes and bags: classes, CDR, vectorised reading, by rosbags' type store for Jazzy.

It decodes an odometry five times faster than rclpy, which makes each nested message twice.

Messages with equal texts and array lengths have the same layout. :func:`read_all` finds the layout
from one of them field by field; each number is then a column of the bytes of all. The result has
the attributes of a message, so that ``read_*`` of :mod:`~beetle_omni_ros.messages.conversions`
reads it.
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
    from beetle_omni_ros.messages.topics import Qos, Topic

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
HEADER = 4          # bytes of encapsulation before the payload, from which alignment counts
SIZES = {'bool': '?', 'byte': 'u1', 'octet': 'u1', 'char': 'u1', 'int8': 'i1', 'uint8': 'u1',
         'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4', 'int64': 'i8',
         'uint64': 'u8', 'float32': 'f4', 'float64': 'f8'}
LAYOUTS = 32        # layouts of one length, after which messages are read one by one
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
    dtype = np.dtype(np.uint8 if inner[0] == 'byte' else inner[0])
    return lambda: np.zeros(count if node == Nodetype.ARRAY else 0, dtype)


def to_bytes(message: Any, name: str) -> memoryview:
    """Serialise a message of a ROS type to CDR."""
    return TYPESTORE.serialize_cdr(message, name)


def from_bytes(data: bytes | memoryview, name: str) -> Any:
    """
    Deserialise a message of a ROS type from CDR; broken bytes raise any exception.

    Bytes behind the message are ignored: rclpy's serialize_message returns its whole buffer.
    """
    if len(data) < 4 or data[0] or data[1] > 1:
        raise ValueError('not plain CDR')
    definition = TYPESTORE.get_msgdef(name)
    read = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
    return read(memoryview(data)[4:], 0, definition.cls, TYPESTORE)[0]


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
        tried = 0
        while len(rows):
            tried += 1
            alike = np.zeros(len(rows), dtype=bool)
            alike[0] = True
            try:
                walk = _Walk(block[0].tobytes())
                walk.message(name)
                if tried < LAYOUTS:
                    fixed = walk.fixed
                    alike = (block[:, fixed] == block[0, fixed]).all(axis=1)
                walk = _Walk(block[0].tobytes(), block[alike])
                yield rows[alike], walk.message(name)
            except Exception as error:      # broken bytes raise anything
                refused[str(error) or type(error).__name__] += int(alike.sum())
            block, rows = block[~alike], rows[~alike]


class _Walk:
    """
    Parser of one message; numbers are read from all rows of ``block``.

    Attributes:
        fixed: offsets of the bytes that define the layout: encapsulation, lengths and texts.

    """

    def __init__(self, first: bytes, block: np.ndarray | None = None):
        if len(first) < HEADER or first[0] or first[1] not in (0, 1):
            raise ValueError('not plain CDR')
        self._order = '<' if first[1] else '>'
        self._first, self._block, self._at = first, block, HEADER
        self.fixed = list(range(HEADER))

    def message(self, name) -> SimpleNamespace:
        """Parse a message of a ROS type."""
        return SimpleNamespace(**{field: self._field(*description)
                                  for field, description in TYPESTORE.fielddefs[name][1]})

    def _field(self, node, what):
        if node == Nodetype.NAME:
            return self.message(what)
        if node == Nodetype.BASE:
            return self._text() if what[0] == 'string' else self._numbers(what[0], 1)[0]
        (element, inner), count = what
        if node == Nodetype.SEQUENCE:
            count = self._count()
        if element == Nodetype.BASE and inner[0] != 'string':
            return self._numbers(inner[0], count)
        if count > len(self._first):
            raise ValueError('the message is shorter than its array length')
        return [self._field(element, inner) for _ in range(count)]

    def _take(self, size, unit):
        """Offset of the next ``size`` bytes, aligned to ``unit``."""
        begin = HEADER + -(-(self._at - HEADER) // unit) * unit
        if begin + size > len(self._first):
            raise ValueError('the message is shorter than its type')
        self._at = begin + size
        return begin

    def _count(self):
        begin = self._take(4, 4)
        self.fixed.extend(range(begin, begin + 4))
        return struct.unpack_from(f'{self._order}I', self._first, begin)[0]

    def _text(self):
        size = self._count()
        begin = self._take(size, 1)
        self.fixed.extend(range(begin, begin + size))
        return self._first[begin:begin + max(0, size - 1)].decode()

    def _numbers(self, kind, count):
        """(count, N) numbers."""
        dtype = np.dtype(self._order + SIZES[kind])
        if not count:
            return np.zeros((0, 1))
        begin = self._take(dtype.itemsize * count, dtype.itemsize)
        if self._block is None:
            return [0] * count
        part = np.ascontiguousarray(self._block[:, begin:begin + dtype.itemsize * count])
        return part.view(dtype).T
