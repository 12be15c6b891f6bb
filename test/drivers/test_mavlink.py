"""Frames by pymavlink and by hand from docs/reference/firmware.md, and what they change."""

import math
import re
import struct
import time

from hypothesis import given, settings, strategies
import pytest
import reference_packets as reference

from beetle_omni_ros.model.parameters import RobotParameters

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers import mavlink
from beetle_omni_ros.drivers.mavlink import (
    BoardState,
    ClockOffset,
    common,
    conditions_of,
    MavlinkReceiver,
    restarted,
)

CELLS = RobotParameters.load().battery.cells
DELAYS = strategies.floats(1e-5, 0.2)


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


# --- state of the board -------------------------------------------------------------------------

@pytest.fixture
def board():
    return BoardState(CELLS, 0.3, time.time)


def tell(board, number, values, now):
    (message,) = MavlinkReceiver(1, 1).feed(reference.pack(number, values))
    board.message(message, now)


@settings(max_examples=400, deadline=None)
@given(strategies.lists(reference.ANY_FRAME, max_size=8))
def test_valid_frames_with_arbitrary_content_are_tolerated(frames):
    """The voltage for the thrust map remains plausible."""
    board = BoardState(CELLS, 0.3, time.time)
    for message in MavlinkReceiver(1, 1).feed(b''.join(frames)):
        board.message(message, time.monotonic())
        restarted(message)
    assert board.voltage is None or 15.0 <= board.voltage <= 26.4
    assert not board.clock.known        # without a request


def test_the_documented_packets_are_read_in_si_units(board):
    for message in MavlinkReceiver(1, 1).feed(b''.join(reference.BY_BOARD)):
        board.message(message, 5.0)
    status = board.status
    assert (status.state, status.armed, status.contract) == ('running', True, 1)
    assert (status.stop_reason, status.conditions) == ('none', ())
    assert conditions_of(0x0C) == ('throttle not low', 'battery low')
    assert board.reception == {'lost': 3, 'bad_crc': 2, 'refused': 7, 'timeouts': 1}
    assert (board.battery.voltage, board.battery.current) == (24.0, -12.34)
    for message in MavlinkReceiver(1, 1).feed(reference.ESC_INFO + reference.ESC_STATUS):
        board.message(message, 5.0)
    _, rotors = board.take()
    assert rotors.rpm[:3].tolist() == [6000, 6001, 6002]
    assert rotors.temperature[0] == 35.0
    assert rotors.failures == ((), (), (), ('generic',))
    assert all(math.isnan(values[3]) for values in (rotors.rpm, rotors.voltage, rotors.current,
                                                    rotors.temperature))
    assert rotors.error_count.tolist() == [0, 0, 0, 2]


def test_only_answers_to_own_requests_count_and_only_once(board):
    question, now = board.timesync_request(), time.monotonic()
    tell(board, 111, (5 * 10**9, question.ts1 + 1), now)
    assert not board.clock.known
    for remote in (5, 900):
        tell(board, 111, (remote * 10**9, question.ts1), now)
    assert abs(board.clock.offset() + now - 5) < 0.1


def test_the_voltage_filter_depends_on_time_and_not_on_message_count(board):
    def measure(volts, now):
        tell(board, 147, (-1, -1, 0, round(1000 * volts), *[65535] * 9, 0, 0, 0, 1, -1), now)

    measure(25.0, 10.0)
    assert board.voltage == 25.0
    measure(24.0, 10.0 + mavlink.VOLTAGE_TIME_CONSTANT)
    assert board.voltage == pytest.approx(25 - (1 - math.exp(-1)), abs=1e-6)
    measure(24.0, 20.0)
    assert board.voltage == pytest.approx(24.0)


# --- the clock --------------------------------------------------------------------------------

@given(strategies.floats(-1e4, 1e4), strategies.floats(-1e-4, 1e-4),
       strategies.lists(strategies.tuples(DELAYS, DELAYS), min_size=1, max_size=50))
def test_the_true_offset_is_within_the_bound(start, drift, delays):
    """With unequal delays of 10 us to 0.2 s, and drift within its bound."""
    clock, now = ClockOffset(), 100.0

    def truth(time):
        return start + drift * (time - 100.0)

    for there, back in delays:
        remote = now + there + truth(now + there)
        clock.add(now, remote, now + there + back)
        now += there + back
        assert abs(clock.offset() - truth(now)) <= clock.uncertainty(now) + 1e-9
        now += 0.2
        assert abs(clock.offset() - truth(now)) <= clock.uncertainty(now) + 1e-9


def test_a_restarted_clock_is_detected_and_the_offset_replaced():
    clock = ClockOffset()
    clock.add(10.0, 500.001, 10.002)
    clock.add(11.0, 0.001, 11.002)
    assert clock.offset() == pytest.approx(-11, abs=1e-6)
