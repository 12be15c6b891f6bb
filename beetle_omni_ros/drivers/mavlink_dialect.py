"""
The MAVLink 2 dialect of the motor board: pymavlink's ``common`` with two more ESC messages.

MAVLink's common.xml and its C headers contain ESC_INFO and ESC_STATUS, the dialects of pymavlink
2.4.41 and 2.4.50 do not. Here they are declared as in common.xml. The declaration of a pymavlink
release that contains them has priority.
"""

import struct

from pymavlink.dialects.v20 import common

# Message ID -> name and fields (type, name, array length or 0) in the order of common.xml.
ESC_MESSAGES = {
    290: ('ESC_INFO', (
        ('uint8_t', 'index', 0), ('uint64_t', 'time_usec', 0), ('uint16_t', 'counter', 0),
        ('uint8_t', 'count', 0), ('uint8_t', 'connection_type', 0), ('uint8_t', 'info', 0),
        ('uint16_t', 'failure_flags', 4), ('uint32_t', 'error_count', 4),
        ('int16_t', 'temperature', 4))),
    291: ('ESC_STATUS', (
        ('uint8_t', 'index', 0), ('uint64_t', 'time_usec', 0), ('int32_t', 'rpm', 4),
        ('float', 'voltage', 4), ('float', 'current', 4))),
}
CODES = {'uint8_t': 'B', 'int16_t': 'h', 'uint16_t': 'H', 'int32_t': 'i', 'uint32_t': 'I',
         'uint64_t': 'Q', 'float': 'f'}


def crc_extra(name: str, fields) -> int:
    """Checksum seed of a message, from its name and its ``fields`` in wire order."""
    crc = common.x25crc()
    crc.accumulate(f'{name} '.encode())
    for kind, field, length in fields:
        crc.accumulate(f'{kind} {field} '.encode())
        if length:
            crc.accumulate(bytes([length]))
    return (crc.crc & 0xFF) ^ (crc.crc >> 8)


def message_class(number: int, name: str, fields) -> type:
    """Build a message class of the form that pymavlink generates."""
    # Wire order: larger types first, otherwise as declared (Python's sort is stable).
    wire = sorted(fields, key=lambda field: -struct.calcsize(CODES[field[0]]))
    names = [field for _, field, _ in fields]
    unpacker = struct.Struct('<' + ''.join(
        f'{length or ""}{CODES[kind]}' for kind, _, length in wire))

    def __init__(self, *values):
        common.MAVLink_message.__init__(self, number, name)
        self._fieldnames, self._instance_field, self._instance_offset = names, None, -1
        for field, value in zip(names, values, strict=True):
            setattr(self, field, value)

    def pack(self, mav, force_mavlink1=False):
        values = []
        for _, field, length in wire:
            value = getattr(self, field)
            values += value if length else [value]
        return self._pack(mav, self.crc_extra, self.unpacker.pack(*values),
                          force_mavlink1=force_mavlink1)

    return type(f'MAVLink_{name.lower()}_message', (common.MAVLink_message,), {
        '__init__': __init__, 'pack': pack, 'id': number, 'msgname': name, 'fieldnames': names,
        'ordered_fieldnames': [field for _, field, _ in wire],
        'fieldtypes': [kind for kind, _, _ in fields],
        'native_format': bytearray(('<' + ''.join(CODES[kind] for kind, _, _ in wire)).encode()),
        'orders': [[field for _, field, _ in wire].index(field) for field in names],
        'lengths': [length or 1 for _, _, length in wire],
        'array_lengths': [length for _, _, length in wire],
        'crc_extra': crc_extra(name, wire), 'unpacker': unpacker})


for _number, (_name, _fields) in ESC_MESSAGES.items():
    common.mavlink_map.setdefault(_number, message_class(_number, _name, _fields))
MESSAGES = common.mavlink_map
common.MAVLINK_IGNORE_CRC = 0   # the environment must not switch the checksum off
EscInfo, EscStatus = MESSAGES[290], MESSAGES[291]

__all__ = ['common', 'crc_extra', 'EscInfo', 'EscStatus', 'MESSAGES', 'message_class']
