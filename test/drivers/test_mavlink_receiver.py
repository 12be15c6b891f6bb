"""Framing: any bytes in any pieces raise nothing, and the next valid frame is found."""

from hypothesis import given, settings, strategies
import pytest
import reference_packets as reference

from beetle_omni_ros.sim.emulated import mavlink as emulated

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers.mavlink_dialect import common
from beetle_omni_ros.drivers.mavlink_receiver import MavlinkReceiver
from beetle_omni_ros.drivers.motor_board_watch import restarted

FRAMES = strategies.sampled_from(reference.BY_BOARD)
# Markers and lengths are more frequent than in random bytes.
NOISE = strategies.lists(strategies.one_of(
    strategies.binary(max_size=40), strategies.just(b'\xfd'),
    FRAMES.flatmap(lambda frame: strategies.integers(1, len(frame) - 1).map(
        lambda size: frame[:size]))), max_size=6).map(b''.join)


def receivers():
    """Both parsers: the driver's and the emulated board's."""
    return MavlinkReceiver(1, 1), emulated.Parser()


def pieces(data, cuts):
    """``data`` cut at ``cuts``."""
    ends = sorted(cut % (len(data) + 1) for cut in cuts)
    return [data[a:b] for a, b in zip([0, *ends], [*ends, len(data)])]


@settings(max_examples=300, deadline=None)
@given(NOISE, strategies.lists(strategies.integers(0, 10**6), max_size=5))
def test_arbitrary_bytes_neither_raise_nor_accumulate(noise, cuts):
    for receiver in receivers():
        for piece in pieces(noise, cuts):
            receiver.feed(piece)
        assert len(receiver._buffer) <= 280


@settings(max_examples=300, deadline=None)
@given(strategies.lists(FRAMES, min_size=1, max_size=6),
       strategies.lists(strategies.integers(0, 10**6), max_size=8))
def test_frames_split_between_reads_are_found(frames, cuts):
    data = b''.join(frames)
    for receiver in receivers():
        found = [message for piece in pieces(data, cuts) for message in receiver.feed(piece)]
        assert len(found) == len(frames)


@settings(max_examples=300, deadline=None)
@given(NOISE, strategies.lists(FRAMES, min_size=1, max_size=4))
def test_good_frames_after_noise_are_found(noise, frames):
    """Once no corrupt header can still wait for the end of its frame."""
    for receiver in receivers():
        receiver.feed(noise)
        found = receiver.feed(b''.join(frames) + bytes(300))
        assert len(found) >= len(frames)


@given(strategies.integers(0, len(reference.BATTERY) - 1), strategies.integers(0, 7))
def test_a_corrupted_frame_costs_no_other_frame(position, bit):
    spoilt = bytearray(reference.BATTERY)
    spoilt[position] ^= 1 << bit
    stream = bytes(spoilt) + reference.ESC_STATUS + reference.ACCEPTED + bytes(300)
    for receiver in receivers():
        numbers = [m.number if isinstance(m, emulated.Message) else m.get_msgId()
                   for m in receiver.feed(stream)]
        assert numbers == [291, 77]


def sequence_of(*numbers, number=emulated.TIMESYNC, values=(1, 2)):
    """Frames of one message with these sequence numbers."""
    return b''.join(emulated.pack(number, values, sequence, 1, 1) for sequence in numbers)


def test_lost_packets_are_counted_across_a_sequence_wrap():
    receiver = MavlinkReceiver(1, 1)
    receiver.feed(sequence_of(250, 251, 254, 255, 0, 3))
    assert (receiver.counts.messages, receiver.counts.lost) == (6, 4)


def test_bad_checksums_and_skipped_bytes_are_counted():
    receiver = MavlinkReceiver(1, 1)
    spoilt = bytearray(reference.BATTERY)
    spoilt[20] ^= 1
    receiver.feed(b'garbage' + bytes(spoilt) + reference.ACCEPTED)
    assert receiver.counts.bad_crc == 1
    assert receiver.counts.skipped_bytes == 7 + len(spoilt)
    assert receiver.counts.messages == 1


def test_other_senders_are_ignored_and_do_not_affect_the_sequence():
    receiver = MavlinkReceiver(1, 1)
    assert receiver.feed(reference.HOST_HEARTBEAT) == []
    receiver.feed(sequence_of(9) + reference.ARM + sequence_of(10))
    assert (receiver.counts.foreign, receiver.counts.lost) == (2, 0)


def test_a_restart_of_the_sender_is_not_counted_as_loss():
    beat = emulated.pack(emulated.HEARTBEAT, (1 << 24, 2, 0, 1, 1, 3), 0, 1, 1)
    receiver = MavlinkReceiver(1, 1, restarted)
    receiver.feed(sequence_of(100) + beat + sequence_of(1))
    assert (receiver.counts.messages, receiver.counts.lost) == (3, 0)


def test_signed_frames_are_refused():
    """The protocol excludes them; their additional bytes are not data."""
    frame = bytearray(reference.ACCEPTED)
    frame[2] = 1
    for receiver in receivers():
        assert receiver.feed(bytes(frame) + bytes(13)) == []


def test_the_framing_of_pymavlink_loses_good_packets():
    """Reason for the framing in the driver; if this fails, pymavlink has improved."""
    spoilt = bytearray(reference.BATTERY)
    spoilt[1] = 200
    stream = bytes(spoilt) + 3 * reference.ESC_STATUS + bytes(300)
    parser = common.MAVLink(None)
    parser.robust_parsing = True
    found = [m for m in parser.parse_buffer(stream) or [] if m.get_type() == 'ESC_STATUS']
    assert len(MavlinkReceiver(1, 1).feed(stream)) == 3 > len(found)
