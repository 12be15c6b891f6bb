"""Messages of the motor board as dataclasses, converted from MAVLink."""

from dataclasses import dataclass, field
import math

import numpy as np

from beetle_omni_ros.drivers.mavlink_dialect import common
from beetle_omni_ros.drivers.mavlink_receiver import ReceiveCounts
from beetle_omni_ros.robot.readings import BatteryReading

# docs/reference/firmware.md: the bytes of HEARTBEAT.custom_mode and COMMAND_ACK.result_param2.
CONTRACT_VERSION = 1
STATES = {0: 'boot', 1: 'disarmed', 2: 'armed', 3: 'running'}
STOP_REASONS = {0: 'none', 1: 'requested by the host', 2: 'heartbeat of the host lost',
                3: 'no target for too long', 4: 'watchdog reset'}
NO_HOST_HEARTBEAT, THROTTLE = 'no heartbeat of the host', 'throttle not low'
CONDITIONS = {1: 'booting', 2: NO_HOST_HEARTBEAT, 4: THROTTLE,
              8: 'battery low', 16: 'ESC failure', 32: 'targets timed out', 64: 'saturated'}
BLOCKS_ARMING = tuple(text for bit, text in CONDITIONS.items() if bit <= 16)
RESULTS = {0: 'accepted', 1: 'refused', 2: 'denied', 3: 'unsupported', 4: 'failed'}
ESC_FAILURES = {1: 'over-current', 2: 'over-voltage', 4: 'overheated', 8: 'over-rpm',
                16: 'inconsistent command', 32: 'stuck', 64: 'generic'}
UNKNOWN_TEMPERATURE, UNKNOWN_CELL, UNKNOWN_CURRENT = 32767, 65535, -1


@dataclass(frozen=True, slots=True)
class BoardStatus:
    """A heartbeat: state, reason of the last disarming, present conditions, contract version."""

    stamp: float
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
    """
    Telemetry of the four ESCs.

    Attributes:
        stamp: host time of the measurement [s].
        rpm: (4,) rotor speeds [1/min]; this and the next two are NaN if the ESC is offline.
        voltage: (4,) [V].
        current: (4,) [A].
        temperature: (4,) [C] of the last ESC_INFO; NaN if unknown.
        failures: for each ESC a tuple of its reported failures.
        error_count: (4,) errors since the start of the board.

    """

    stamp: float
    rpm: np.ndarray
    voltage: np.ndarray
    current: np.ndarray
    temperature: np.ndarray
    failures: tuple[tuple[str, ...], ...]
    error_count: np.ndarray


@dataclass(frozen=True, slots=True)
class BoardReception:
    """Counts of the board since its start: packets, refused targets, target timeouts."""

    lost: int
    bad_crc: int
    refused: int
    timeouts: int


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """Both directions of the link; ``board`` is None before the board's first report."""

    received: ReceiveCounts
    board: BoardReception | None
    sent: int
    dropped: int            # frames dropped because the output buffer was full
    connections: int        # number of times the port was opened


@dataclass(frozen=True, slots=True)
class CommandResult:
    """
    Result of an arm or disarm command.

    Attributes:
        accepted: whether the board accepted it.
        reason: '' or the reason of the refusal, in one line.
        attempts: number of times it was sent.
        duration: time until the acknowledgement or the timeout [s].

    """

    accepted: bool
    reason: str = ''
    attempts: int = 0
    duration: float = 0.0


@dataclass(frozen=True, slots=True)
class BoardUpdate:
    """
    Measurements and events since the last poll, and the present state.

    Attributes:
        battery: newest reading since the last poll, or None.
        rotors: newest telemetry since the last poll, or None.
        status: last heartbeat, or None before the first.
        events: (level, text) with level 'info', 'warning' or 'error', oldest first.
        link: counts of the link.
        clock_offset: board's clock minus monotonic clock [s]; NaN if unknown.
        clock_uncertainty: bound of the offset's error [s]; inf if unknown.

    """

    battery: BatteryReading | None
    rotors: RotorStates | None
    status: BoardStatus | None
    events: tuple[tuple[str, str], ...] = field(repr=False)
    link: LinkStatistics
    clock_offset: float
    clock_uncertainty: float


def status_of(message, stamp: float) -> BoardStatus:
    """Convert HEARTBEAT."""
    mode = message.custom_mode
    state, reason = mode & 0xFF, mode >> 8 & 0xFF
    return BoardStatus(stamp, STATES.get(state, f'state {state}'),
                       STOP_REASONS.get(reason, f'reason {reason}'),
                       conditions_of(mode >> 16 & 0xFF), mode >> 24 & 0xFF)


def conditions_of(bits: int) -> tuple[str, ...]:
    """Names of the set bits of a condition byte."""
    return tuple(text for bit, text in CONDITIONS.items() if bits & bit)


def battery_of(message, stamp: float) -> BatteryReading | None:
    """Convert BATTERY_STATUS; None if it contains no voltage."""
    cells = [cell for cell in message.voltages if cell != UNKNOWN_CELL]
    if not cells:
        return None
    current = message.current_battery
    return BatteryReading(stamp, sum(cells) / 1000,
                          math.nan if current == UNKNOWN_CURRENT else -current / 100)


def rotors_of(message, info, stamp: float) -> RotorStates:
    """Convert ESC_STATUS and the last ESC_INFO, or None before the first."""
    if info is None:
        online, temperature = np.ones(4, dtype=bool), np.full(4, np.nan)
        failures, errors = ((),) * 4, np.zeros(4, dtype=int)
    else:
        online = np.array([bool(info.info >> k & 1) for k in range(4)])
        temperature = np.array([math.nan if value == UNKNOWN_TEMPERATURE else value / 100
                                for value in info.temperature])
        failures = tuple(tuple(text for bit, text in ESC_FAILURES.items() if flags & bit)
                         for flags in info.failure_flags)
        errors = np.array(info.error_count)

    def known(values):
        return np.where(online, np.array(values, dtype=float), np.nan)

    return RotorStates(stamp, known(message.rpm), known(message.voltage), known(message.current),
                       temperature, failures, errors)


def heartbeat() -> common.MAVLink_message:
    """Heartbeat of this computer."""
    return common.MAVLink_heartbeat_message(
        common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_AUTOPILOT_INVALID, 0, 0,
        common.MAV_STATE_ACTIVE, 3)
