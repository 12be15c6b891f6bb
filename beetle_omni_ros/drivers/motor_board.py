"""Driver of the motor board: thrust targets, battery and rotor states, arming, link health."""

from __future__ import annotations

import atexit
from collections.abc import Callable
from dataclasses import dataclass, replace
import math
import threading
import time

import numpy as np

from beetle_omni_ros.drivers.mavlink_dialect import common
from beetle_omni_ros.drivers.motor_board_link import BoardLink
from beetle_omni_ros.drivers.motor_board_messages import (
    BoardStatus,
    BoardUpdate,
    CommandResult,
    conditions_of,
    CONTRACT_VERSION,
    heartbeat,
    LinkStatistics,
    NO_HOST_HEARTBEAT,
    RESULTS,
)
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.drivers.motor_board_watch import BoardWatch, restarted
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.thrust_map import ThrustMap

CORRECTION = 50_000     # [us] a larger backward step of the board's clock is a restart
CLOSING_COMMANDS = 3    # disarm commands sent at once on closing
NOTHING = np.zeros(4)
NOT_SATURATED = np.zeros(4, dtype=bool)


class ArmCommand:
    """
    One arm or disarm command, repeated until the board acknowledges it.

    Attributes:
        arm: True to arm, False to disarm.
        result: result of the command, None while it is pending.

    """

    def __init__(self, arm: bool, parameters: MotorBoardParameters, send: Callable, now: float):
        """Send it for the first time at ``now`` [s] by ``send(message)``."""
        self.arm = arm
        self.result: CommandResult | None = None
        self._parameters, self._send = parameters, send
        self._begin = self._next = now
        self._attempts = 0
        self._done = threading.Event()
        self.tick(now)

    def tick(self, now: float) -> None:
        """Send it again, or fail, if the acknowledgement is overdue."""
        if self.result or now < self._next:
            return
        if self._attempts >= self._parameters.acknowledge_attempts:
            self.end(now, False, f'no acknowledgement to {self._attempts} attempts')
            return
        self._next = now + self._parameters.acknowledge_timeout
        self._send(common.MAVLink_command_long_message(
            self._parameters.board_system, self._parameters.board_component,
            common.MAV_CMD_COMPONENT_ARM_DISARM, self._attempts,
            float(self.arm), 0, 0, 0, 0, 0, 0))
        self._attempts += 1

    def acknowledge(self, message, now: float) -> bool:
        """Handle a COMMAND_ACK; return whether it accepts this command."""
        if message.command != common.MAV_CMD_COMPONENT_ARM_DISARM \
                or bool(message.result_param2 & 1) != self.arm:
            return False
        if message.result == common.MAV_RESULT_ACCEPTED:
            self.end(now, True)
            return True
        text = RESULTS.get(message.result, f'result {message.result}')
        reason = ', '.join(conditions_of(message.result_param2 >> 8 & 0xFF))
        self.end(now, False, f'{text} by the board: {reason or "no reason given"}')
        return False

    def end(self, now: float, accepted: bool, reason: str = '') -> None:
        """Set the result, if it is pending."""
        if self.result is None:
            self.result = CommandResult(accepted, reason, self._attempts, now - self._begin)
            self._done.set()

    def wait(self, timeout: float) -> bool:
        """Wait for the result at most ``timeout`` [s]; return whether there is one."""
        return self._done.wait(timeout)


@dataclass(frozen=True, slots=True)
class Sent:
    """
    Result of sending one thrust target.

    Attributes:
        sent: whether the target was sent.
        reason: reason why it was not sent, or ''.
        saturated: (4,) whether the battery limits the thrust; the largest one was sent then.
        command: (4,) normalised commands, 0 to 1.

    """

    sent: bool
    reason: str
    saturated: np.ndarray
    command: np.ndarray


class MotorBoard:
    """
    Driver of the motor board on a serial port; docs/reference/firmware.md describes the board.

    A thread reads, sends heartbeats and reconnects. :meth:`send` and :meth:`poll` do not wait.
    The board stops the rotors 100 ms after the last target, also if this process fails.

    Args:
        parameters: parameters of the link; default: params/motor_board.yaml.
        robot: robot with the rotor map and the battery; default: params/robot.yaml.
        clock: clock of all stamps, those given to :meth:`send` and those returned [s].

    """

    def __init__(self, parameters: MotorBoardParameters | None = None,
                 robot: RobotParameters | None = None, clock: Callable[[], float] = time.time):
        self.parameters = parameters or MotorBoardParameters.load()
        robot = robot or RobotParameters.load()
        self.thrust_map = ThrustMap(robot.rotors)
        self._clock = clock
        self._lock = threading.Lock()
        self._watch = BoardWatch(self.parameters, robot, clock)
        self._link = BoardLink(self.parameters, self._on_message, self._on_tick,
                               self._on_connection, restarted)
        self._command: ArmCommand | None = None
        self._next_heartbeat = self._next_timesync = 0.0
        self._last_stamp = (math.nan, 0)

    def open(self) -> None:
        """
        Open the port and start the thread; :meth:`wait_ready` waits for the board.

        Raises:
            SerialPortError: the port cannot be opened.

        """
        if self._link.opened:
            return
        self._link.open()
        atexit.register(self.close)

    def close(self) -> None:
        """Disarm, wait shortly for the acknowledgement, close the port."""
        atexit.unregister(self.close)
        if not self._link.opened:
            return
        for _ in range(CLOSING_COMMANDS):
            command = self._start(False)
        command.wait(self.parameters.acknowledge_timeout * self.parameters.acknowledge_attempts)
        self._link.close()

    def __enter__(self) -> MotorBoard:
        self.open()
        return self

    def __exit__(self, *_) -> None:
        self.close()

    @property
    def status(self) -> BoardStatus | None:
        """Last heartbeat of the board, or None."""
        return self._watch.status

    @property
    def connected(self) -> bool:
        """Whether the port is open, so that targets can be sent."""
        return self._link.connected

    @property
    def ready(self) -> str:
        """Reason why this side cannot arm the board; '' if it can."""
        status, now = self._watch.status, time.monotonic()
        if not self._link.connected:
            return f'{self.parameters.port}: port is away'
        if self._watch.silent(now):
            return 'no message from the board'
        if status is None:
            return 'no heartbeat of the board'
        if status.contract != CONTRACT_VERSION:
            return (f'firmware follows contract {status.contract}, '
                    f'this driver {CONTRACT_VERSION}')
        if NO_HOST_HEARTBEAT in status.conditions:
            return 'the board receives no heartbeat of this computer'
        if self._watch.voltage is None:
            return 'battery voltage unknown'
        if not self._watch.clock.known:
            return "offset of the board's clock unknown"
        return ''

    def wait_ready(self, timeout: float) -> str:
        """Wait at most ``timeout`` [s] until :attr:`ready` is ''; return it."""
        end = time.monotonic() + timeout
        while (missing := self.ready) and time.monotonic() < end:
            time.sleep(0.01)
        return missing

    def start_arm(self) -> ArmCommand:
        """Start to arm without waiting; the returned command gets the result."""
        missing = self.ready
        if missing:
            command = ArmCommand(True, self.parameters, lambda _: None, time.monotonic())
            command.end(time.monotonic(), False, missing)
            command.result = replace(command.result, attempts=0)
            return command
        return self._start(True)

    def start_disarm(self) -> ArmCommand:
        """Start to disarm without waiting; the returned command gets the result."""
        return self._start(False)

    def arm(self) -> CommandResult:
        """Arm and wait for the answer, half a second at most; needs :attr:`ready` to be ''."""
        return self._finished(self.start_arm())

    def disarm(self) -> CommandResult:
        """Disarm and wait for the answer, half a second at most."""
        return self._finished(self.start_disarm())

    @property
    def armed(self) -> bool:
        """Whether the board is armed by its last heartbeat, and not silent."""
        status = self._watch.status
        return bool(status and status.armed and not self._watch.silent(time.monotonic()))

    def send(self, thrust: np.ndarray, stamp: float) -> Sent:
        """
        Send thrust targets without waiting. Only one thread may call this.

        Args:
            thrust: (4,) thrust targets [N]; zero and negative values stop the rotor.
            stamp: time of the state estimate that they answer [s].

        """
        try:
            thrust = np.asarray(thrust, dtype=float)
        except (TypeError, ValueError):
            return _not_sent('not numbers')
        if thrust.shape != (4,):
            return _not_sent(f'expected 4 thrusts, found shape {thrust.shape}')
        age = self._clock() - stamp
        if not (np.isfinite(thrust).all() and math.isfinite(age)):
            return _not_sent('not finite')
        if abs(age) > self.parameters.stamp_age_limit:
            return _not_sent('stale stamp' if age > 0 else 'stamp in the future')
        if not self._watch.clock.known:
            return _not_sent("offset of the board's clock unknown")
        # Without a measurement use the highest voltage, which gives the smallest duty.
        voltage = self._watch.voltage or self.thrust_map.voltages[-1]
        command = self.thrust_map.command(thrust, voltage)
        message = common.MAVLink_set_actuator_control_target_message(
            self._board_stamp(stamp, max(age, 0.0)), 0, self.parameters.board_system,
            self.parameters.board_component, [*command.tolist(), 0.0, 0.0, 0.0, 0.0])
        sent = self._link.send(message)
        reason = '' if sent else 'buffer full' if self._link.connected else 'port is away'
        return Sent(sent, reason, self.thrust_map.saturated(thrust, voltage), command)

    def poll(self) -> BoardUpdate:
        """Return measurements and events since the last call, and the present state."""
        with self._lock:
            news = self._watch.take()
        link = self._link
        counts = LinkStatistics(replace(link.receiver.counts), self._watch.reception, link.sent,
                                link.dropped, link.connections)
        clock = self._watch.clock
        return BoardUpdate(**news, status=self._watch.status, link=counts,
                           clock_offset=clock.offset(),
                           clock_uncertainty=clock.uncertainty(time.monotonic()))

    def _board_stamp(self, stamp, age):
        """
        Board's clock [us] at a stamp; equal stamps give equal values, rising stamps rising ones.

        It is computed from the age, so that a step of the host's clock affects one target only.
        """
        last_stamp, last = self._last_stamp
        if stamp == last_stamp:
            return last
        micros = max(0, round(1e6 * (time.monotonic() - age + self._watch.clock.offset())))
        if stamp > last_stamp and last - CORRECTION < micros <= last:
            micros = last + 1   # the offset was corrected by more than the time between stamps
        self._last_stamp = stamp, micros
        return micros

    def _start(self, arm):
        now = time.monotonic()
        with self._lock:
            if self._command:
                self._command.end(now, False, 'replaced by another command')
            self._command = ArmCommand(arm, self.parameters, self._link.send, now)
            return self._command

    def _finished(self, command):
        timeout = self.parameters.acknowledge_timeout * (self.parameters.acknowledge_attempts + 2)
        if not command.wait(timeout):
            command.end(time.monotonic(), False, 'the thread of the link does not run')
        return command.result

    def _on_message(self, message, now):
        with self._lock:
            if message.get_msgId() == common.MAVLINK_MSG_ID_COMMAND_ACK:
                if self._command and self._command.acknowledge(message, now):
                    self._watch.acknowledged(self._command.arm)
            else:
                self._watch.message(message, now)
                if restarted(message):
                    self._next_heartbeat = self._next_timesync = now

    def _on_connection(self, connected, text):
        with self._lock:
            self._watch.connection(connected, text)

    def _on_tick(self, now):
        with self._lock:
            self._watch.tick(now, self._link.connected)
            if self._command:
                self._command.tick(now)
        if now >= self._next_heartbeat:
            self._next_heartbeat = now + 1 / self.parameters.heartbeat_rate
            self._link.send(heartbeat())
        if now >= self._next_timesync:
            factor = 1 if self._watch.clock.known else 4
            self._next_timesync = now + 1 / (factor * self.parameters.timesync_rate)
            self._link.send(self._watch.timesync_request())


def _not_sent(reason):
    return Sent(False, reason, NOT_SATURATED, NOTHING)
