"""Frames by pymavlink and by hand from docs/reference/firmware.md, and the receiver's counts."""

import re
import struct

import pytest
import reference_packets as reference

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers.mavlink import common, MavlinkReceiver, restarted


@pytest.mark.parametrize('frame', reference.BY_HOST + reference.BY_BOARD, ids=lambda f: f.hex())
def test_packets_written_by_hand_are_read_and_written_alike(frame):
    number, sequence, sender, values = reference.parse(frame)
    assert reference.pack(number, values, sequence, sender) == frame
    (message,) = MavlinkReceiver(*sender).feed(frame)
    assert message.get_type() == reference.DEFINITIONS[number][0]
    read = [getattr(message, field) for _, field, _ in reference.wire_fields(number)]
    flat = [one for value in read for one in (value if isinstance(value, list) else [value])]
    assert tuple(flat) == values[:len(flat)]
    packer = common.MAVLink(None, *sender)
    packer.seq = sequence
    assert message.pack(packer) == frame


@pytest.mark.parametrize('number', reference.DEFINITIONS)
def test_seeds_and_sizes_agree_with_the_definitions_and_the_document(number):
    seed = reference.crc_extra(number)
    assert seed == common.mavlink_map[number].crc_extra
    name, size = reference.DEFINITIONS[number][0], struct.calcsize(
        reference.payload_format(number))
    assert re.search(rf'^\| {name} \| {number} \| {seed} \| {size} \|', reference.DOCUMENT,
                     re.MULTILINE), f'{name}: {number}, {seed}, {size}'


def sequence_of(*numbers):
    return b''.join(reference.pack(111, (1, 2), sequence) for sequence in numbers)


BEAT = reference.pack(0, (1 << 24, 2, 0, 1, 1, 3))
SPOILT = reference.BATTERY[:20] + b'\x5a' + reference.BATTERY[21:]


@pytest.mark.parametrize(('stream', 'counts'), [
    (sequence_of(250, 251, 254, 255, 0, 3), {'received': 6, 'lost': 4}),    # across the wrap
    (sequence_of(100) + BEAT + sequence_of(1), {'received': 3, 'lost': 0}),     # a restart
    (b'garbage' + SPOILT + reference.ACCEPTED,
     {'received': 1, 'bad_crc': 1, 'skipped_bytes': 7 + len(SPOILT)}),
    (reference.HOST_HEARTBEAT + sequence_of(9) + reference.ARM + sequence_of(10),
     {'received': 2, 'foreign': 2, 'lost': 0}),
    # A signed frame: the protocol excludes them; their additional bytes are not data.
    (b'\xfd' + reference.ACCEPTED[1:2] + b'\1' + reference.ACCEPTED[3:] + bytes(13),
     {'received': 0})])
def test_the_receiver_counts(stream, counts):
    receiver = MavlinkReceiver(1, 1, restarted)
    receiver.feed(stream)
    assert counts.items() <= receiver.counts.items()
