"""Arms and disarms the motor board by the state of the supervisor."""

from beetle_omni_ros.drivers.motor_board import ArmCommand, MotorBoard
from beetle_omni_ros.drivers.motor_board_messages import BLOCKS_ARMING

DISARMED = 'disarmed'
RESTING = (DISARMED, 'emergency_stop')      # states of the supervisor without thrust
RESTS, ARMS, FLIES, LOST = 'rests', 'arms', 'flies', 'lost'
# A board that is not ready is tolerated for this long [s], counted in steps of at most STEP [s]:
# after a pause of this process the waiting messages of the board are read first.
PATIENCE, STEP = 0.05, 0.01


class Arming:
    """
    Keeps the board armed while the supervisor flies.

    It arms once, when the supervisor leaves 'disarmed'. A board that is lost later is disarmed,
    and not armed before the supervisor has been 'disarmed' again. A board that is only silent,
    while targets can be sent, remains armed, because its rotors carry the robot to the ground.

    Attributes:
        phase: 'rests', 'arms', 'flies' or 'lost'; targets are sent only in 'flies'.

    """

    def __init__(self, board: MotorBoard):
        self._board = board
        self._command: ArmCommand | None = None
        self._supervisor = ''
        self._lost = self._silent = self._inhibited = ''
        self._missing_for = 0.0
        self._disarm = False        # whether a confirmation of disarming is pending
        self.phase = RESTS

    def inhibit(self, reason: str) -> None:
        """Keep the board disarmed for a reason, also in flight; '' ends this."""
        self._inhibited = reason
        if reason and self.phase in (ARMS, FLIES):
            self._set_lost(reason)

    def follow(self, state: str) -> None:
        """Act on the state of the supervisor, 'STATE' or 'STATE: FAULT'."""
        state = state.partition(':')[0]
        before, self._supervisor = self._supervisor, state
        if state in RESTING:
            if self.phase != LOST or state == DISARMED:
                self.phase = RESTS
            if before != state:
                self._start_disarm()
        elif before in RESTING or not before:
            if before == DISARMED and not self._inhibited:
                self.phase, self._disarm, self._missing_for = ARMS, False, 0.0
                self._command = self._board.start_arm()
                self._check_answer(0.0)
            else:
                self._set_lost(self._inhibited or 'the supervisor was not disarmed before')

    def update(self, elapsed: float) -> None:
        """Check the board, ``elapsed`` [s] after the last call."""
        status, elapsed = self._board.status, min(elapsed, STEP)
        if self.phase == ARMS:
            self._check_answer(elapsed)
        elif self.phase == FLIES:
            missing = self._board.ready
            self._missing_for = self._missing_for + elapsed if missing else 0.0
            if status is None or not status.armed:
                self._set_lost(_disarm_cause(status))
            elif self._missing_for < PATIENCE:
                self._silent = self._silent and missing
            elif self._board.connected:
                self._silent = missing
            else:
                self._set_lost(missing)
        else:
            answer = self._command and self._command.result
            if answer:
                self._disarm = self._disarm and not answer.accepted
            if (self._disarm or status and status.armed) and (answer or not self._command):
                self._start_disarm()

    def end(self) -> None:
        """Enter 'lost' because the bridge stops."""
        self.phase = LOST
        self._lost = 'the bridge has stopped'

    @property
    def text(self) -> str:
        """State for the supervisor: 'ready', or 'waiting', 'silent' or 'lost' with ': REASON'."""
        if self.phase == LOST:
            return f'lost: {self._lost}'
        if self.phase == FLIES and self._silent:
            return f'silent: {self._silent}'
        missing = self.missing if self.phase == RESTS else ''
        return f'waiting: {missing}' if missing else 'ready'

    @property
    def missing(self) -> str:
        """Reason on either side that prevents arming now; '' if there is none."""
        if self._inhibited:
            return self._inhibited
        missing = self._board.ready or self._disarm and 'disarming is not confirmed yet'
        blocking = missing or ', '.join(text for text in self._board.status.conditions
                                        if text in BLOCKS_ARMING)
        return blocking or ('' if self._supervisor else 'no message from the supervisor')

    def _check_answer(self, elapsed):
        answer, status = self._command.result, self._board.status
        if answer is None:
            return
        if not answer.accepted:
            self._set_lost(f'not armed: {answer.reason}')
        elif status.armed:
            self.phase, self._missing_for, self._silent = FLIES, 0.0, ''
        else:
            self._missing_for += elapsed       # the link's thread has not set the status yet
            if self._missing_for >= PATIENCE:
                self._set_lost(_disarm_cause(status))

    def _set_lost(self, reason):
        self.phase, self._lost = LOST, reason
        self._start_disarm()

    def _start_disarm(self):
        self._disarm = True
        self._command = self._board.start_disarm()


def _disarm_cause(status):
    """Reason why an armed board is not armed any more."""
    if status is None or status.state == 'boot' \
            or status.stop_reason in ('none', 'watchdog reset'):
        return 'restarted' + (' (watchdog reset)' if status and status.stop_reason != 'none'
                              else '')
    return f'{status.state} ({status.stop_reason})'
