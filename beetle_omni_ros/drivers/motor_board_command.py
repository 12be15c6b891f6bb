"""Arming and disarming: a command sent until it is acknowledged."""

from __future__ import annotations

from collections.abc import Callable
import threading

from beetle_omni_ros.drivers.mavlink_dialect import common
from beetle_omni_ros.drivers.motor_board_messages import (
    CommandResult,
    conditions_of,
    RESULTS,
)
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters


class ArmCommand:
    """
    One arm or disarm command on its way.

    Attributes:
        arm: what was asked.
        result: None until it has ended.

    """

    def __init__(self, arm: bool, parameters: MotorBoardParameters, send: Callable, now: float):
        """Send it for the first time at ``now`` [s]; ``send`` takes a message."""
        self.arm = arm
        self.result: CommandResult | None = None
        self._parameters, self._send = parameters, send
        self._begin = self._next = now
        self._attempts = 0
        self._done = threading.Event()
        self.tick(now)

    def tick(self, now: float) -> None:
        """Send it again, or give up, when an acknowledgement is overdue."""
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
        """Take a COMMAND_ACK, or ignore one to another question; tell whether it is done."""
        if message.command != common.MAV_CMD_COMPONENT_ARM_DISARM \
                or bool(message.result_param2 & 1) != self.arm:
            return False
        if message.result == common.MAV_RESULT_ACCEPTED:
            self.end(now, True)
            return True
        text = RESULTS.get(message.result, f'result {message.result}')
        why = ', '.join(conditions_of(message.result_param2 >> 8 & 0xFF))
        self.end(now, False, f'{text} by the board: {why or "no reason given"}')
        return False

    def end(self, now: float, accepted: bool, reason: str = '') -> None:
        """End with a result, unless it has one."""
        if self.result is None:
            self.result = CommandResult(accepted, reason, self._attempts, now - self._begin)
            self._done.set()

    def wait(self, timeout: float) -> bool:
        """Wait for the end at most ``timeout`` [s]; tell whether it came."""
        return self._done.wait(timeout)
