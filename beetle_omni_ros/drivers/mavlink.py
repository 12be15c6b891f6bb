"""MAVLink 2 by pymavlink: the messages of docs/reference/firmware.md and a counting receiver."""

from collections.abc import Callable
import struct

from pymavlink.dialects.v20 import common


def _declare(number, name, crc_extra, layout, fields, order):
    """Declare a message: fields with their lengths as in the payload, order of the definition."""
    def __init__(self, *values):
        common.MAVLink_message.__init__(self, number, name)
        self.__dict__.update(zip(order, values, strict=True))

    def pack(self, mav, force_mavlink1=False):
        values = [one for field, length in fields.items() for one in (
            getattr(self, field) if length > 1 else [getattr(self, field)])]
        return self._pack(mav, crc_extra, struct.pack(layout, *values))

    common.mavlink_map.setdefault(number, type(name, (common.MAVLink_message,), {
        '__init__': __init__, 'pack': pack, 'id': number, 'msgname': name,
        'crc_extra': crc_extra, 'fieldnames': order, 'unpacker': struct.Struct(layout),
        'lengths': list(fields.values()),
        'orders': [list(fields).index(field) for field in order]}))


# The dialects of pymavlink 2.4.41 and 2.4.50 do not contain these two. The declaration of a
# release that contains them has priority.
_declare(290, 'ESC_INFO', 251, '<Q4IH4H4hBBBB', {
    'time_usec': 1, 'error_count': 4, 'counter': 1, 'failure_flags': 4, 'temperature': 4,
    'index': 1, 'count': 1, 'connection_type': 1, 'info': 1}, [
    'index', 'time_usec', 'counter', 'count', 'connection_type', 'info', 'failure_flags',
    'error_count', 'temperature'])
_declare(291, 'ESC_STATUS', 10, '<Q4i4f4fB', {
    'time_usec': 1, 'rpm': 4, 'voltage': 4, 'current': 4, 'index': 1}, [
    'index', 'time_usec', 'rpm', 'voltage', 'current'])
EscInfo, EscStatus = common.mavlink_map[290], common.mavlink_map[291]
BOARD, HOST = (1, 1), (1, 191)    # system and component of both sides
common.MAVLINK_IGNORE_CRC = 0   # the environment must not switch the checksum off


def restarted(message) -> bool:
    """Whether a message is the first heartbeat after a start of the board."""
    return message.get_msgId() == common.MAVLINK_MSG_ID_HEARTBEAT \
        and message.custom_mode & 0xFF == 0


class MavlinkReceiver:
    """
    Splits a byte stream into the messages of one sender with the IDs ``system``, ``component``.

    ``counts`` are messages received and bytes; lost: gaps in the sender's sequence numbers;
    bad_crc: frames with a valid header and a wrong checksum; skipped_bytes: outside valid frames;
    foreign: valid frames of another sender. A message for which ``restarts`` is true ends no gap.
    """

    def __init__(self, system: int, component: int,
                 restarts: Callable[[object], bool] = lambda message: False):
        self._sender, self._restarts = (system, component), restarts
        self.counts = dict.fromkeys(
            ('received', 'bytes', 'lost', 'bad_crc', 'skipped_bytes', 'foreign'), 0)
        self.restart()

    def restart(self) -> None:
        """Forget an incomplete frame and the sequence number."""
        self._parser = common.MAVLink(None)
        self._parser.robust_parsing = True
        self._sequence: int | None = None

    def feed(self, data: bytes) -> list:
        """Parse further bytes; return the messages that they complete."""
        counts, found = self.counts, []
        counts['bytes'] += len(data)
        for message in self._parser.parse_buffer(data) or ():
            if message.get_msgId() < 0:     # bad data, or an unknown message, which has no CRC
                counts['skipped_bytes'] += len(message.data)
                counts['bad_crc'] += 'CRC' in getattr(message, 'reason', '')
            elif (message.get_srcSystem(), message.get_srcComponent()) != self._sender:
                counts['foreign'] += 1
            else:
                counts['received'] += 1
                sequence = message.get_seq()
                if self._sequence is not None and not self._restarts(message):
                    counts['lost'] += (sequence - self._sequence - 1) % 256
                self._sequence = sequence
                found.append(message)
        return found
