"""
The firmware of the motor board by docs/reference/firmware.md, as a pure state machine.

All times are arguments [s] on a clock without steps. Each call first advances the state to its
time, so that the results do not depend on the frequency of calls.
"""

import math

from beetle_omni_ros.sim.emulated import mavlink
from beetle_omni_ros.sim.emulated.board_parameters import EmulatedBoardParameters
from beetle_omni_ros.sim.emulated.board_telemetry import BoardTelemetry

BOOT, DISARMED, ARMED, RUNNING = range(4)
NONE, ASKED, HEARTBEAT_LOST, IDLE, WATCHDOG = range(5)      # reasons of the last disarming
(BOOTING, NO_HEARTBEAT, THROTTLE, BATTERY_LOW, ESC_FAILURE, TIMED_OUT,
 SATURATED) = (1 << bit for bit in range(7))
BLOCKS_ARMING = BOOTING | NO_HEARTBEAT | THROTTLE | BATTERY_LOW | ESC_FAILURE
CONTRACT_VERSION = 1
ARM_DISARM = 400                                            # MAV_CMD_COMPONENT_ARM_DISARM
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = range(4)
STOP = (0.0, 0.0, 0.0, 0.0)


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
