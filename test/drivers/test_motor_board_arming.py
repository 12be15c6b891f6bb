"""Rules of arming, disarming and loss of the board, on a simple substitute of the board."""

from types import SimpleNamespace

import pytest

pytest.importorskip('pymavlink')
pytest.importorskip('serial')

from beetle_omni_ros.drivers.mavlink import BoardStatus
from beetle_omni_ros.drivers.motor_board import Arming, PATIENCE, STEP
from beetle_omni_ros.model.mode import Mode

CYCLE = 0.005
DISARMED = BoardStatus('disarmed', 'none', (), 1)
ARMED = BoardStatus('armed', 'none', (), 1)


class BoardStub:
    """A board whose answers are set by the test."""

    def __init__(self):
        self.ready, self.state, self.commands = '', SimpleNamespace(status=DISARMED), []
        self.connected = True

    def start(self, arm):
        self.commands.append(SimpleNamespace(arm=arm, accepted=None, reason=''))
        return self.commands[-1]

    def answer(self, accepted=True, reason=''):
        command = self.commands[-1]
        command.accepted, command.reason = accepted, reason
        if accepted:
            self.state.status = ARMED if command.arm else DISARMED

    @property
    def asked(self):
        """Last command: True to arm, False to disarm."""
        return self.commands[-1].arm if self.commands else None


@pytest.fixture
def bench():
    board = BoardStub()
    return board, Arming(board)


def disarmed(board, arming):
    arming.follow(Mode('disarmed'))
    board.answer()
    arming.update(CYCLE)
    return arming.text


def in_flight(bench):
    board, arming = bench
    assert disarmed(board, arming) == 'ready'
    arming.follow(Mode('takeoff'))
    assert arming.phase == 'arms' and board.asked is True
    arming.update(CYCLE)
    assert arming.phase == 'arms'
    board.answer()
    arming.update(CYCLE)
    assert (arming.phase, arming.text) == ('flies', 'ready')
    return board, arming


def test_arming_waits_for_board_and_supervisor_and_names_which(bench):
    board, arming = bench
    board.ready, board.state.status = 'port is away', None
    assert arming.text == 'waiting: port is away'
    board.ready, board.state.status = '', BoardStatus('disarmed', 'none',
                                                ('battery low', 'saturated'), 1)
    assert arming.text == 'waiting: battery low'
    board.state.status = DISARMED
    assert arming.text == 'waiting: no message from the supervisor'
    arming.follow(Mode('disarmed'))
    assert arming.text == 'waiting: disarming is not confirmed yet'
    board.answer()
    arming.update(CYCLE)
    assert arming.text == 'ready'


@pytest.mark.parametrize('stop', ['disarmed', 'emergency_stop'])
def test_arming_follows_the_supervisor_and_disarming_is_repeated_until_confirmed(bench, stop):
    board, arming = in_flight(bench)
    for state in ('flying:nmpc', 'fallback', 'landing'):
        arming.follow(Mode(state))
        arming.update(CYCLE)
        assert arming.phase == 'flies'
    asked = len(board.commands)
    arming.follow(Mode(stop))
    assert arming.phase == 'rests' and board.asked is False and len(board.commands) == asked + 1
    arming.update(CYCLE)
    assert len(board.commands) == asked + 1     # an answer may still come
    board.answer(False, 'no acknowledgement to 5 attempts')
    arming.update(CYCLE)
    assert len(board.commands) == asked + 2 and board.asked is False
    board.answer()
    arming.update(CYCLE)
    arming.update(CYCLE)
    assert len(board.commands) == asked + 2


def test_a_refusal_to_arm_is_reported_and_not_retried(bench):
    board, arming = bench
    arming.follow(Mode('disarmed'))
    arming.follow(Mode('takeoff'))
    board.answer(False, 'refused by the board: battery low')
    arming.update(CYCLE)
    assert arming.text == 'lost: not armed: refused by the board: battery low'
    assert board.asked is False
    board.answer()
    for _ in range(100):
        arming.update(CYCLE)
    assert board.asked is False
    assert disarmed(board, arming) == 'ready'


@pytest.mark.parametrize(('status', 'why'), [
    (BoardStatus('boot', 'none', (), 1), 'restarted'),
    (BoardStatus('disarmed', 'watchdog reset', (), 1), 'restarted (watchdog reset)'),
    (BoardStatus('disarmed', 'no target for too long', (), 1),
     'disarmed (no target for too long)'),
    (None, 'restarted')])
def test_a_board_that_stopped_in_flight_is_lost_until_the_supervisor_is_disarmed(
        bench, status, why):
    board, arming = in_flight(bench)
    board.state.status = status
    arming.update(CYCLE)
    assert arming.text == f'lost: {why}' and board.asked is False
    board.state.status = ARMED        # by another program: it is disarmed again
    board.answer()
    board.state.status = ARMED
    asked = len(board.commands)
    arming.update(CYCLE)
    assert len(board.commands) == asked + 1 and board.asked is False
    for state in ('flying:nmpc', 'emergency_stop'):
        arming.follow(Mode(state))
        board.answer()
        arming.update(CYCLE)
        assert arming.text == f'lost: {why}' and board.asked is False
    assert disarmed(board, arming) == 'ready'
    arming.follow(Mode('takeoff'))
    assert board.asked is True


@pytest.mark.parametrize(('connected', 'text'), [
    (True, 'silent: no message from the board'), (False, 'lost: no message from the board')])
def test_a_silent_board_is_reported_after_a_timeout_that_excludes_own_pauses(
        bench, connected, text):
    board, arming = in_flight(bench)
    board.connected = connected
    for _ in range(20):     # delayed repeatedly, with messages in between
        board.ready = 'no message from the board'
        arming.update(10.0)
        assert arming.phase == 'flies'
        board.ready = ''
        arming.update(CYCLE)
    board.ready = 'no message from the board'
    for _ in range(round(PATIENCE / STEP) - 1):
        arming.update(10.0)
    assert arming.phase == 'flies'
    arming.update(10.0)
    assert arming.text == text
    assert board.asked is connected     # one that may still fly is not disarmed
    board.ready = ''
    arming.update(CYCLE)
    assert arming.text == ('ready' if connected else text)


def test_arming_in_flight_never_happens(bench):
    board, arming = bench
    arming.follow(Mode('flying:nmpc'))
    assert arming.text == 'lost: the supervisor was not disarmed before'
    for state in ('disarmed', 'emergency_stop', 'takeoff'):
        arming.follow(Mode(state))
    assert arming.text == 'lost: the supervisor was not disarmed before'
    assert board.asked is False
