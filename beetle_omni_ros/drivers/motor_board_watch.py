"""State of the motor board from its messages, and events about changes."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
import math
import time

from beetle_omni_ros.drivers.clock_offset import ClockOffset
from beetle_omni_ros.drivers.mavlink_dialect import common, EscInfo, EscStatus
from beetle_omni_ros.drivers.motor_board_messages import (
    battery_of,
    BoardReception,
    BoardStatus,
    rotors_of,
    RotorStates,
    status_of,
    THROTTLE,
)
from beetle_omni_ros.drivers.motor_board_parameters import MotorBoardParameters
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.readings import BatteryReading

EVENTS_KEPT = 200
REQUESTS_KEPT = 50      # TIMESYNC requests; later answers are ignored
SEVERE = ('ESC failure', 'targets timed out')


class BoardWatch:
    """
    Newest state and measurements of the board, stamped by ``clock`` [s], and events.

    Attributes:
        status: last heartbeat, or None.
        voltage: filtered pack voltage [V] for the thrust map, or None.
        reception: counts of the board about received packets, or None.
        clock: offset of the board's clock against the monotonic clock.

    """

    def __init__(self, parameters: MotorBoardParameters, robot: RobotParameters,
                 clock: Callable[[], float]):
        self._parameters, self._host_clock, self._cells = parameters, clock, robot.battery.cells
        self.clock = ClockOffset(parameters.clock_drift)
        self.status: BoardStatus | None = None
        self.voltage: float | None = None
        self.reception: BoardReception | None = None
        self._info = None
        self._battery: BatteryReading | None = None
        self._rotors: RotorStates | None = None
        self._events: deque = deque(maxlen=EVENTS_KEPT)
        self._requests: deque = deque(maxlen=REQUESTS_KEPT)
        self._received_at = self._opened = -math.inf
        self._battery_at = -math.inf
        self._was_silent = self._was_uncertain = self._was_implausible = False
        self._handlers = {
            common.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            common.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            common.MAVLINK_MSG_ID_BATTERY_STATUS: self._on_battery,
            common.MAVLINK_MSG_ID_SYS_STATUS: self._on_reception,
            EscInfo.id: self._on_info, EscStatus.id: self._on_rotors}

    def timesync_request(self) -> common.MAVLink_message:
        """TIMESYNC request for the board's clock, to be sent at once."""
        self._requests.append(time.monotonic_ns())
        return common.MAVLink_timesync_message(0, self._requests[-1])

    def message(self, message, now: float) -> None:
        """Handle a message of the board that arrived at ``now`` [s, monotonic]."""
        self._received_at = now
        handler = self._handlers.get(message.get_msgId())
        if handler:
            handler(message, now)

    def silent(self, now: float) -> bool:
        """Whether no message arrived for too long."""
        return now - self._received_at > self._parameters.silence

    def tick(self, now: float, connected: bool) -> None:
        """Update the events about silence and the clock's uncertainty."""
        # After a reconnection the board has the same time for its first message.
        silent = math.isfinite(self._received_at) and \
            now - max(self._received_at, self._opened) > self._parameters.silence
        if silent != self._was_silent and connected:
            self._was_silent = silent
            self._event('error' if silent else 'info',
                        f'no message for {self._parameters.silence:g} s' if silent
                        else 'messages again')
        uncertainty = self.clock.uncertainty(now)
        uncertain = self.clock.known and uncertainty > self._parameters.clock_uncertainty_limit
        if uncertain != self._was_uncertain:
            self._was_uncertain = uncertain
            self._event('warning' if uncertain else 'info',
                        f'offset of its clock known to {1e3 * uncertainty:.1f} ms')

    def acknowledged(self, arm: bool) -> None:
        """Update the status after an acknowledged command, before the next heartbeat."""
        if self.status is not None and self.status.armed != arm:
            # The next heartbeat contains the conditions that prevent arming again.
            self.status = replace(self.status, stamp=self._host_clock(),
                                  state='armed' if arm else 'disarmed',
                                  conditions=self.status.conditions if arm else (THROTTLE,))
            self._event('info', self.status.state)

    def connection(self, connected: bool, text: str) -> None:
        """Record that the port was opened, or lost with the reason ``text``."""
        self._opened = time.monotonic()
        self._event('info' if connected else 'error',
                    'port opened again' if connected else text)

    def take(self) -> dict:
        """Return what is new since the last call: ``battery``, ``rotors``, ``events``."""
        news = {'battery': self._battery, 'rotors': self._rotors, 'events': tuple(self._events)}
        self._battery = self._rotors = None
        self._events.clear()
        return news

    def _event(self, level, text):
        self._events.append((level, f'motor board: {text}'))

    def _stamp(self, message, now):
        """Host time of a measurement, or of its arrival while the board's clock is unknown."""
        measured = now
        if self.clock.known:
            measured = min(now, message.time_usec / 1e6 - self.clock.offset())
        return self._host_clock() - (time.monotonic() - measured)

    def _on_heartbeat(self, message, now):
        old, new = self.status, status_of(message, self._host_clock())
        self.status = new
        if new.state == 'boot':
            self.clock.restart()
            self._info = None
            if old is not None and old.state != 'boot':
                level = 'error' if old.armed else 'warning'
                self._event(level, f'restarted ({new.stop_reason})')
            return
        if old is None:
            self._event('info', f'found, {new.state}, contract {new.contract}')
            return
        if old.armed != new.armed:
            asked = new.stop_reason == 'requested by the host'
            self._event('info' if new.armed or asked else 'error',
                        'armed' if new.armed else f'disarmed ({new.stop_reason})')
        for condition in new.conditions if new.armed else ():
            if condition not in old.conditions:
                self._event('error' if condition in SEVERE else 'warning', condition)

    def _on_timesync(self, message, now):
        if not message.tc1 or message.ts1 not in self._requests:
            return
        self._requests.remove(message.ts1)
        if self.clock.add(message.ts1 / 1e9, message.tc1 / 1e9, now) and self.status is not None:
            self._event('warning', 'its clock jumped, perhaps by a restart')

    def _on_battery(self, message, now):
        battery = battery_of(message, self._host_clock())
        low, high = self._parameters.cell_voltage_low, self._parameters.cell_voltage_high
        plausible = battery is not None and low <= battery.voltage / self._cells <= high
        if plausible == self._was_implausible:
            self._was_implausible = not plausible
            self._event('info' if plausible else 'warning',
                        'battery voltage plausible again' if plausible else
                        f'battery voltage {battery.voltage if battery else math.nan:.1f} V not '
                        'plausible, the last good one is used')
        if not plausible:
            return
        self._battery = battery
        if self.voltage is None:
            self.voltage = battery.voltage
        else:
            constant = self._parameters.voltage_time_constant
            weight = -math.expm1(-(now - self._battery_at) / constant) if constant else 1.0
            self.voltage += weight * (battery.voltage - self.voltage)
        self._battery_at = now

    def _on_reception(self, message, now):
        self.reception = BoardReception(message.errors_count1, message.errors_count2,
                                        message.errors_count3, message.errors_count4)

    def _on_info(self, message, now):
        old, self._info = self._info, message
        for k in range(4):
            before = old is None or bool(old.info >> k & 1)
            online = bool(message.info >> k & 1)
            if online != before:
                self._event('info' if online else 'error',
                            f"ESC of rotor {k + 1} {'online again' if online else 'offline'}")

    def _on_rotors(self, message, now):
        self._rotors = rotors_of(message, self._info, self._stamp(message, now))


def restarted(message) -> bool:
    """Whether a message is the first heartbeat after a start of the board."""
    return message.get_msgId() == common.MAVLINK_MSG_ID_HEARTBEAT \
        and message.custom_mode & 0xFF == 0
