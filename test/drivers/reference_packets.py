"""
The MAVLink 2 packets of docs/reference/firmware.md, and a parser small enough to check by eye.

Sources: mavlink.io "Packet Serialization" (header, truncation of zeros, CRC-16/MCRF4XX over
header and payload and then the message's CRC_EXTRA) and the common message set. The checksums
at the ends of the packets were computed with :func:`crc` below, bit by bit.
"""

from pathlib import Path
import re
import struct

from hypothesis import strategies

# Message id -> name and fields (type, name, array length) in the order of the definition.
DEFINITIONS = {
    0: ('HEARTBEAT', 'uint8_t type,uint8_t autopilot,uint8_t base_mode,uint32_t custom_mode,'
        'uint8_t system_status,uint8_t mavlink_version'),
    1: ('SYS_STATUS', 'uint32_t onboard_control_sensors_present,'
        'uint32_t onboard_control_sensors_enabled,uint32_t onboard_control_sensors_health,'
        'uint16_t load,uint16_t voltage_battery,int16_t current_battery,int8_t battery_remaining,'
        'uint16_t drop_rate_comm,uint16_t errors_comm,uint16_t errors_count1,'
        'uint16_t errors_count2,uint16_t errors_count3,uint16_t errors_count4'),
    76: ('COMMAND_LONG', 'uint8_t target_system,uint8_t target_component,uint16_t command,'
         'uint8_t confirmation,float param1,float param2,float param3,float param4,float param5,'
         'float param6,float param7'),
    # The last three fields of COMMAND_ACK as used here are extensions: no part of CRC_EXTRA.
    77: ('COMMAND_ACK', 'uint16_t command,uint8_t result'),
    111: ('TIMESYNC', 'int64_t tc1,int64_t ts1'),
    139: ('SET_ACTUATOR_CONTROL_TARGET', 'uint64_t time_usec,uint8_t group_mlx,'
          'uint8_t target_system,uint8_t target_component,float controls[8]'),
    147: ('BATTERY_STATUS', 'uint8_t id,uint8_t battery_function,uint8_t type,'
          'int16_t temperature,uint16_t voltages[10],int16_t current_battery,'
          'int32_t current_consumed,int32_t energy_consumed,int8_t battery_remaining'),
    290: ('ESC_INFO', 'uint8_t index,uint64_t time_usec,uint16_t counter,uint8_t count,'
          'uint8_t connection_type,uint8_t info,uint16_t failure_flags[4],'
          'uint32_t error_count[4],int16_t temperature[4]'),
    291: ('ESC_STATUS', 'uint8_t index,uint64_t time_usec,int32_t rpm[4],float voltage[4],'
          'float current[4]'),
}
CODES = {'uint8_t': 'B', 'int8_t': 'b', 'int16_t': 'h', 'uint16_t': 'H', 'int32_t': 'i',
         'uint32_t': 'I', 'int64_t': 'q', 'uint64_t': 'Q', 'float': 'f'}
EXTENSIONS = {77: 'BiBB'}

DOCUMENT = (Path(__file__).resolve().parents[2] / 'docs' / 'reference' / 'firmware.md').read_text()
(HOST_HEARTBEAT, ARM, DISARM, TARGET, TIME_REQUEST,     # from the computer (1, 191)
 TIME_ANSWER, ACCEPTED, REFUSED, BOARD_HEARTBEAT, BATTERY, ESC_STATUS, ESC_INFO,    # board (1, 1)
 RECEPTION) = (bytes.fromhex(packet) for packet in re.findall(
    r'`(fd(?: [0-9a-f]{2})+)`', DOCUMENT))
BY_HOST = (HOST_HEARTBEAT, ARM, DISARM, TARGET, TIME_REQUEST)
BY_BOARD = (TIME_ANSWER, ACCEPTED, REFUSED, BOARD_HEARTBEAT, BATTERY, ESC_STATUS, ESC_INFO,
            RECEPTION)


def crc(data):
    """CRC-16/MCRF4XX, bit by bit."""
    value = 0xFFFF
    for byte in data:
        for k in range(8):
            bit = (byte >> k ^ value) & 1
            value >>= 1
            if bit:
                value ^= 0x8408
    return value


def wire_fields(number):
    """(type, name, length) in wire order: larger types first, otherwise as defined."""
    fields = []
    for text in DEFINITIONS[number][1].split(','):
        kind, name = text.split()
        name, _, length = name.rstrip(']').partition('[')
        fields.append((kind, name, int(length or 0)))
    return sorted(fields, key=lambda field: -struct.calcsize(CODES[field[0]]))


def crc_extra(number):
    """CRC_EXTRA of a message from its definition."""
    text = DEFINITIONS[number][0].encode() + b' '
    for kind, name, length in wire_fields(number):
        text += f'{kind} {name} '.encode() + (bytes([length]) if length else b'')
    return crc(text) & 0xFF ^ crc(text) >> 8


def payload_format(number):
    """Format of a message's payload for struct."""
    return '<' + ''.join(f'{length or ""}{CODES[kind]}' for kind, _, length
                         in wire_fields(number)) + EXTENSIONS.get(number, '')


def parse(frame):
    """(number, sequence, sender, values in wire order) of one whole frame; ValueError if bad."""
    if frame[0] != 0xFD or frame[2] or frame[3] or len(frame) != 12 + frame[1]:
        raise ValueError(f'no frame: {frame.hex(" ")}')
    number = int.from_bytes(frame[7:10], 'little')
    if number not in DEFINITIONS:
        raise ValueError(f'unknown message: {frame.hex(" ")}')
    body, check = frame[1:-2], int.from_bytes(frame[-2:], 'little')
    if crc(body + bytes([crc_extra(number)])) != check:
        raise ValueError(f'checksum: {frame.hex(" ")}')
    if frame[1] > 1 and not frame[-3]:
        raise ValueError(f'zeros at the end are to be left out: {frame.hex(" ")}')
    form = payload_format(number)
    payload = frame[10:-2].ljust(struct.calcsize(form), b'\0')
    return number, frame[4], (frame[5], frame[6]), struct.unpack(form, payload)


def pack(number, values, sequence=0, sender=(1, 1)):
    """Frame of a message with ``values`` in wire order."""
    payload = struct.pack(payload_format(number), *values).rstrip(b'\0') or b'\0'
    body = bytes([len(payload), 0, 0, sequence, *sender]) + number.to_bytes(3, 'little') + payload
    return b'\xfd' + body + crc(body + bytes([crc_extra(number)])).to_bytes(2, 'little')


# Valid frames of the board with any content.
ANY_FRAME = strategies.sampled_from(sorted(DEFINITIONS)).flatmap(
    lambda number: strategies.binary(
        min_size=struct.calcsize(payload_format(number)),
        max_size=struct.calcsize(payload_format(number))).map(
            lambda payload: pack(number, struct.unpack(payload_format(number), payload))))


def split(data):
    """Frames of a stream without other bytes."""
    frames = []
    while data:
        frames.append(data[:12 + data[1]])
        data = data[12 + data[1]:]
    return frames
