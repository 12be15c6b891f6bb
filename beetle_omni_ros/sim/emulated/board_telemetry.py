"""Measurements of the emulated motor board and the rates of their messages."""

import math

from beetle_omni_ros.sim.emulated import mavlink
from beetle_omni_ros.sim.emulated.board_parameters import EmulatedBoardParameters

UNKNOWN_CELL, UNKNOWN_CURRENT = 65535, -1       # of BATTERY_STATUS
GENERIC_FAILURE = 64                            # ESC_FAILURE_GENERIC
PWM = 0                                         # ESC_CONNECTION_TYPE_PPM
MIN_HEARTBEAT_PERIOD = 0.02                     # [s]


class Timer:
    """Is due at a fixed rate without drift, and once after a pause."""

    def __init__(self, rate: float):
        self._period = 1 / rate
        self.next = 0.0

    def due(self, now: float) -> bool:
        """Whether it is due at ``now`` [s]; then set the next time."""
        if now < self.next:
            return False
        self.next += self._period * (1 + math.floor((now - self.next) / self._period))
        return True


class BoardTelemetry:
    """
    Measurements and the rates of their messages.

    Attributes:
        voltage: battery voltage [V]; NaN without a measurement.
        current: current drawn from the battery [A]; NaN without a measurement.
        rpm: speeds of the four rotors [1/min].
        rotor_current: currents of the four rotors [A].
        temperature: temperatures of the four ESCs [C].
        failed: rotors (0 to 3) whose ESC has failed.

    """

    def __init__(self, parameters: EmulatedBoardParameters, cells: int):
        self._arm_voltage = cells * parameters.arm_cell_voltage
        self._heartbeat = Timer(parameters.heartbeat_rate)
        self._reception = Timer(parameters.reception_rate)
        self._battery = Timer(parameters.battery_rate)
        self._rotors = Timer(parameters.rotor_rate)
        self._info = Timer(parameters.rotor_info_rate)
        self.voltage = self.current = math.nan
        self.rpm, self.rotor_current = [0.0] * 4, [0.0] * 4
        self.temperature = [parameters.idle_temperature] * 4
        self.failed: frozenset[int] = frozenset()

    def restart(self, at: float) -> None:
        """Restart all messages at time ``at`` [s]."""
        for timer in (self._heartbeat, self._reception, self._battery, self._rotors, self._info):
            timer.next = at
        self._sent_mode, self._sent_at, self._sent_failed = None, -math.inf, None
        self._errors, self._packets = [0] * 4, 0

    @property
    def battery_low(self) -> bool:
        """Whether the voltage is too low for arming, or unknown."""
        return not self.voltage >= self._arm_voltage

    def next(self) -> float:
        """Time of the next message [s]."""
        return min(self._heartbeat.next, self._reception.next, self._battery.next,
                   self._rotors.next, self._info.next)

    def heartbeat_due(self, now: float, beat: tuple[int, tuple]) -> bool:
        """Whether to send the heartbeat, because it is due or its content has changed."""
        mode = beat[1][0]
        changed = mode != self._sent_mode and now - self._sent_at >= MIN_HEARTBEAT_PERIOD
        if not self._heartbeat.due(now) and not changed:
            return False
        self._sent_mode, self._sent_at = mode, now
        return True

    def reception_due(self, now: float) -> bool:
        """Whether to send SYS_STATUS."""
        return self._reception.due(now)

    def due(self, now: float, stamp: int) -> list[tuple[int, tuple]]:
        """Telemetry messages that are due; ``stamp`` [us] is the clock of the board."""
        messages = []
        if self._info.due(now) or self.failed != self._sent_failed:
            self._sent_failed = self.failed
            messages.append(self._esc_info(stamp))
        if self._rotors.due(now):
            messages.append(self._esc_status(stamp))
        if self._battery.due(now):
            messages.append(self._battery_status())
        return messages

    def reception(self, counts: tuple[int, int, int, int]) -> tuple[int, tuple]:
        """SYS_STATUS with ``counts``: lost, bad checksum, refused targets, timeouts."""
        lost, bad, refused, timeouts = (min(count, 65535) for count in counts)
        voltage = UNKNOWN_CELL if math.isnan(self.voltage) else round(1000 * self.voltage)
        return mavlink.SYS_STATUS, (0, 0, 0, 0, voltage, self._centiampere(), 0,
                                    min(lost + bad, 65535), lost, bad, refused, timeouts, -1)

    def _centiampere(self):
        return UNKNOWN_CURRENT if math.isnan(self.current) else \
            max(-32768, min(32767, round(100 * self.current)))

    def _battery_status(self):
        total = UNKNOWN_CELL if math.isnan(self.voltage) else \
            max(0, min(UNKNOWN_CELL - 1, round(1000 * self.voltage)))
        return mavlink.BATTERY_STATUS, (-1, -1, 32767, total, *[UNKNOWN_CELL] * 9,
                                        self._centiampere(), 0, 0, 1, -1)

    def _esc_status(self, stamp):
        self._packets += 1
        volts = 0.0 if math.isnan(self.voltage) else self.voltage
        dead = self.failed
        return mavlink.ESC_STATUS, (
            stamp, *(0 if k in dead else round(self.rpm[k]) for k in range(4)),
            *(0.0 if k in dead else volts for k in range(4)),
            *(0.0 if k in dead else self.rotor_current[k] for k in range(4)), 0)

    def _esc_info(self, stamp):
        self._errors = [count + (k in self.failed) for k, count in enumerate(self._errors)]
        online = sum(1 << k for k in range(4) if k not in self.failed)
        return mavlink.ESC_INFO, (
            stamp, *self._errors, self._packets % 65536,
            *(GENERIC_FAILURE * (k in self.failed) for k in range(4)),
            *(32767 if k in self.failed else round(100 * self.temperature[k]) for k in range(4)),
            0, 4, PWM, online)
