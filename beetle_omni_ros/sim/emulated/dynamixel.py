"""
Packets of DYNAMIXEL Protocol 2.0, as the servo sees them.

Written from the protocol's document (emanual.robotis.com/docs/en/dxl/protocol2) and free of the
maker's SDK, which judges it in the tests.

A packet is ``FF FF FD 00 | ID | length (2 B) | instruction | parameters | CRC (2 B)``; the length
counts everything after itself. ``FF FF FD`` among instruction and parameters is followed by a
stuffed ``FD``, so that the header is unique.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

HEADER = b'\xff\xff\xfd\x00'
BROADCAST = 0xFE
LAST_ID = 0xFC
HEAD_SIZE = 7       # [B] header, ID and length
LENGTH_LIMIT = 1024  # [B] more than any instruction for a bus of 253 servos that the SDK sends


class Instruction(IntEnum):
    """What a packet asks for; STATUS marks an answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Error(IntEnum):
    """Lower seven bits of a status packet's error byte; ALERT is its eighth."""

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
    """Instruction and parameters with ``FD`` put behind each ``FF FF FD``."""
    return body.replace(b'\xff\xff\xfd', b'\xff\xff\xfd\xfd')


def unstuffed(body: bytes) -> bytes:
    """The inverse of :func:`stuffed`."""
    return body.replace(b'\xff\xff\xfd\xfd', b'\xff\xff\xfd')


def packet(identifier: int, instruction: int, parameters: bytes = b'') -> bytes:
    """Build a whole packet; a status packet's first parameter is its error byte."""
    body = stuffed(bytes((instruction,)) + parameters)
    head = HEADER + bytes((identifier,)) + (len(body) + 2).to_bytes(2, 'little')
    return _sealed(head + body)


def status(identifier: int, error: int, data: bytes = b'') -> bytes:
    """Build the answer of one servo."""
    return packet(identifier, Instruction.STATUS, bytes((error,)) + data)


def fast_status(blocks: list[tuple[int, int, bytes]], length: int) -> list[bytes]:
    """
    Build the one answer that several servos send together, not stuffed.

    Args:
        blocks: (ID, error, data) of the servos that answer, in order.
        length: bytes of data plus four (error, ID, CRC) over all servos asked.

    Returns:
        what each servo contributes; each ends with the CRC of all that was sent so far.

    """
    sent = HEADER + bytes((BROADCAST,)) + (length + 1).to_bytes(2, 'little') \
        + bytes((Instruction.STATUS,))
    pieces = []
    start = 0
    for identifier, error, data in blocks:
        sent = _sealed(sent + bytes((error, identifier)) + data)
        pieces.append(sent[start:])
        start = len(sent)
    return pieces


def _sealed(data: bytes) -> bytes:
    return data + crc16(data).to_bytes(2, 'little')


@dataclass(frozen=True, slots=True)
class Packet:
    """A received packet without stuffing; ``valid`` tells whether its CRC matched."""

    identifier: int
    instruction: int
    parameters: bytes
    valid: bool


class Receiver:
    """
    Finds packets in a stream of bytes, however it is cut.

    A header inside an unfinished packet starts a new one: stuffing keeps it out of a packet's
    own bytes. The last bytes before a packet's end are exempt, its CRC may look like a header.
    """

    def __init__(self):
        self._buffer = bytearray()
        self.skipped = 0

    def forget(self):
        """Drop an unfinished packet, as a servo does after a pause on the line."""
        self.skipped += len(self._buffer)
        self._buffer.clear()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes as they arrive; yield each packet that they complete."""
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
                # The start of the next packet may have been taken for its end.
                self._drop(len(HEADER))
            body = unstuffed(raw[HEAD_SIZE:-2])
            yield Packet(raw[4], body[0], body[1:], valid)

    def _align(self) -> bool:
        """Drop bytes before a header; tell whether a whole header stands in front."""
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
