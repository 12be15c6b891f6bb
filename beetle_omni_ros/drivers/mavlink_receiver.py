"""
Parses a byte stream into MAVLink 2 messages and counts errors.

pymavlink decodes and checks each frame. Its own framing is not used, because after a bad checksum
it drops the length announced by the corrupt header, up to 280 bytes with the valid messages in
them.
"""

from collections.abc import Callable
from dataclasses import dataclass

from beetle_omni_ros.drivers.mavlink_dialect import common, MESSAGES

MARKER, HEADER, CHECKSUM = 0xFD, 10, 2  # [bytes] of an unsigned MAVLink 2 frame
SEQUENCE = 256


@dataclass
class ReceiveCounts:
    """Counts since the start."""

    messages: int = 0
    bytes: int = 0
    lost: int = 0           # gaps in the sender's sequence numbers
    bad_crc: int = 0        # frames with a valid header and a wrong checksum
    skipped_bytes: int = 0  # bytes outside valid frames
    foreign: int = 0        # valid frames of another sender


class MavlinkReceiver:
    """
    Splits a byte stream into the messages of one sender.

    Args:
        system, component: IDs of the sender.
        restarts: whether a message is the first one after a restart of the sender, so that its
            number begins a new sequence.

    """

    def __init__(self, system: int, component: int,
                 restarts: Callable[[common.MAVLink_message], bool] = lambda message: False):
        self._sender, self._restarts = (system, component), restarts
        self._buffer = bytearray()
        self._decoder = common.MAVLink(None)
        self._sequence: int | None = None
        self.counts = ReceiveCounts()

    def restart(self) -> None:
        """Forget an incomplete frame and the sequence number."""
        self._buffer.clear()
        self._sequence = None

    def feed(self, data: bytes) -> list:
        """Parse further bytes; return the messages that they complete."""
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
            # Incompatibility flags mark signed frames, which the firmware contract excludes.
            number = int.from_bytes(buffer[start + 7:start + 10], 'little')
            if buffer[start + 2] or number not in MESSAGES:
                message, size = None, 1
            else:
                size = HEADER + buffer[start + 1] + CHECKSUM
                if end - start < size:
                    break
                message = self._decode(buffer[start:start + size])
            if message is None:
                # The marker was data, or the header is corrupt: continue behind the marker.
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
        """Count a valid frame; return whether it is of the sender."""
        if (message.get_srcSystem(), message.get_srcComponent()) != self._sender:
            self.counts.foreign += 1
            return False
        self.counts.messages += 1
        sequence = message.get_seq()
        if self._sequence is not None and not self._restarts(message):
            self.counts.lost += (sequence - self._sequence - 1) % SEQUENCE
        self._sequence = sequence
        return True
