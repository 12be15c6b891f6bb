"""Packets of driver and emulated board, byte by byte, against packets written by hand."""

import pytest
import reference_packets as reference

from beetle_omni_ros.sim.emulated import mavlink as emulated

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers import mavlink_dialect as dialect
from beetle_omni_ros.drivers import motor_board_messages as messages
from beetle_omni_ros.drivers.mavlink_dialect import common

FROM_HOST = {
    'heartbeat': (reference.HOST_HEARTBEAT, messages.heartbeat()),
    'arm': (reference.ARM, common.MAVLink_command_long_message(
        1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)),
    'disarm': (reference.DISARM, common.MAVLink_command_long_message(
        1, 1, 400, 0, 0, 0, 0, 0, 0, 0, 0)),
    'target': (reference.TARGET, common.MAVLink_set_actuator_control_target_message(
        1234567, 0, 1, 1, [0.5, 0.25, 1, 0, 0, 0, 0, 0])),
    'time': (reference.TIME_REQUEST, common.MAVLink_timesync_message(0, 0x0102030405060708))}


@pytest.mark.parametrize('name', FROM_HOST)
def test_driver_packets_equal_hand_written_bytes(name):
    expected, message = FROM_HOST[name]
    packer = common.MAVLink(None, 1, 191)
    packer.seq = expected[4]
    assert message.pack(packer) == expected


@pytest.mark.parametrize('frame', reference.BY_HOST + reference.BY_BOARD, ids=lambda f: f.hex())
def test_the_emulators_codec_reads_and_writes_the_same_bytes(frame):
    (message,) = emulated.Parser().feed(frame)
    _, sequence, sender, values = reference.parse(frame)
    assert (message.sequence, (message.system, message.component)) == (sequence, sender)
    assert message.values == values
    assert emulated.pack(message.number, message.values, sequence, *sender) == frame


@pytest.mark.parametrize('frame', reference.BY_HOST + reference.BY_BOARD, ids=lambda f: f.hex())
def test_the_parser_of_pymavlink_accepts_the_hand_written_packets(frame):
    (message,) = common.MAVLink(None).parse_buffer(frame)
    assert message.get_type() == reference.DEFINITIONS[message.get_msgId()][0]


@pytest.mark.parametrize('number', reference.DEFINITIONS)
def test_checksum_seeds_follow_from_the_definitions(number):
    seed = reference.crc_extra(number)
    assert emulated.MESSAGES[number][0] == seed
    assert dialect.MESSAGES[number].crc_extra == seed


def test_esc_messages_have_the_published_seeds_and_sizes():
    """The numbers of the generated C headers: ESC_INFO 251, 46 bytes; ESC_STATUS 10, 57."""
    assert (dialect.EscInfo.crc_extra, dialect.EscInfo.unpacker.size) == (251, 46)
    assert (dialect.EscStatus.crc_extra, dialect.EscStatus.unpacker.size) == (10, 57)


def test_esc_messages_round_trip():
    status = dialect.EscStatus(0, 1000000, [6000, 6001, 6002, 0], [24, 24, 24, 0], [3, 3, 3, 3])
    packer = common.MAVLink(None, 1, 1)
    packer.seq = 10
    assert status.pack(packer) == reference.ESC_STATUS
    (back,) = common.MAVLink(None).parse_buffer(reference.ESC_STATUS)
    assert (back.index, back.rpm, back.current) == (0, [6000, 6001, 6002, 0], [3, 3, 3, 3])


def decoded(frame):
    """Message of a frame."""
    return common.MAVLink(None).decode(bytearray(frame))


def test_board_messages_agree_with_the_documented_protocol():
    status = messages.status_of(decoded(reference.BOARD_HEARTBEAT), 5.0)
    assert (status.state, status.armed, status.contract) == ('running', True, 1)
    assert (status.stop_reason, status.conditions) == ('none', ())
    battery = messages.battery_of(decoded(reference.BATTERY), 5.0)
    assert (battery.voltage, battery.current) == (24.0, -12.34)
    info = decoded(reference.ESC_INFO)
    rotors = messages.rotors_of(decoded(reference.ESC_STATUS), info, 5.0)
    assert rotors.rpm[:3].tolist() == [6000, 6001, 6002]
    assert rotors.temperature[0] == 35.0
    assert rotors.failures == ((), (), (), ('generic',))
    assert all(values[3] != values[3] for values in (rotors.rpm, rotors.voltage, rotors.current,
                                                     rotors.temperature))
    assert rotors.error_count.tolist() == [0, 0, 0, 2]
    assert messages.conditions_of(0x0C) == ('throttle not low', 'battery low')


def test_a_flipped_bit_anywhere_is_refused_by_every_parser():
    """A CRC of 16 bits finds every error of one bit."""
    for bit in range(8, 8 * len(reference.TARGET)):
        spoilt = bytearray(reference.TARGET)
        spoilt[bit // 8] ^= 1 << bit % 8
        assert emulated.Parser().feed(bytes(spoilt)) == []
        with pytest.raises(ValueError):
            reference.parse(bytes(spoilt))
