"""State of the motor board from the bytes that it sends (docs/reference/firmware.md)."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
import math
import time

import numpy as np

from beetle_omni_ros.drivers.mavlink import common
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
