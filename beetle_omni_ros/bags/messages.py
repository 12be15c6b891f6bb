"""
Messages of nodes and bags: their classes, CDR, and values without a class of their own.

rosbags' type store for Jazzy decodes an odometry five times faster than rclpy, which makes each
nested message twice. Stamps are in seconds, units are SI.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from types import SimpleNamespace
from typing import Any, TYPE_CHECKING

import numpy as np
from rosbags import interfaces
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores

if TYPE_CHECKING:
    from beetle_omni_ros.bags.topics import Qos

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
HEADER = 4          # bytes of encapsulation before the payload, from which alignment counts
LITTLE_ENDIAN = b'\0\1'     # begin of the encapsulation of plain CDR
EMPTY: dict[str, Any] = {'bool': False, 'string': '', 'float32': 0.0, 'float64': 0.0}


def new(name: str) -> Any:
    """Make a message with zeros from its ROS type."""
    return _maker(name)()


@cache
def _maker(name: str) -> Callable[[], Any]:
    makers = [_maker_of(*description) for _, description in TYPESTORE.fielddefs[name][1]]
    kind = TYPESTORE.types[name]
    return lambda: kind(*[make() for make in makers])


def _maker_of(node, what):
    if node == Nodetype.NAME:
        return _maker(what)
    if node == Nodetype.BASE:
        value = EMPTY.get(what[0], 0)
        return lambda: value
    (element, inner), count = what
    if element != Nodetype.BASE or inner[0] == 'string':
        return list
    kind = np.dtype('uint8' if inner[0] in ('byte', 'octet', 'char') else inner[0])
    return lambda: np.zeros(count if node == Nodetype.ARRAY else 0, kind)


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


def columns(block: np.ndarray, name: str) -> tuple[Any, np.ndarray]:
    """
    Deserialise messages of a ROS type from (N, length) bytes of CDR together.

    Returns:
        A message with (N,) numbers and (W, N) arrays; (N,) whether the texts and lengths of a
        message are those of the first one. The numbers of the other messages are meaningless.

    """
    from_bytes(block[0].tobytes(), name)    # raises for broken texts and lengths
    place, alike = HEADER, (block[:, :HEADER] == block[0, :HEADER]).all(axis=1)

    def take(kind, count, layout=False):
        nonlocal place
        size = np.dtype(kind).itemsize
        place += (HEADER - place) % size if count else 0    # alignment
        part = block[:, place:place + size * count]
        place += size * count
        if layout:
            alike[(part != part[0]).any(axis=1)] = False
        return np.ascontiguousarray(part).view(kind).T

    def decode(node, what):
        if node == Nodetype.NAME:
            return SimpleNamespace(**{
                field: decode(*of) for field, of in TYPESTORE.fielddefs[what][1]})
        if node == Nodetype.BASE and what[0] != 'string':
            return take(what[0], 1)[0]
        size = what[1] if node == Nodetype.ARRAY else int(take('u4', 1, layout=True)[0, 0])
        if node == Nodetype.BASE:
            return take('u1', size, layout=True)[:-1, 0].tobytes().decode()
        element, inner = what[0]
        if element == Nodetype.BASE and inner[0] != 'string':
            return take(inner[0], size)
        return [decode(element, inner) for _ in range(size)]

    return decode(Nodetype.NAME, name), alike


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


# --- values ------------------------------------------------------------------------------------

class MessageError(ValueError):
    """
    A message is unusable; the text gives the reason.

    Attributes:
        kind: category under which it is counted; default: the text. Needed if the text contains
            numbers or names.

    """

    def __init__(self, text: str, kind: str = ''):
        super().__init__(text)
        self.kind = kind or text


@dataclass(frozen=True)
class Wrench:
    """External force in world (3,) [N] and torque in base_link (3,) [N m]."""

    stamp: float
    force: np.ndarray
    torque: np.ndarray


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic status: level 0 ok, 1 warning, 2 error, 3 stale; values as text."""

    t: float
    name: str
    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)
