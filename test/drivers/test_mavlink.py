"""Frames of driver, emulated board and docs/reference/firmware.md, and framing of any bytes."""

import re

from hypothesis import given, settings, strategies
import pytest
import reference_packets as reference

from beetle_omni_ros.sim.emulated import board_firmware
from beetle_omni_ros.sim.emulated import mavlink as emulated
from beetle_omni_ros.sim.emulated.board_firmware import EmulatedBoardParameters

pytest.importorskip('pymavlink')

from pymavlink.dialects.v20 import common

from beetle_omni_ros.drivers.motor_board_state import MavlinkReceiver

FRAMES = strategies.sampled_from(reference.BY_BOARD)
# Markers and lengths are more frequent than in random bytes.
NOISE = strategies.lists(strategies.one_of(
    strategies.binary(max_size=40), strategies.just(b'\xfd'),
    FRAMES.flatmap(lambda frame: strategies.integers(1, len(frame) - 1).map(
        lambda size: frame[:size]))), max_size=6).map(b''.join)
CUTS = strategies.lists(strategies.integers(0, 10**6), max_size=6)


@pytest.mark.parametrize('frame', reference.BY_HOST + reference.BY_BOARD, ids=lambda f: f.hex())
def test_all_codecs_agree_with_the_packets_written_by_hand(frame):
    (message,) = emulated.Parser().feed(frame)
    number, sequence, sender, values = reference.parse(frame)
    assert (message.sequence, (message.system, message.component)) == (sequence, sender)
    assert message.values == values
    assert emulated.pack(message.number, message.values, sequence, *sender) == frame
    (message,) = MavlinkReceiver(*sender).feed(frame)
    assert message.get_type() == reference.DEFINITIONS[number][0]
    fields = [name for _, name, _ in reference.wire_fields(number)]
    read = [getattr(message, field) for field in fields]
    flat = [one for value in read for one in (value if isinstance(value, list) else [value])]
    assert tuple(flat) == values[:len(flat)]


@pytest.mark.parametrize('number', reference.DEFINITIONS)
def test_seeds_and_sizes_agree_with_the_definitions_and_the_document(number):
    seed, layout = emulated.MESSAGES[number]
    assert seed == reference.crc_extra(number) == common.mavlink_map[number].crc_extra
    name = reference.DEFINITIONS[number][0]
    assert re.search(rf'^\| {name} \| {number} \| {seed} \| {layout.size} \|', reference.DOCUMENT,
                     re.MULTILINE), f'{name}: {number}, {seed}, {layout.size}'


def test_a_flipped_bit_anywhere_is_refused_by_every_parser():
    """A CRC of 16 bits finds every error of one bit."""
    for bit in range(8, 8 * len(reference.TARGET)):
        spoilt = bytearray(reference.TARGET)
        spoilt[bit // 8] ^= 1 << bit % 8
        assert emulated.Parser().feed(bytes(spoilt)) == []
        assert MavlinkReceiver(1, 191).feed(bytes(spoilt)) == []
        with pytest.raises(ValueError):
            reference.parse(bytes(spoilt))


def test_the_document_shows_the_emulated_numbers_and_version():
    rows = re.findall(r'^\| `(\w+)` \| ([\d.]+) (?:s|V|Hz) \|', reference.DOCUMENT, re.MULTILINE)
    assert len(rows) == 14
    parameters = EmulatedBoardParameters.load()
    for name, value in rows:
        assert getattr(parameters, name) == float(value), name
    assert f'**Contract version {board_firmware.CONTRACT_VERSION}.**' in reference.DOCUMENT


# --- framing ----------------------------------------------------------------------------------

@settings(max_examples=300, deadline=None)
@given(NOISE, strategies.lists(FRAMES, min_size=1, max_size=4), CUTS)
def test_good_frames_in_pieces_are_found_after_any_noise(noise, frames, cuts):
    def pieces(data):
        ends = sorted(cut % (len(data) + 1) for cut in cuts)
        return [data[a:b] for a, b in zip([0, *ends], [*ends, len(data)])]

    for receiver in (MavlinkReceiver(1, 1), emulated.Parser()):
        data = b''.join(frames)
        assert len([found for piece in pieces(data) for found in receiver.feed(piece)]) \
            == len(frames)
        for piece in pieces(noise):
            receiver.feed(piece)
        receiver.feed(bytes(300))   # a corrupt header no longer waits for the end of its frame
        assert len(receiver.feed(data)) == len(frames)


def sequence_of(*numbers):
    """Frames of one message with these sequence numbers."""
    return b''.join(emulated.pack(emulated.TIMESYNC, (1, 2), sequence, 1, 1)
                    for sequence in numbers)


BEAT = emulated.pack(emulated.HEARTBEAT, (1 << 24, 2, 0, 1, 1, 3), 0, 1, 1)
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
    receiver = MavlinkReceiver(1, 1)
    receiver.feed(stream)
    assert counts.items() <= receiver.counts.items()
