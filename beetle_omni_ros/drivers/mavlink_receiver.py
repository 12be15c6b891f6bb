"""
Bytes to MAVLink 2 messages: framing that recovers at once, and the counts of what went wrong.

pymavlink decodes and checks each frame. Its own framing is not used: after a bad checksum it
drops as many bytes as the broken header announced, up to 280, and the good messages in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from beetle_omni_ros.drivers.mavlink_dialect import common, MESSAGES

MARKER, HEADER, CHECKSUM = 0xFD, 10, 2  # [bytes] of an unsigned MAVLink 2 frame
SEQUENCE = 256


@dataclass
class ReceiveCounts:
    """What arrived since the start."""

    messages: int = 0
    bytes: int = 0
    lost: int = 0           # gaps in the sender's sequence numbers
    bad_crc: int = 0        # frames with a good header and a wrong checksum
    skipped_bytes: int = 0  # belonging to no good frame
    foreign: int = 0        # good frames of another sender


class MavlinkReceiver:
    """
    Splits a byte stream into the messages of one sender.

    Attributes:
        counts: see :class:`ReceiveCounts`.

    """

    def __init__(self, system: int, component: int,
                 restarts: Callable[[common.MAVLink_message], bool] = lambda message: False):
        """
        Start with an empty buffer.

        Args:
            system: id that a frame must bear.
            component: likewise.
            restarts: tells whether a message says that the sender has just restarted, so that
                its number begins a new sequence.

        """
        self._sender, self._restarts = (system, component), restarts
        self._buffer = bytearray()
        self._decoder = common.MAVLink(None)
        self._sequence: int | None = None
        self.counts = ReceiveCounts()

    def restart(self) -> None:
        """Forget a broken-off frame and the sequence: the sender or the cable is a new one."""
        self._buffer.clear()
        self._sequence = None

    def feed(self, data: bytes) -> list:
        """Take bytes as they come; return the messages completed by them."""
        buffer, found = self._buffer, []
        buffer += data
        self.counts.bytes += len(data)
        start, end = 0, len(buffer)
        while True:
            marker = buffer.find(MARKER, start)
            self.counts.skipped_bytes += (end if marker < 0 else marker) - start
            start = end if marker < 0 else marker
            if end - start < HEADER:
                break
            # Flags are those of signed frames, which the firmware contract excludes.
            number = int.from_bytes(buffer[start + 7:start + 10], 'little')
            if buffer[start + 2] or number not in MESSAGES:
                message, size = None, 1
            else:
                size = HEADER + buffer[start + 1] + CHECKSUM
                if end - start < size:
                    break
                message = self._decode(buffer[start:start + size])
            if message is None:
                # The marker was data, or the header is broken: look on right behind it.
                self.counts.skipped_bytes += 1
                start += 1
                continue
            start += size
            if self._from_sender(message):
                found.append(message)
        del buffer[:start]
        return found

    def _decode(self, frame):
        try:
            return self._decoder.decode(frame)
        except common.MAVError:
            self.counts.bad_crc += 1
            return None

    def _from_sender(self, message):
        """Count a good frame; tell whether it is the sender's."""
        if (message.get_srcSystem(), message.get_srcComponent()) != self._sender:
            self.counts.foreign += 1
            return False
        self.counts.messages += 1
        sequence = message.get_seq()
        if self._sequence is not None and not self._restarts(message):
            self.counts.lost += (sequence - self._sequence - 1) % SEQUENCE
        self._sequence = sequence
        return True
