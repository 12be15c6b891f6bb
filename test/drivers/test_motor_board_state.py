"""State of the board for any numbers in its messages, and the offset of its clock."""

import math
import time

from hypothesis import given, settings, strategies
import pytest
import reference_packets as reference

from beetle_omni_ros.model.parameters import RobotParameters

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers import motor_board_state
from beetle_omni_ros.drivers.mavlink import MavlinkReceiver, restarted
from beetle_omni_ros.drivers.motor_board_state import BoardState, ClockOffset, conditions_of

CELLS = RobotParameters.load().battery.cells
DELAYS = strategies.floats(1e-5, 0.2)


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
        tell(board, 147, (-1, -1, 0, round(1000 * volts), *[65535] * 9,
                                              0, 0, 0, 1, -1), now)

    measure(25.0, 10.0)
    assert board.voltage == 25.0
    measure(24.0, 10.0 + motor_board_state.VOLTAGE_TIME_CONSTANT)
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
