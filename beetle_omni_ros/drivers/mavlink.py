"""The motor board's side of MAVLink 2: receiver, clock, state, and the arm command."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
import math
import struct
import threading
import time

import numpy as np
from pymavlink.dialects.v20 import common

from beetle_omni_ros.model.readings import BatteryReading

# The bytes of HEARTBEAT.custom_mode and COMMAND_ACK.result_param2.
CONTRACT_VERSION = 1
STATES = {0: 'boot', 1: 'disarmed', 2: 'armed', 3: 'running'}
WATCHDOG_RESET = 'watchdog reset'
STOP_REASONS = {0: 'none', 1: 'requested by the host', 2: 'heartbeat of the host lost',
                3: 'no target for too long', 4: WATCHDOG_RESET}
NO_HOST_HEARTBEAT, THROTTLE = 'no heartbeat of the host', 'throttle not low'
CONDITIONS = {1: 'booting', 2: NO_HOST_HEARTBEAT, 4: THROTTLE,
              8: 'battery low', 16: 'ESC failure', 32: 'targets timed out', 64: 'saturated'}
BLOCKS_ARMING = tuple(text for bit, text in CONDITIONS.items() if bit <= 16)
ESC_FAILURES = {1: 'over-current', 2: 'over-voltage', 4: 'overheated', 8: 'over-rpm',
                16: 'inconsistent command', 32: 'stuck', 64: 'generic'}
UNKNOWN_TEMPERATURE, UNKNOWN_CELL, UNKNOWN_CURRENT = 32767, 65535, -1
REQUESTS_KEPT = 50      # TIMESYNC requests; later answers are ignored
CLOCK_DRIFT = 100e-6    # [s/s] bound of the clocks against each other
VOLTAGE_TIME_CONSTANT = 0.05    # [s] of the voltage filter before the thrust map
PLAUSIBLE_CELL = 2.5, 4.4       # [V] voltage of a LiPo cell
ACKNOWLEDGE_TIMEOUT = 0.1   # [s] until a command is repeated
ATTEMPTS = 5            # of a command
MARKER, HEADER, CHECKSUM = 0xFD, 10, 2      # first byte of a frame, sizes [B]
RESULTS = {1: 'refused', 2: 'denied', 3: 'unsupported', 4: 'failed'}


def _declare(number, name, crc_extra, layout, fields, order):
    """Declare a message: fields with their lengths as in the payload, order of the definition."""
    def __init__(self, *values):
        common.MAVLink_message.__init__(self, number, name)
        self.__dict__.update(zip(order, values, strict=True))

    def pack(self, mav, force_mavlink1=False):
        values = [one for field, length in fields.items() for one in (
            getattr(self, field) if length > 1 else [getattr(self, field)])]
        return self._pack(mav, crc_extra, struct.pack(layout, *values))

    common.mavlink_map.setdefault(number, type(name, (common.MAVLink_message,), {
        '__init__': __init__, 'pack': pack, 'id': number, 'msgname': name,
        'crc_extra': crc_extra, 'fieldnames': order, 'unpacker': struct.Struct(layout),
        'lengths': list(fields.values()),
        'orders': [list(fields).index(field) for field in order]}))


# The dialects of pymavlink 2.4.41 and 2.4.50 do not contain these two. The declaration of a
# release that contains them has priority.
_declare(290, 'ESC_INFO', 251, '<Q4IH4H4hBBBB', {
    'time_usec': 1, 'error_count': 4, 'counter': 1, 'failure_flags': 4, 'temperature': 4,
    'index': 1, 'count': 1, 'connection_type': 1, 'info': 1}, [
    'index', 'time_usec', 'counter', 'count', 'connection_type', 'info', 'failure_flags',
    'error_count', 'temperature'])
_declare(291, 'ESC_STATUS', 10, '<Q4i4f4fB', {
    'time_usec': 1, 'rpm': 4, 'voltage': 4, 'current': 4, 'index': 1}, [
    'index', 'time_usec', 'rpm', 'voltage', 'current'])
EscInfo, EscStatus = common.mavlink_map[290], common.mavlink_map[291]
BOARD, HOST = (1, 1), (1, 191)    # system and component of both sides
common.MAVLINK_IGNORE_CRC = 0   # the environment must not switch the checksum off


def restarted(message) -> bool:
    """Whether a message is the first heartbeat after a start of the board."""
    return message.get_msgId() == common.MAVLINK_MSG_ID_HEARTBEAT \
        and message.custom_mode & 0xFF == 0


class MavlinkReceiver:
    """
    Splits a byte stream into the messages of one sender with the IDs ``system``, ``component``.

    ``counts`` are messages received and bytes; lost: gaps in the sender's sequence numbers;
    bad_crc: frames with a valid header and a wrong checksum; skipped_bytes: outside valid frames;
    foreign: valid frames of another sender. A message for which ``restarts`` is true ends no gap.
    After a bad frame the search continues one byte after its marker. Frames of MAVLink 1, with
    incompat_flags, and of unknown messages, whose checksum cannot be tested, are skipped.
    """

    def __init__(self, system: int, component: int,
                 restarts: Callable[[object], bool] = lambda message: False):
        self._sender, self._restarts = (system, component), restarts
        self._decoder = common.MAVLink(None)
        self.counts = dict.fromkeys(
            ('received', 'bytes', 'lost', 'bad_crc', 'skipped_bytes', 'foreign'), 0)
        self.restart()

    def restart(self) -> None:
        """Forget an incomplete frame and the sequence number."""
        self._held = bytearray()
        self._sequence: int | None = None

    def feed(self, data: bytes) -> list:
        """Parse further bytes; return the messages that they complete."""
        counts, found = self.counts, []
        counts['bytes'] += len(data)
        self._held += data
        while (message := self._next()) is not None:
            if (message.get_srcSystem(), message.get_srcComponent()) != self._sender:
                counts['foreign'] += 1
            else:
                counts['received'] += 1
                sequence = message.get_seq()
                if self._sequence is not None and not self._restarts(message):
                    counts['lost'] += (sequence - self._sequence - 1) % 256
                self._sequence = sequence
                found.append(message)
        return found

    def _next(self):
        """Remove and return the first message; None if none is complete."""
        held = self._held
        while held:
            header = held[:HEADER]
            begun = header[0] == MARKER and not any(header[2:3]) and (
                len(header) < HEADER or int.from_bytes(header[7:], 'little') in common.mavlink_map)
            if begun:
                end = HEADER + header[1] + CHECKSUM if len(header) == HEADER else math.inf
                if len(held) < end:
                    return None
                try:
                    message = self._decoder.decode(held[:end])
                except common.MAVError:
                    self.counts['bad_crc'] += 1
                else:
                    del held[:end]
                    return message
            skipped = held.find(MARKER, 1) % (len(held) + 1)    # all, if it finds none
            self.counts['skipped_bytes'] += skipped
            del held[:skipped]
        return None


class ClockOffset:
    """
    Offset of a remote clock, remote minus local [s], with an error bound.

    The remote clock is read between a request and its answer, so each exchange gives a lower and
    an upper bound of the offset. Bounds of earlier exchanges are widened by the largest possible
    drift, and all bounds are intersected. The estimate is the centre of this interval, and its
    error is at most half the width, for any delays.
    """

    def __init__(self):
        self.restart()

    def restart(self) -> None:
        """Forget all exchanges."""
        # Other threads read this tuple, so it is only replaced as a whole.
        self._bounds = -math.inf, math.inf, 0.0

    @property
    def known(self) -> bool:
        """Whether an answer arrived since the restart."""
        return math.isfinite(self._bounds[0])

    def add(self, sent: float, remote: float, received: float) -> None:
        """Use one exchange; earlier ones that it contradicts are forgotten."""
        within = CLOCK_DRIFT * (received - sent)
        low, high = remote - received - within, remote - sent + within
        known_low, known_high, at = self._bounds
        widening = CLOCK_DRIFT * max(0.0, received - at)
        new_low, new_high = max(low, known_low - widening), min(high, known_high + widening)
        self._bounds = (low, high, received) if new_low > new_high \
            else (new_low, new_high, received)

    def offset(self) -> float:
        """Remote minus local clock [s]; NaN while unknown."""
        low, high, _ = self._bounds
        return 0.5 * (low + high) if math.isfinite(low) else math.nan

    def uncertainty(self, now: float) -> float:
        """Bound of the offset's error [s] at local time ``now``; inf while unknown."""
        low, high, at = self._bounds
        return 0.5 * (high - low) + CLOCK_DRIFT * max(0.0, now - at)


@dataclass(frozen=True, slots=True)
class BoardStatus:
    """A heartbeat: state, reason of the last disarming, present conditions, contract version."""

    state: str
    stop_reason: str
    conditions: tuple[str, ...]
    contract: int

    @property
    def armed(self) -> bool:
        """Whether the rotors may turn."""
        return self.state in ('armed', 'running')


@dataclass(frozen=True, slots=True)
class RotorStates:
    """Telemetry of the four ESCs (4,)."""

    stamp: float                # host time of the measurement [s]
    rpm: np.ndarray             # [1/min]; this and the next two are NaN if the ESC is offline
    voltage: np.ndarray         # [V]
    current: np.ndarray         # [A]
    temperature: np.ndarray     # [C] of the last ESC_INFO; NaN if unknown
    failures: tuple[tuple[str, ...], ...]   # of each ESC
    error_count: np.ndarray     # since the start of the board


class BoardState:
    """
    Newest state and measurements of the board, stamped by ``clock`` [s].

    ``silence`` is the time without a message after which the board is silent [s].

    ``status`` is the last heartbeat, ``voltage`` the filtered pack voltage [V] for the thrust map,
    ``implausible`` the number of refused voltages, ``reception`` the last counts of the board, and
    ``clock`` the offset of the board's clock against the monotonic clock.
    """

    def __init__(self, cells: int, silence: float, clock: Callable[[], float]):
        self._cells, self._silence, self._host_clock = cells, silence, clock
        self.clock = ClockOffset()
        self.status: BoardStatus | None = None
        self.battery: BatteryReading | None = None
        self.rotors: RotorStates | None = None
        self.voltage: float | None = None
        self.implausible, self.reception = 0, dict[str, int]()
        self._info = None       # last ESC_INFO
        self._requests: deque[int] = deque(maxlen=REQUESTS_KEPT)
        self._received_at = self._battery_at = -math.inf
        self._handlers = {
            'HEARTBEAT': self._on_heartbeat, 'TIMESYNC': self._on_timesync,
            'BATTERY_STATUS': self._on_battery, 'SYS_STATUS': self._on_reception,
            'ESC_INFO': self._on_info, 'ESC_STATUS': self._on_rotors}

    def timesync_request(self) -> common.MAVLink_message:
        """TIMESYNC request for the board's clock, to be sent at once."""
        self._requests.append(time.monotonic_ns())
        return common.MAVLink_timesync_message(0, self._requests[-1])

    def message(self, message, now: float) -> None:
        """Handle a message of the board that arrived at ``now`` [s, monotonic]."""
        self._received_at = now
        if handler := self._handlers.get(message.get_type()):
            handler(message, now)

    def silent(self, now: float) -> bool:
        """Whether no message arrived for too long."""
        return now - self._received_at > self._silence

    def acknowledged(self, arm: bool) -> None:
        """Update the status after an acknowledged command, before the next heartbeat."""
        if self.status is not None and self.status.armed != arm:
            # The next heartbeat contains the conditions that prevent arming again.
            self.status = replace(self.status, state='armed' if arm else 'disarmed',
                                  conditions=self.status.conditions if arm else (THROTTLE,))

    def take(self) -> tuple:
        """Return battery and rotors since the last call, or None."""
        news = self.battery, self.rotors
        self.battery = self.rotors = None
        return news

    def _on_heartbeat(self, message, now):
        state, reason, conditions, contract = message.custom_mode.to_bytes(4, 'little')
        self.status = BoardStatus(
            STATES.get(state, f'state {state}'),
            STOP_REASONS.get(reason, f'reason {reason}'), conditions_of(conditions), contract)
        if self.status.state == 'boot':
            self.clock.restart()
            self._info = None

    def _on_timesync(self, message, now):
        if message.tc1 and message.ts1 in self._requests:
            self._requests.remove(message.ts1)
            self.clock.add(message.ts1 / 1e9, message.tc1 / 1e9, now)

    def _on_battery(self, message, now):
        cells = [cell for cell in message.voltages if cell != UNKNOWN_CELL]
        voltage = sum(cells) / 1000 if cells else math.nan
        if not PLAUSIBLE_CELL[0] <= voltage / self._cells <= PLAUSIBLE_CELL[1]:
            self.implausible += 1
            return
        current = message.current_battery
        self.battery = BatteryReading(self._host_clock(), voltage, math.nan if
                                      current == UNKNOWN_CURRENT else -current / 100)
        if self.voltage is None:
            self.voltage = voltage
        else:
            weight = -math.expm1(-(now - self._battery_at) / VOLTAGE_TIME_CONSTANT)
            self.voltage += weight * (voltage - self.voltage)
        self._battery_at = now

    def _on_reception(self, message, now):
        self.reception = {'lost': message.errors_count1, 'bad_crc': message.errors_count2,
                          'refused': message.errors_count3, 'timeouts': message.errors_count4}

    def _on_info(self, message, now):
        self._info = message

    def _on_rotors(self, message, now):
        measured = now      # the time of arrival, while the board's clock is unknown
        if self.clock.known:
            measured = min(now, message.time_usec / 1e6 - self.clock.offset())
        stamp = self._host_clock() - (time.monotonic() - measured)
        online, temperature = np.ones(4, dtype=bool), np.full(4, np.nan)
        failures, errors = ((),) * 4, np.zeros(4, dtype=int)
        if info := self._info:
            online = np.array([bool(info.info >> k & 1) for k in range(4)])
            temperature = np.array([math.nan if value == UNKNOWN_TEMPERATURE else value / 100
                                    for value in info.temperature])
            failures = tuple(tuple(text for bit, text in ESC_FAILURES.items() if flags & bit)
                             for flags in info.failure_flags)
            errors = np.array(info.error_count)
        rpm, voltage, current = (np.where(online, np.array(values, dtype=float), np.nan)
                                 for values in (message.rpm, message.voltage, message.current))
        self.rotors = RotorStates(stamp, rpm, voltage, current, temperature, failures, errors)


def conditions_of(bits: int) -> tuple[str, ...]:
    """Names of the set bits of a condition byte."""
    return tuple(text for bit, text in CONDITIONS.items() if bits & bit)


class ArmCommand:
    """
    One arm or disarm command, repeated until the board acknowledges it.

    ``send(message)`` sends it, first in the first :meth:`tick`. ``accepted`` is whether the board
    accepted it, None while it is pending, and ``reason`` the reason of a refusal.
    """

    def __init__(self, arm: bool, send: Callable):
        self.arm, self.reason = arm, ''
        self.accepted: bool | None = None
        self._send, self._next, self._attempts = send, -math.inf, 0
        self._done = threading.Event()

    def tick(self, now: float) -> None:
        """Send it, or fail, if no acknowledgement arrived in time."""
        if self.accepted is not None or now < self._next:
            return
        if self._attempts >= ATTEMPTS:
            self.end(False, f'no acknowledgement to {self._attempts} attempts')
            return
        self._next = now + ACKNOWLEDGE_TIMEOUT
        self._send(common.MAVLink_command_long_message(
            *BOARD, common.MAV_CMD_COMPONENT_ARM_DISARM, self._attempts, float(self.arm),
            0, 0, 0, 0, 0, 0))
        self._attempts += 1

    def acknowledge(self, message, state: BoardState) -> None:
        """Handle a COMMAND_ACK; an accepted one changes the state before the result is set."""
        if message.command != common.MAV_CMD_COMPONENT_ARM_DISARM \
                or bool(message.result_param2 & 1) != self.arm:
            return
        if message.result == common.MAV_RESULT_ACCEPTED:
            state.acknowledged(self.arm)
            self.end(True)
            return
        text = RESULTS.get(message.result, f'result {message.result}')
        reason = ', '.join(conditions_of(message.result_param2 >> 8 & 0xFF))
        self.end(False, f'{text} by the board: {reason or "no reason given"}')

    def end(self, accepted: bool, reason: str = '') -> None:
        """Set the result, if it is pending."""
        if self.accepted is None:
            self.accepted, self.reason = accepted, reason
            self._done.set()

    def wait(self) -> ArmCommand:
        """Return itself with the result, after 0.7 s at most."""
        if not self._done.wait(ACKNOWLEDGE_TIMEOUT * (ATTEMPTS + 2)):
            self.end(False, 'the thread of the link does not run')
        return self
