"""
The firmware of the motor board by docs/reference/firmware.md, as a pure state machine.

All times are arguments [s] on a clock without steps. Each call first advances the state to its
time, so that the results do not depend on the frequency of calls.
"""

from dataclasses import dataclass
import math

from beetle_omni_ros.robot.schema import parameter, ParameterFile
from beetle_omni_ros.sim.emulated import mavlink

BOOT, DISARMED, ARMED, RUNNING = range(4)
NONE, ASKED, HEARTBEAT_LOST, IDLE, WATCHDOG = range(5)      # reasons of the last disarming
(BOOTING, NO_HEARTBEAT, THROTTLE, BATTERY_LOW, ESC_FAILURE, TIMED_OUT,
 SATURATED) = (1 << bit for bit in range(7))
BLOCKS_ARMING = BOOTING | NO_HEARTBEAT | THROTTLE | BATTERY_LOW | ESC_FAILURE
CONTRACT_VERSION = 1
ARM_DISARM = 400                                            # MAV_CMD_COMPONENT_ARM_DISARM
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = range(4)
STOP = (0.0, 0.0, 0.0, 0.0)
UNKNOWN_CELL, UNKNOWN_CURRENT = 65535, -1       # of BATTERY_STATUS
GENERIC_FAILURE = 64                            # ESC_FAILURE_GENERIC
PWM = 0                                         # ESC_CONNECTION_TYPE_PPM
MIN_HEARTBEAT_PERIOD = 0.02                     # [s]


@dataclass(frozen=True, kw_only=True)
class EmulatedBoardParameters(ParameterFile, file='emulated_board.yaml'):
    """Parameters of the firmware contract and of the emulated sensors."""

    system: int = parameter(doc='MAVLink system ID', low=1, high=255)
    component: int = parameter(doc='MAVLink component ID', low=1, high=255)
    host_system: int = parameter(doc='system ID of the accepted sender', low=1, high=255)
    host_component: int = parameter(doc='component ID of the accepted sender', low=1,
                                    high=255)
    target_timeout: float = parameter(doc='time without a new target after which the rotors stop',
                                      unit='s', low=0.01, high=1)
    heartbeat_timeout: float = parameter(doc='time without a heartbeat after which it disarms',
                                         unit='s', low=0.1, high=10)
    idle_timeout: float = parameter(doc='time armed without a target after which it disarms',
                                    unit='s', low=0.1, high=60)
    throttle_low_time: float = parameter(doc='time without a nonzero target before arming',
                                         unit='s', low=0, high=10)
    target_age_limit: float = parameter(doc='largest age of a target', unit='s', low=0.01, high=10)
    target_future_limit: float = parameter(doc='largest lead of a stamp over the clock',
                                           unit='s', low=0, high=10)
    watchdog_time: float = parameter(doc='time from a hang to the reset', unit='s', low=0.001,
                                     high=1)
    boot_time: float = parameter(doc='time from a reset to the first heartbeat', unit='s', low=0,
                                 high=10)
    arm_cell_voltage: float = parameter(doc='smallest cell voltage for arming', unit='V', low=0,
                                        high=5)
    heartbeat_rate: float = parameter(doc='rate of HEARTBEAT', unit='Hz', low=1, high=50)
    battery_rate: float = parameter(doc='rate of BATTERY_STATUS', unit='Hz', low=1, high=200)
    rotor_rate: float = parameter(doc='rate of ESC_STATUS', unit='Hz', low=1, high=500)
    rotor_info_rate: float = parameter(doc='rate of ESC_INFO', unit='Hz', low=0.1, high=50)
    reception_rate: float = parameter(doc='rate of SYS_STATUS', unit='Hz', low=0.1, high=50)
    clock_start: float = parameter(doc='clock of the board at the start', unit='s', low=0,
                                   high=1e6)
    clock_drift: float = parameter(doc='drift of the clock of the board', unit='s/s', low=-0.01,
                                   high=0.01)
    rpm_at_1_newton: float = parameter(doc='speed of a rotor at 1 N', unit='1/min', low=1,
                                       high=1e5)
    idle_temperature: float = parameter(doc='temperature of the ESCs', unit='C', low=-40, high=150)


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


class BoardFirmware:
    """
    State machine of the board, powered at ``now`` [s] by a battery of ``cells``.

    Attributes:
        telemetry: measurements, set from outside.
        refused: reason -> number of refused targets since the start.
        timeouts: number of target timeouts with turning rotors.

    """

    def __init__(self, parameters: EmulatedBoardParameters, cells: int, now: float):
        self._parameters = parameters
        self._clock_zero = now - parameters.clock_start
        self.telemetry = BoardTelemetry(parameters, cells)
        self._start(now, NONE)

    def _start(self, now, reason):
        self._hung_at = math.inf
        self._booted_at = now + self._parameters.boot_time
        self._announced = False
        self._armed_at = -math.inf              # finite while armed
        self._stop_reason = reason
        self._heartbeat_at = self._nonzero_target_at = self._target_at = -math.inf
        self._target, self._target_stamp, self._saturated = STOP, -math.inf, False
        self.refused: dict[str, int] = {}
        self.timeouts = 0
        self.telemetry.restart(self._booted_at)

    def reboot(self, now: float, reason: int = NONE) -> None:
        """Reset the board: outputs off, initial state, clock at zero."""
        self._clock_zero = now
        self._start(now, reason)

    def hang(self, now: float) -> None:
        """Stop the execution; the outputs are constant until the watchdog resets the board."""
        self._advance(now)
        self._hung_at = min(self._hung_at, now)

    def clock(self, now: float) -> float:
        """Clock of the board [s since its start]."""
        return (now - self._clock_zero) * (1 + self._parameters.clock_drift)

    def runs(self, now: float) -> bool:
        """Whether the firmware is executed, neither booting nor hung."""
        self._advance(now)
        return now >= self._booted_at and self._hung_at == math.inf

    def state(self, now: float) -> int:
        """BOOT, DISARMED, ARMED (rotors stopped) or RUNNING (following targets)."""
        self._advance(now)
        if now < self._booted_at:
            return BOOT
        if self._armed_at == -math.inf:
            return DISARMED
        return RUNNING if self._fresh(min(now, self._hung_at)) else ARMED

    def outputs(self, now: float) -> tuple[float, ...]:
        """Normalised commands of the four PWM outputs, 0 to 1."""
        if self.state(now) != RUNNING:
            return STOP
        return self._target

    def conditions(self, now: float) -> int:
        """Bits of the conditions that prevent arming, and of timed-out and saturated targets."""
        parameters, bits = self._parameters, 0
        bits |= BOOTING * (now < self._booted_at)
        bits |= NO_HEARTBEAT * (now - self._heartbeat_at >= parameters.heartbeat_timeout)
        bits |= THROTTLE * (self._armed_at == -math.inf and
                            now - self._nonzero_target_at < parameters.throttle_low_time)
        bits |= BATTERY_LOW * self.telemetry.battery_low
        bits |= ESC_FAILURE * bool(self.telemetry.failed)
        bits |= TIMED_OUT * (self._armed_at > -math.inf and self._target_at > -math.inf
                             and not self._fresh(now))
        bits |= SATURATED * (self._saturated and self._fresh(now))
        return bits

    def receive(self, message: mavlink.Message, now: float) -> list[tuple[int, tuple]]:
        """Handle a message of the computer; return the answers (number, values)."""
        parameters = self._parameters
        if not self.runs(now) or (message.system, message.component) != (
                parameters.host_system, parameters.host_component):
            return []
        if message.number == mavlink.HEARTBEAT:
            self._heartbeat_at = now
        elif message.number == mavlink.TIMESYNC:
            remote, sent = message.values
            if remote == 0:
                return [(mavlink.TIMESYNC, (round(1e9 * self.clock(now)), sent))]
        elif message.number == mavlink.ACTUATOR_TARGET:
            self._take_target(message.values, now)
        elif message.number == mavlink.COMMAND_LONG:
            return self._command(message, now)
        return []

    def due(self, now: float, received) -> list[tuple[int, tuple]]:
        """Periodic messages due at ``now``; ``received`` has the counts of the parser."""
        if not self.runs(now):
            return []
        if not self._announced:
            self._announced = True
            return [self._heartbeat(BOOT, now)]
        messages = []
        beat = self._heartbeat(self.state(now), now)
        if self.telemetry.heartbeat_due(now, beat):
            messages.append(beat)
        stamp = round(1e6 * self.clock(now))
        messages += self.telemetry.due(now, stamp)
        if self.telemetry.reception_due(now):
            counts = (received.lost, received.bad_crc, sum(self.refused.values()), self.timeouts)
            messages.append(self.telemetry.reception(counts))
        return messages

    def _heartbeat(self, state, now):
        mode = state | self._stop_reason << 8 | self.conditions(now) << 16 | CONTRACT_VERSION << 24
        armed = state in (ARMED, RUNNING)
        status = 1 if state == BOOT else 5 if self.telemetry.failed else 4 if armed else 3
        return mavlink.HEARTBEAT, (mode, 2, 0, 1 | 128 * armed, status, 3)

    def _fresh(self, now):
        return now - self._target_at < self._parameters.target_timeout

    def _advance(self, now):
        """Advance the state to ``now``."""
        parameters = self._parameters
        if now >= self._hung_at + parameters.watchdog_time:
            self.reboot(self._hung_at + parameters.watchdog_time, WATCHDOG)
        if self._hung_at < math.inf or self._armed_at == -math.inf:
            return
        if now - self._heartbeat_at >= parameters.heartbeat_timeout:
            self._disarm(HEARTBEAT_LOST)
        elif now - max(self._target_at, self._armed_at) >= parameters.idle_timeout:
            self._disarm(IDLE)
        elif self._target is not STOP and not self._fresh(now):
            self._target = STOP
            self.timeouts += 1

    def _disarm(self, reason):
        self._armed_at, self._stop_reason = -math.inf, reason
        self._target, self._target_at = STOP, -math.inf

    def _take_target(self, values, now):
        stamp, controls, (group, system, component) = values[0] / 1e6, values[1:9], values[9:]
        reason = self._refusal(stamp, controls, group, system, component, now)
        if reason:
            self.refused[reason] = self.refused.get(reason, 0) + 1
            return
        newer, self._target_stamp = stamp > self._target_stamp, stamp
        if max(controls) > 0:
            self._nonzero_target_at = now
        if self._armed_at == -math.inf:
            self.refused['not armed'] = self.refused.get('not armed', 0) + 1
            return
        self._saturated = min(controls) < 0 or max(controls) > 1
        self._target = tuple(min(1.0, max(0.0, control)) for control in controls[:4])
        if newer:       # a repeated target does not prevent the timeout
            self._target_at = now

    def _refusal(self, stamp, controls, group, system, component, now):
        parameters = self._parameters
        if (system, component) != (parameters.system, parameters.component):
            return 'other addressee'
        if group:
            return 'other group'
        if not all(map(math.isfinite, controls)):
            return 'not finite'
        if any(controls[4:]):
            return 'more than four rotors'
        age = self.clock(now) - stamp
        if age > parameters.target_age_limit:
            return 'stale stamp'
        if age < -parameters.target_future_limit:
            return 'stamp in the future'
        if stamp < self._target_stamp:
            return 'older than the last'
        return ''

    def _command(self, message, now):
        *parameters, command, system, component, _ = message.values
        if (system, component) != (self._parameters.system, self._parameters.component):
            return []
        arm, force, detail = *parameters[:2], 0
        if command != ARM_DISARM:
            result = UNSUPPORTED
        elif arm not in (0.0, 1.0) or arm and force:
            result, detail = DENIED, int(arm == 1.0)    # nothing overrides the conditions
        elif arm:
            blocking = 0 if self._armed_at > -math.inf else self.conditions(now) & BLOCKS_ARMING
            result, detail = TEMPORARILY_REJECTED if blocking else ACCEPTED, 1 | blocking << 8
            if not blocking and self._armed_at == -math.inf:
                self._armed_at = now
        else:
            result = ACCEPTED
            if self._armed_at > -math.inf:
                self._disarm(ASKED)
        return [(mavlink.COMMAND_ACK, (command, result, 0, detail, message.system,
                                       message.component))]
