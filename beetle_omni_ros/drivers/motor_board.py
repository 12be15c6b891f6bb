"""Driver of the motor board: thrust targets, battery and rotor states, arming, link health."""

from __future__ import annotations

from collections.abc import Callable
import math
import select
import threading
import time

import numpy as np

from beetle_omni_ros.drivers import mavlink
from beetle_omni_ros.drivers.device_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.serial_port import SerialPort, SerialPortError
from beetle_omni_ros.model.mode import COMMAND_AGE, DISARMED, Mode, MOTORS_OFF
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import ThrustMap
from beetle_omni_ros.model.readings import BatteryReading

TICK = 0.01             # [s] longest sleep of the thread, a tenth of its shortest period
CORRECTION = 50_000     # [us] a larger backward step of the board's clock is a restart
HEARTBEAT_PERIOD = 0.2  # [s] by the contract, as the next three
TIMESYNC_PERIOD, TIMESYNC_PERIOD_UNKNOWN = 0.2, 0.05    # [s]; the second until it is answered
RECONNECT = 0.05        # [s] between attempts to open a lost port

RESTS, ARMS, FLIES, LOST = 'rests', 'arms', 'flies', 'lost'
# A board that is not ready is tolerated for this long [s], counted in steps of at most STEP [s]:
# after a pause of this process the waiting messages of the board are read first.
PATIENCE, STEP = 0.05, 0.01


class MotorBoard:
    """
    Driver of the motor board on a serial port; docs/reference/firmware.md describes the board.

    A thread reads, sends heartbeats and reconnects. :meth:`send` and :meth:`poll` do not wait.
    The board stops the rotors 100 ms after the last target, also if this process fails.

    ``clock`` is that of all stamps, those given to :meth:`send` and those returned [s].
    ``duty`` (4,) are the normalised commands last sent, 0 to 1, ``saturated`` (4,) whether the
    battery limits the thrusts to them.
    """

    def __init__(self, parameters: MotorBoardParameters, robot: RobotParameters,
                 clock: Callable[[], float] = time.time):
        self.parameters = parameters
        self.thrust_map = ThrustMap(robot.rotors)
        self._clock = clock
        self._lock = threading.Lock()           # of state and command
        self._write_lock = threading.Lock()     # of port and packer
        self.state = mavlink.BoardState(robot.battery.cells, parameters.silence, clock)
        self._receiver = mavlink.MavlinkReceiver(*mavlink.BOARD, mavlink.restarted)
        self._packer = mavlink.common.MAVLink(None, *mavlink.HOST)
        self.duty, self.saturated = np.zeros(4), np.zeros(4, dtype=bool)
        self._port: SerialPort | None = None
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._counts = dict.fromkeys(('sent', 'buffer_full', 'connections'), 0)
        self._command: mavlink.ArmCommand | None = None
        self._next_heartbeat = self._next_timesync = 0.0
        self._last_stamp = (math.nan, 0)

    def open(self) -> None:
        """Open the port, or raise SerialPortError, and start the thread."""
        self._connect()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name='motor_board', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Disarm, wait shortly for the acknowledgement, close the port."""
        if self._thread is None:
            return
        self.start(False).wait()
        self._stopping = True
        self._thread.join(2.0)
        self._thread = None
        self._disconnect()

    @property
    def connected(self) -> bool:
        """Whether the port is open, so that targets can be sent."""
        return self._port is not None

    @property
    def ready(self) -> str:
        """Reason why this side cannot arm the board; '' if it can."""
        state, status = self.state, self.state.status
        if self._port is None:
            return f'{self.parameters.port}: port is away'
        if state.silent(time.monotonic()):
            return 'no message from the board'
        if status is None:
            return 'no heartbeat of the board'
        if status.contract != mavlink.CONTRACT_VERSION:
            return (f'firmware follows contract {status.contract}, '
                    f'this driver {mavlink.CONTRACT_VERSION}')
        if mavlink.NO_HOST_HEARTBEAT in status.conditions:
            return 'the board receives no heartbeat of this computer'
        if state.voltage is None:
            return 'battery voltage unknown'
        return '' if state.clock.known else "offset of the board's clock unknown"

    def start(self, arm: bool) -> mavlink.ArmCommand:
        """Start to arm or disarm without waiting; the returned command gets the result."""
        missing = self.ready if arm else ''
        with self._lock:
            command = mavlink.ArmCommand(arm, self._write)
            if missing:
                command.end(False, missing)
                return command
            if self._command:
                self._command.end(False, 'replaced by another command')
            self._command = command
            command.tick(time.monotonic())
            return command

    def send(self, thrust: np.ndarray, stamp: float) -> str:
        """
        Send thrust targets (4,) [N] without waiting; return why they were not sent, or ''.

        Only one thread may call this. Zero and negative values stop the rotor. ``stamp`` is the
        time of the state estimate that they answer [s].
        """
        age = self._clock() - stamp
        if abs(age) > COMMAND_AGE:
            return 'stale stamp' if age > 0 else 'stamp in the future'
        if not self.state.clock.known:
            return "offset of the board's clock unknown"
        # Without a measurement use the highest voltage, which gives the smallest duty.
        voltage = self.state.voltage or self.thrust_map.voltages[-1]
        duty = self.thrust_map.command(thrust, voltage)
        if not self._write(mavlink.common.MAVLink_set_actuator_control_target_message(
                self._board_stamp(stamp, max(age, 0.0)), 0, *mavlink.BOARD,
                [*duty.tolist(), 0.0, 0.0, 0.0, 0.0])):
            return 'port is away' if self._port is None else 'buffer full'
        self.duty, self.saturated = duty, self.thrust_map.saturated(thrust, voltage)
        return ''

    def _board_stamp(self, stamp, age):
        """Board's clock [us] at a stamp, equal for equal stamps and rising for rising ones."""
        last_stamp, last = self._last_stamp
        if stamp == last_stamp:
            return last
        # From the age, so that a step of the host's clock affects one target only.
        micros = max(0, round(1e6 * (time.monotonic() - age + self.state.clock.offset())))
        if stamp > last_stamp and last - CORRECTION < micros <= last:
            micros = last + 1   # the offset was corrected by more than the time between stamps
        self._last_stamp = stamp, micros
        return micros

    def poll(self) -> tuple[BatteryReading | None, mavlink.RotorStates | None]:
        """Return battery and rotors since the last call."""
        with self._lock:
            return self.state.take()

    def link(self) -> dict[str, float]:
        """Counts of both directions of the link and synchronisation of the clocks, by name."""
        clock = self.state.clock
        return {**self._receiver.counts, **self._counts,
                **{f'board {name}': count for name, count in self.state.reception.items()},
                'implausible voltages': self.state.implausible,
                'clock_offset_s': clock.offset(),
                'clock_uncertainty_ms': 1e3 * clock.uncertainty(time.monotonic())}

    def _write(self, message):
        """Pack and write a message without waiting; return whether it was written."""
        with self._write_lock:
            if self._port is None:
                return False
            frame = message.pack(self._packer)
            try:
                taken = self._port.write(frame)
            except SerialPortError:
                return False            # the thread detects the error itself and reconnects
            if taken:
                # A dropped frame must not leave a gap, which the board would count as lost.
                self._packer.seq = (self._packer.seq + 1) % 256
            self._counts['sent' if taken else 'buffer_full'] += 1
            return taken

    def _connect(self):
        port = SerialPort(self.parameters.port, self.parameters.baud)
        self._receiver.restart()
        with self._write_lock:
            self._port = port
        self._counts['connections'] += 1

    def _disconnect(self):
        with self._write_lock:
            if self._port is not None:
                self._port.close()
            self._port = None

    def _run(self):
        while not self._stopping:
            try:
                if self._port is None:
                    time.sleep(RECONNECT)
                    self._connect()
                else:
                    self._serve(self._port)
            except SerialPortError:
                self._disconnect()
            self._tick(time.monotonic())

    def _serve(self, port):
        """Wait at most one tick for bytes and handle them."""
        readable, writable, _ = select.select([port.fd], [port.fd] if port.rest else [], [], TICK)
        if writable:
            with self._write_lock:
                port.flush()
        if readable:
            data, now = port.read(), time.monotonic()
            for message in self._receiver.feed(data):
                with self._lock:
                    self._handle(message, now)

    def _handle(self, message, now):
        if message.get_msgId() == mavlink.common.MAVLINK_MSG_ID_COMMAND_ACK:
            if self._command:
                self._command.acknowledge(message, self.state)
            return
        self.state.message(message, now)
        if mavlink.restarted(message):
            self._next_heartbeat = self._next_timesync = now

    def _tick(self, now):
        with self._lock:
            if self._command:
                self._command.tick(now)
        if now >= self._next_heartbeat:
            self._next_heartbeat = now + HEARTBEAT_PERIOD
            self._write(mavlink.common.MAVLink_heartbeat_message(
                mavlink.common.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.common.MAV_AUTOPILOT_INVALID,
                0, 0, mavlink.common.MAV_STATE_ACTIVE, 3))
        if now >= self._next_timesync:
            self._next_timesync = now + (TIMESYNC_PERIOD if self.state.clock.known
                                         else TIMESYNC_PERIOD_UNKNOWN)
            self._write(self.state.timesync_request())


class Arming:
    """
    Keeps the board armed while the supervisor flies.

    It arms once, when the supervisor leaves 'disarmed'. A board that is lost later is disarmed,
    and not armed before the supervisor has been 'disarmed' again. A board that is only silent,
    while targets can be sent, remains armed, because its rotors carry the robot to the ground.

    ``phase`` is 'rests', 'arms', 'flies' or 'lost'; targets are sent only in 'flies'.
    """

    def __init__(self, board: MotorBoard):
        self.phase = RESTS
        self._board = board
        self._command: mavlink.ArmCommand | None = None
        self._supervisor = self._lost = self._silent = self._inhibited = ''
        self._missing_for = 0.0
        self._disarm = False        # whether a confirmation of disarming is pending

    def inhibit(self, reason: str) -> None:
        """Keep the board disarmed for a reason, also in flight; '' ends this."""
        self._inhibited = reason
        if reason and self.phase in (ARMS, FLIES):
            self._set_lost(reason)

    def follow(self, mode: Mode) -> None:
        """Act on the state of the supervisor."""
        state = mode.state
        before, self._supervisor = self._supervisor, state
        if mode.motors_off:
            if self.phase != LOST or state == DISARMED:
                self.phase = RESTS
            if before != state:
                self._start_disarm()
        elif before == DISARMED and not self._inhibited:
            self.phase, self._disarm = ARMS, False
            self._command = self._board.start(True)
            self._check_answer()
        elif before in MOTORS_OFF or not before:
            self._set_lost(self._inhibited or 'the supervisor was not disarmed before')

    def update(self, elapsed: float) -> None:
        """Check the board, ``elapsed`` [s] after the last call."""
        status = self._board.state.status
        if self.phase == ARMS:
            self._check_answer()
        elif self.phase == FLIES:
            missing = self._board.ready
            self._missing_for = self._missing_for + min(elapsed, STEP) if missing else 0.0
            if status is None or not status.armed:
                self._set_lost(_disarm_cause(status))
            elif self._missing_for < PATIENCE:
                self._silent = self._silent and missing
            elif self._board.connected:
                self._silent = missing
            else:
                self._set_lost(missing)
        elif self._command is None or self._command.accepted is not None:
            if self._command and self._command.accepted:
                self._disarm = False
            if self._disarm or (status and status.armed):
                self._start_disarm()

    def end(self) -> None:
        """Enter 'lost' because the bridge stops."""
        self.phase, self._lost = LOST, 'the bridge has stopped'

    @property
    def text(self) -> str:
        """State for the supervisor: 'ready', or 'waiting', 'silent' or 'lost' with ': REASON'."""
        if self.phase == LOST:
            return f'lost: {self._lost}'
        if self.phase == FLIES and self._silent:
            return f'silent: {self._silent}'
        if self.phase != RESTS:
            return 'ready'
        # What prevents arming now, on either side.
        missing = self._inhibited or self._board.ready
        if not missing and self._disarm:
            missing = 'disarming is not confirmed yet'
        missing = missing or ', '.join(text for text in self._board.state.status.conditions
                                       if text in mavlink.BLOCKS_ARMING)
        if not (missing or self._supervisor):
            missing = 'no message from the supervisor'
        return f'waiting: {missing}' if missing else 'ready'

    def _check_answer(self):
        command, status = self._command, self._board.state.status
        if command.accepted and status.armed:
            self.phase, self._missing_for, self._silent = FLIES, 0.0, ''
        elif command.accepted is not None:
            self._set_lost(_disarm_cause(status) if command.accepted
                           else f'not armed: {command.reason}')

    def _set_lost(self, reason):
        self.phase, self._lost = LOST, reason
        self._start_disarm()

    def _start_disarm(self):
        self._disarm = True
        self._command = self._board.start(False)


def _disarm_cause(status):
    """Reason why an armed board is not armed any more."""
    if status is None or status.stop_reason == 'none':
        return 'restarted'
    if status.state == 'boot' or status.stop_reason == mavlink.WATCHDOG_RESET:
        return f'restarted ({mavlink.WATCHDOG_RESET})'
    return f'{status.state} ({status.stop_reason})'
