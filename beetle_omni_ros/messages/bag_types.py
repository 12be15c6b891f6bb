"""Message classes and CDR serialisation of bags, by rosbags' type store for Jazzy."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from rosbags import interfaces
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores

from beetle_omni_ros.messages.topics import Qos

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
EMPTY: dict[str, Any] = {'bool': False, 'string': '', 'float32': 0.0, 'float64': 0.0}


class BagFactory:
    """See :class:`~beetle_omni_ros.messages.conversions.MessageFactory`."""

    def new(self, name: str) -> Any:
        """Make a message with zeros from its ROS type."""
        return _maker(name)()

    def doubles(self, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return an array of float64."""
        return np.array(values, dtype=np.float64)

    def singles(self, values: Sequence[float]) -> np.ndarray:
        """Return an array of float32."""
        return np.array(values, dtype=np.float32)

    def byte(self, value: int) -> int:
        """Return the value of a field ``byte``."""
        return int(value)


BAG = BagFactory()


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
