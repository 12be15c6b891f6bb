"""
Packing and unpacking of the nine MAVLink 2 messages of the firmware contract.

The source is mavlink.io (packet serialization, common message set). The library of the driver is
not used, so that tests can compare both.
"""

from dataclasses import dataclass
import struct

MARKER, HEADER, CHECKSUM = 0xFD, 10, 2  # [bytes]
POLYNOMIAL = 0x8408                     # CRC-16/MCRF4XX: x^16 + x^12 + x^5 + 1, bits reversed

HEARTBEAT, SYS_STATUS, COMMAND_LONG, COMMAND_ACK = 0, 1, 76, 77
TIMESYNC, ACTUATOR_TARGET, BATTERY_STATUS, ESC_INFO, ESC_STATUS = 111, 139, 147, 290, 291

# Message ID -> checksum seed and payload in wire order, larger types first.
MESSAGES = {
    HEARTBEAT: (50, struct.Struct('<IBBBBB')),
    SYS_STATUS: (124, struct.Struct('<IIIHHhHHHHHHb')),
    COMMAND_LONG: (152, struct.Struct('<fffffffHBBB')),
    COMMAND_ACK: (143, struct.Struct('<HBBiBB')),
    TIMESYNC: (34, struct.Struct('<qq')),
    ACTUATOR_TARGET: (168, struct.Struct('<Q8fBBB')),
    BATTERY_STATUS: (154, struct.Struct('<iih10HhBBBb')),
    ESC_INFO: (251, struct.Struct('<Q4IH4H4hBBBB')),
    ESC_STATUS: (10, struct.Struct('<Q4i4f4fB')),
}


def _table():
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (POLYNOMIAL if byte & 1 else 0)
        table.append(byte)
    return table


_TABLE = _table()


def checksum(data: bytes, seed: int) -> int:
    """CRC-16/MCRF4XX of ``data``, without the marker, and of the message's ``seed``."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc >> 8 ^ _TABLE[(crc ^ seed) & 0xFF]


def pack(number: int, values: tuple, sequence: int, system: int, component: int) -> bytes:
    """Frame of message ``number`` with ``values`` in wire order, without trailing zeros."""
    seed, layout = MESSAGES[number]
    payload = layout.pack(*values).rstrip(b'\0') or b'\0'
    body = bytes([len(payload), 0, 0, sequence, system, component]) \
        + number.to_bytes(3, 'little') + payload
    return bytes([MARKER]) + body + checksum(body, seed).to_bytes(2, 'little')


@dataclass(frozen=True, slots=True)
class Message:
    """One received message; ``values`` in wire order."""

    number: int
    values: tuple
    sequence: int
    system: int
    component: int


class Parser:
    """
    Splits bytes into messages.

    Attributes:
        bad_crc: number of frames with a wrong checksum.
        lost: number of missing sequence numbers, over all senders.

    """

    def __init__(self):
        self._buffer = bytearray()
        self._expected = None
        self.bad_crc = self.lost = 0

    def feed(self, data: bytes) -> list[Message]:
        """Parse further bytes; return complete messages of known types."""
        self._buffer += data
        messages = []
        while True:
            start = self._buffer.find(MARKER)
            if start < 0:
                self._buffer.clear()
                return messages
            del self._buffer[:start]
            used, message = self._frame()
            if not used:
                return messages
            del self._buffer[:used]
            if message is not None:
                messages.append(message)

    def _frame(self):
        """Number of bytes to consume (0: wait for more), and the message in them or None."""
        head = self._buffer
        if len(head) < HEADER:
            return 0, None
        number = int.from_bytes(head[7:10], 'little')
        if head[2] or number not in MESSAGES:
            return 1, None
        end = HEADER + head[1]
        if len(head) < end + CHECKSUM:
            return 0, None
        seed, layout = MESSAGES[number]
        if checksum(head[1:end], seed) != int.from_bytes(head[end:end + CHECKSUM], 'little'):
            self.bad_crc += 1
            return 1, None
        payload = bytes(head[HEADER:end])[:layout.size].ljust(layout.size, b'\0')
        sequence = head[4]
        if self._expected is not None:
            self.lost += (sequence - self._expected) % 256
        self._expected = (sequence + 1) % 256
        return end + CHECKSUM, Message(number, layout.unpack(payload), sequence, head[5], head[6])
