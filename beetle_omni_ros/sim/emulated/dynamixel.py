"""
Packets of DYNAMIXEL Protocol 2.0 on the side of the servo.

The source is emanual.robotis.com/docs/en/dxl/protocol2. The maker's SDK is not used, so that tests
can compare both.

A packet is ``FF FF FD 00 | ID | length (2 B) | instruction | parameters | CRC (2 B)``. The length
is that of the rest of the packet. In instruction and parameters an ``FD`` is stuffed after each
``FF FF FD``, so that the header is unique.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

HEADER = b'\xff\xff\xfd\x00'
BROADCAST = 0xFE
HEAD_SIZE = 7       # [B] header, ID and length
LENGTH_LIMIT = 1024  # [B] larger than any instruction of the SDK for 253 servos


class Instruction(IntEnum):
    """Instruction of a packet; STATUS is an answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A


class Error(IntEnum):
    """Lower seven bits of the error byte in a status packet; ALERT is the eighth."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7
    ALERT = 0x80


def _crc_table() -> tuple[int, ...]:
    """Remainders of the polynomial x^16 + x^15 + x^2 + 1 for each leading byte."""
    table = []
    for byte in range(256):
        remainder = byte << 8
        for _ in range(8):
            remainder = (remainder << 1) ^ (0x8005 if remainder & 0x8000 else 0)
        table.append(remainder & 0xFFFF)
    return tuple(table)


_TABLE = _crc_table()


def crc16(data: bytes, start: int = 0) -> int:
    """CRC-16 (polynomial 0x8005, not reflected) of ``data``, continued from ``start``."""
    crc = start
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ _TABLE[(crc >> 8) ^ byte]
    return crc


def stuffed(body: bytes) -> bytes:
    """Instruction and parameters with ``FD`` after each ``FF FF FD``."""
    return body.replace(b'\xff\xff\xfd', b'\xff\xff\xfd\xfd')


def unstuffed(body: bytes) -> bytes:
    """The inverse of :func:`stuffed`."""
    return body.replace(b'\xff\xff\xfd\xfd', b'\xff\xff\xfd')


def packet(identifier: int, instruction: int, parameters: bytes = b'') -> bytes:
    """Build a packet; the first parameter of a status packet is its error byte."""
    body = stuffed(bytes((instruction,)) + parameters)
    head = HEADER + bytes((identifier,)) + (len(body) + 2).to_bytes(2, 'little')
    return _sealed(head + body)


def status(identifier: int, error: int, data: bytes = b'') -> bytes:
    """Build the answer of one servo."""
    return packet(identifier, Instruction.STATUS, bytes((error,)) + data)


def fast_status(blocks: list[tuple[int, int, bytes]], length: int) -> bytes:
    """
    Build the common answer of several servos, without stuffing.

    Args:
        blocks: (ID, error, data) of the servos that answer, in order.
        length: sum of the bytes of data plus four (error, ID, CRC) over all addressed servos.

    Returns:
        the parts of the servos in one; each ends with the CRC of all bytes before.

    """
    sent = HEADER + bytes((BROADCAST,)) + (length + 1).to_bytes(2, 'little') \
        + bytes((Instruction.STATUS,))
    for identifier, error, data in blocks:
        sent = _sealed(sent + bytes((error, identifier)) + data)
    return sent


def _sealed(data: bytes) -> bytes:
    return data + crc16(data).to_bytes(2, 'little')


@dataclass(frozen=True, slots=True)
class Packet:
    """A received packet without stuffing; ``valid``: whether its CRC is correct."""

    identifier: int
    instruction: int
    parameters: bytes
    valid: bool


class Receiver:
    """
    Finds packets in a stream of bytes.

    A header inside an incomplete packet starts a new one, because stuffing excludes it inside a
    packet. The last bytes of a packet are exempt, because its CRC may look like a header.
    """

    def __init__(self):
        self._buffer = bytearray()
        self.skipped = 0

    def forget(self):
        """Drop an incomplete packet, as a servo does after a pause on the line."""
        self.skipped += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Parse further bytes; yield each packet that they complete."""
        self._buffer += data
        while self._align():
            if len(self._buffer) < HEAD_SIZE:
                return
            length = int.from_bytes(self._buffer[5:7], 'little')
            if self._buffer[4] > BROADCAST or self._buffer[4] == 0xFD \
                    or not 3 <= length <= LENGTH_LIMIT:
                self._drop(len(HEADER))
                continue
            end = HEAD_SIZE + length
            again = self._buffer.find(HEADER, HEAD_SIZE, end - 1)
            # Its FD must lie before the CRC.
            if again >= 0 and again + 2 < end - 2:
                self._drop(again)
                continue
            if len(self._buffer) < end:
                return
            raw = bytes(self._buffer[:end])
            valid = crc16(raw[:-2]) == int.from_bytes(raw[-2:], 'little')
            if valid:
                del self._buffer[:end]
            else:
                # Its end may be the start of the next packet.
                self._drop(len(HEADER))
            body = unstuffed(raw[HEAD_SIZE:-2])
            yield Packet(raw[4], body[0], body[1:], valid)

    def _align(self) -> bool:
        """Drop bytes before a header; return whether the buffer starts with a header."""
        start = self._buffer.find(HEADER)
        if start < 0:
            keep = next((n for n in (3, 2, 1) if self._buffer.endswith(HEADER[:n])), 0)
            self._drop(len(self._buffer) - keep)
            return False
        self._drop(start)
        return True

    def _drop(self, count: int):
        self.skipped += count
        del self._buffer[:count]
