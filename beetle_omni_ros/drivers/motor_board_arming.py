"""When the motor board is armed and disarmed, and what is said of it: the bridge's rule."""

from __future__ import annotations

from beetle_omni_ros.drivers.motor_board import ArmCommand, MotorBoard
from beetle_omni_ros.drivers.motor_board_messages import BLOCKS_ARMING

DISARMED = 'disarmed'
RESTING = (DISARMED, 'emergency_stop')      # states of the supervisor without thrust
RESTS, ARMS, FLIES, LOST = 'rests', 'arms', 'flies', 'lost'
# A board that seems gone is given this long [s], in steps of at most STEP [s]: after a pause of
# this process itself what the board has said meanwhile is read first.
PATIENCE, STEP = 0.05, 0.01


class Arming:
    """
    Keeps the board armed while the supervisor flies, and only then.

    It arms once, when the supervisor leaves 'disarmed'. A board that is lost afterwards is
    disarmed and left alone until the supervisor has been 'disarmed' again. One that is merely not
    heard, while targets can be sent, goes on: its rotors carry the robot to the ground.

    Attributes:
        phase: 'rests', 'arms', 'flies' or 'lost'; targets are for 'flies' alone.

    """

    def __init__(self, board: MotorBoard):
        """Begin at rest, whatever the board was left in."""
        self._board = board
        self._command: ArmCommand | None = None
        self._supervisor = ''
        self._lost = self._deaf = self._barred = ''
        self._gone = 0.0
        self._disarm = False        # whether the board has yet to confirm it
        self.phase = RESTS

    def bar(self, why: str) -> None:
        """Keep the board disarmed for a reason, also in flight; '' lets it be armed again."""
        self._barred = why
        if why and self.phase in (ARMS, FLIES):
            self._lose(why)

    def follow(self, state: str) -> None:
        """Take the supervisor's ``state``, perhaps with a fault's name, and act on it at once."""
        state = state.partition(':')[0]
        before, self._supervisor = self._supervisor, state
        if state in RESTING:
            if self.phase != LOST or state == DISARMED:
                self.phase = RESTS
            if before != state:
                self._start_disarm()
        elif before in RESTING or not before:
            if before == DISARMED and not self._barred:
                self.phase, self._disarm, self._gone = ARMS, False, 0.0
                self._command = self._board.start_arm()
                self._look_at_answer(0.0)
            else:
                self._lose(self._barred or 'the supervisor was not disarmed before')

    def update(self, elapsed: float) -> None:
        """Look at the board; ``elapsed`` [s] since the last look."""
        status, elapsed = self._board.status, min(elapsed, STEP)
        if self.phase == ARMS:
            self._look_at_answer(elapsed)
        elif self.phase == FLIES:
            missing = self._board.ready
            self._gone = self._gone + elapsed if missing else 0.0
            if status is None or not status.armed:
                self._lose(_ending(status))
            elif self._gone < PATIENCE:
                self._deaf = self._deaf and missing
            elif self._board.connected:
                self._deaf = missing
            else:
                self._lose(missing)
        else:
            answer = self._command and self._command.result
            if answer:
                self._disarm = self._disarm and not answer.accepted
            if (self._disarm or status and status.armed) and (answer or not self._command):
                self._start_disarm()

    def end(self) -> None:
        """The bridge stops."""
        self.phase = LOST
        self._lost = 'the bridge has stopped'

    @property
    def text(self) -> str:
        """What the supervisor needs to know: 'ready', 'waiting:', 'silent:' or 'lost: WHY'."""
        if self.phase == LOST:
            return f'lost: {self._lost}'
        if self.phase == FLIES and self._deaf:
            return f'silent: {self._deaf}'
        missing = self.missing if self.phase == RESTS else ''
        return f'waiting: {missing}' if missing else 'ready'

    @property
    def missing(self) -> str:
        """What would keep the board from arming now, on either side; '' when nothing."""
        if self._barred:
            return self._barred
        missing = self._board.ready or self._disarm and 'disarming is not confirmed yet'
        blocking = missing or ', '.join(text for text in self._board.status.conditions
                                        if text in BLOCKS_ARMING)
        return blocking or ('' if self._supervisor else 'nothing heard of the supervisor')

    def _look_at_answer(self, elapsed):
        answer, status = self._command.result, self._board.status
        if answer is None:
            return
        if not answer.accepted:
            self._lose(f'not armed: {answer.reason}')
        elif status.armed:
            self.phase, self._gone, self._deaf = FLIES, 0.0, ''
        else:
            self._gone += elapsed       # the link's thread is just about to note it
            if self._gone >= PATIENCE:
                self._lose(_ending(status))

    def _lose(self, why):
        self.phase, self._lost = LOST, why
        self._start_disarm()

    def _start_disarm(self):
        self._disarm = True
        self._command = self._board.start_disarm()


def _ending(status):
    """Why an armed board is not armed any more."""
    if status is None or status.state == 'boot' or status.stop_reason in ('none',
                                                                        'watchdog reset'):
        return 'restarted' + (' (watchdog reset)' if status and status.stop_reason != 'none'
                              else '')
    return f'{status.state} ({status.stop_reason})'
