"""State of the board for any numbers in its messages."""

import time

from hypothesis import given, settings, strategies
import pytest
import reference_packets as reference

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.sim.emulated import mavlink as emulated

pytest.importorskip('pymavlink')

from beetle_omni_ros.drivers.mavlink_receiver import MavlinkReceiver
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.motor_board_watch import BoardWatch, restarted

ROBOT, PARAMETERS = RobotParameters.load(), MotorBoardParameters.load()
PAYLOADS = strategies.sampled_from(sorted(emulated.MESSAGES)).flatmap(
    lambda number: strategies.tuples(strategies.just(number), strategies.binary(
        min_size=emulated.MESSAGES[number][1].size, max_size=emulated.MESSAGES[number][1].size)))


def watch():
    """A BoardWatch without messages."""
    return BoardWatch(PARAMETERS, ROBOT, time.time)


def received(number, values):
    """A decoded message of the board."""
    (message,) = MavlinkReceiver(1, 1).feed(emulated.pack(number, values, 0, 1, 1))
    return message


@settings(max_examples=400, deadline=None)
@given(strategies.lists(PAYLOADS, max_size=8))
def test_valid_frames_with_arbitrary_content_are_tolerated(payloads):
    """The voltage for the thrust map remains plausible."""
    board = watch()
    for number, payload in payloads:
        message = received(number, emulated.MESSAGES[number][1].unpack(payload))
        board.message(message, time.monotonic())
        board.tick(time.monotonic(), True)
        restarted(message)
    assert board.voltage is None or 15.0 <= board.voltage <= 26.4
    assert not board.clock.known        # without a request
    assert all(len(text.splitlines()) == 1 for _, text in board.take()['events'])


def test_only_answers_to_own_requests_count_and_only_once():
    board = watch()
    question = board.timesync_request()
    now = time.monotonic()
    board.message(received(emulated.TIMESYNC, (5 * 10**9, question.ts1 + 1)), now)
    assert not board.clock.known
    for remote in (5, 900):
        board.message(received(emulated.TIMESYNC, (remote * 10**9, question.ts1)), now)
    assert abs(board.clock.offset() + now - 5) < 0.1
    assert board.clock.jumps == 0


def test_the_voltage_filter_depends_on_time_and_not_on_message_count():
    board = watch()
    cells = [65535] * 9

    def tell(volts, now):
        board.message(received(emulated.BATTERY_STATUS, (
            -1, -1, 0, round(1000 * volts), *cells, 0, 0, 0, 1, -1)), now)

    tell(25.0, 10.0)
    assert board.voltage == 25.0
    tell(24.0, 10.0 + PARAMETERS.voltage_time_constant)
    assert board.voltage == pytest.approx(25 - (1 - 1 / 2.718281828), abs=1e-6)
    tell(24.0, 20.0)
    assert board.voltage == pytest.approx(24.0)


def test_changes_are_reported_once_and_severe_ones_as_errors():
    board = watch()

    def heartbeat(state, reason=0, conditions=0):
        mode = state | reason << 8 | conditions << 16 | 1 << 24
        board.message(received(emulated.HEARTBEAT, (mode, 2, 0, 1, 4, 3)), time.monotonic())
        return board.take()['events']

    assert heartbeat(1) == (('info', 'motor board: found, disarmed, contract 1'),)
    assert heartbeat(3) == (('info', 'motor board: armed'),)
    assert heartbeat(3) == ()
    assert heartbeat(2, 0, 32) == (('error', 'motor board: targets timed out'),)
    assert heartbeat(2, 0, 32 | 8) == (('warning', 'motor board: battery low'),)
    assert heartbeat(1, 3) == (('error', 'motor board: disarmed (no target for too long)'),)
    assert heartbeat(3) == (('info', 'motor board: armed'),)
    assert heartbeat(1, 1) == (('info', 'motor board: disarmed (requested by the host)'),)
    assert heartbeat(0, 4)[0] == ('warning', 'motor board: restarted (watchdog reset)')


def test_offline_escs_are_reported():
    board = watch()
    message = MavlinkReceiver(1, 1).feed(reference.ESC_INFO)[0]
    board.message(message, time.monotonic())
    assert board.take()['events'] == (('error', 'motor board: ESC of rotor 4 offline'),)
    board.message(message, time.monotonic())
    assert board.take()['events'] == ()
