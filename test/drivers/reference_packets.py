"""
MAVLink 2 packets written by hand, and a parser small enough to check by eye.

Sources: mavlink.io "Packet Serialization" (header, truncation of zeros, CRC-16/MCRF4XX over
header and payload and then the message's CRC_EXTRA) and the common message set. The checksums
at the ends of the packets were computed with :func:`crc` below, bit by bit.
"""

import struct

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


def packet(text):
    """Bytes of hexadecimal digits."""
    return bytes.fromhex(text)


# From the computer (system 1, component 191 = bf).
HOST_HEARTBEAT = packet('fd 09 00 00 00 01 bf 00 00 00'      # 9 bytes, number 0, HEARTBEAT
                        '00 00 00 00 12 08 00 04 03'         # custom mode, type 18, autopilot 8
                        'ae c6')
ARM = packet('fd 20 00 00 01 01 bf 4c 00 00'                 # 32 bytes: confirmation 0 left out
             '00 00 80 3f' + '00' * 24 +                     # param1 = 1.0
             '90 01 01 01'                                   # command 400 to 1, 1
             '6a 1b')
DISARM = packet('fd 20 00 00 02 01 bf 4c 00 00' + '00' * 28 + '90 01 01 01' '4f 9c')
TARGET = packet('fd 2b 00 00 03 01 bf 8b 00 00'
                '87 d6 12 00 00 00 00 00'                    # 1234567 us
                '00 00 00 3f 00 00 80 3e 00 00 80 3f' + '00' * 20 +     # 0.5 0.25 1 0 ...
                '00 01 01'                                   # group 0, to 1, 1
                'a6 98')
TIME_REQUEST = packet('fd 10 00 00 04 01 bf 6f 00 00' + '00' * 8 + '08 07 06 05 04 03 02 01'
                      '98 28')
# From the board (system 1, component 1).
TIME_ANSWER = packet('fd 10 00 00 05 01 01 6f 00 00'
                     '00 ca 9a 3b 00 00 00 00'               # 1 s
                     '08 07 06 05 04 03 02 01' '96 c8')
ACCEPTED = packet('fd 0a 00 00 06 01 01 4d 00 00' '90 01 00 00 01 00 00 00 01 bf' '6a 29')
REFUSED = packet('fd 0a 00 00 07 01 01 4d 00 00'
                 '90 01 01 00 01 0c 00 00 01 bf'             # throttle 04, battery 08
                 '6c 45')
BOARD_HEARTBEAT = packet('fd 09 00 00 08 01 01 00 00 00'
                         '03 00 00 01 02 00 81 04 03'        # running, contract 1
                         '2b 40')
BATTERY = packet('fd 24 00 00 09 01 01 93 00 00' 'ff ff ff ff ff ff ff ff ff 7f'
                 'c0 5d' + 'ff ff' * 9 +                     # 24000 mV
                 'd2 04 00 00 01 ff' '0f 7b')                # 12.34 A
ESC_STATUS = packet('fd 38 00 00 0a 01 01 23 01 00'          # 56 of 57 bytes: index 0 left out
                    '40 42 0f 00 00 00 00 00'                # 1 s
                    '70 17 00 00 71 17 00 00 72 17 00 00 00 00 00 00'
                    '00 00 c0 41 00 00 c0 41 00 00 c0 41 00 00 00 00'   # 24 V, 24, 24, 0
                    '00 00 40 40 00 00 40 40 00 00 40 40 00 00 40 40'   # 3 A
                    '5b ff')
ESC_INFO = packet('fd 2e 00 00 0b 01 01 22 01 00' '40 42 0f 00 00 00 00 00' + '00' * 12 +
                  '02 00 00 00 07 00 00 00 00 00 00 00 40 00'           # 2 errors, 7 packets
                  'ac 0d ac 0d ac 0d ff 7f 00 04 00 07'      # 35 C, rotor 4 unknown and offline
                  'd1 83')
RECEPTION = packet('fd 1f 00 00 0c 01 01 01 00 00' + '00' * 14 +
                   'c0 5d d2 04 00 00 05 00 03 00 02 00 07 00 01 00 ff' '78 fa')
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


def split(data):
    """Frames of a stream without other bytes."""
    frames = []
    while data:
        frames.append(data[:12 + data[1]])
        data = data[12 + data[1]:]
    return frames
