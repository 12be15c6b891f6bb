"""
The emulated motor board: the firmware of docs/reference/firmware.md on a pseudo-terminal.

The framing is that of the driver. ``test/drivers/reference_packets.py`` checks it independently.
"""

from collections.abc import Callable
import math
from pathlib import Path
import time
from types import SimpleNamespace

import numpy as np

from beetle_omni_ros.drivers.mavlink import (
    BOARD,
    common,
    EscInfo,
    EscStatus,
    HOST,
    MavlinkReceiver,
)
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.thrust_map import duty_of_command, ThrustMap
from beetle_omni_ros.sim.emulated.device import BoardFaults, Device
from beetle_omni_ros.sim.parameters import RPM_AT_1_NEWTON

BOOT, DISARMED, ARMED, RUNNING = range(4)
NONE, ASKED, HEARTBEAT_LOST, IDLE, WATCHDOG = range(5)      # reasons of the last disarming
(BOOTING, NO_HEARTBEAT, THROTTLE, BATTERY_LOW, ESC_FAILURE, TIMED_OUT,
 SATURATED) = (1 << bit for bit in range(7))
BLOCKS_ARMING = BOOTING | NO_HEARTBEAT | THROTTLE | BATTERY_LOW | ESC_FAILURE
CONTRACT_VERSION = 1
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = range(4)
STOP = (0.0, 0.0, 0.0, 0.0)
UNKNOWN_CELL, UNKNOWN_TEMPERATURE = 65535, 32767
GENERIC_FAILURE = 64            # ESC_FAILURE_GENERIC
MIN_HEARTBEAT_PERIOD = 0.02     # [s]
CLOCK_START, CLOCK_DRIFT = 4.0, 20e-6   # [s], [s/s] of the board's clock, as of a crystal
ESC_TEMPERATURE = 35.0          # [C]
PULSE_STEPS = 1_000_000         # of 1 ns from stop to full
# Section 2 of the contract: times [s], voltage of a cell [V], rates of messages [Hz].
NUMBERS = {
    'target_timeout': 0.1, 'heartbeat_timeout': 1.0, 'idle_timeout': 2.0,
    'throttle_low_time': 1.0, 'target_age_limit': 0.1, 'target_future_limit': 0.05,
    'boot_time': 0.3, 'arm_cell_voltage': 3.5, 'heartbeat_rate': 5.0, 'battery_rate': 50.0,
    'rotor_rate': 100.0, 'rotor_info_rate': 2.0, 'reception_rate': 1.0}


class BoardFirmware:
    """
    State machine of the board, powered at ``now`` [s] by a battery of ``cells``, without port.

    All times are arguments on a clock without steps. Each call first advances the state to its
    time, so that the results do not depend on the frequency of calls. ``changes`` are of NUMBERS.
    ``on_target`` is called after each target with its arrival [s] and its stamp [us], for
    measurements.
    """

    on_target: Callable[[float, int], None] | None = None

    def __init__(self, cells: int, now: float, **changes: float):
        self.numbers = SimpleNamespace(**NUMBERS | changes)
        self._clock_zero = now - CLOCK_START
        self._arm_voltage = cells * self.numbers.arm_cell_voltage
        # Measurements, set from outside: battery [V, A], rotors [1/min], failed ESCs (0 to 3).
        self.voltage = self.current = 0.0
        self.rpm = [0.0] * 4
        self.failed: frozenset[int] = frozenset()
        self._start(now, NONE)

    def _start(self, now, reason):
        self._booted_at = now + self.numbers.boot_time
        self._announced = False
        self._armed_at = -math.inf              # finite while armed
        self._stop_reason = reason
        self._heartbeat_at = self._nonzero_target_at = self._target_at = -math.inf
        self._target, self._target_stamp, self._saturated = STOP, -math.inf, False
        self.refused: dict[str, int] = {}   # reason -> number of refused targets
        self.timeouts = 0                   # of targets with turning rotors
        # Rate -> time at which its message is due [s].
        self._next = {name: self._booted_at for name in NUMBERS if name.endswith('_rate')}
        self._sent_mode, self._sent_at = None, -math.inf
        self._sent_failed: frozenset[int] | None = None
        self._errors = [0] * 4
        self._receiver, self._packer = MavlinkReceiver(*HOST), common.MAVLink(None, *BOARD)

    def reboot(self, now: float) -> None:
        """Reset by the watchdog: outputs off, initial state, clock at zero."""
        self._clock_zero = now
        self._start(now, WATCHDOG)

    def clock(self, now: float) -> float:
        """Clock of the board [s since its start]."""
        return (now - self._clock_zero) * (1 + CLOCK_DRIFT)

    def runs(self, now: float) -> bool:
        """Whether it has booted."""
        self._advance(now)
        return now >= self._booted_at

    @property
    def next_due(self) -> float:
        """Time of the next periodic message [s]."""
        return min(self._next.values())

    def state(self, now: float) -> int:
        """BOOT, DISARMED, ARMED (rotors stopped) or RUNNING (following targets)."""
        self._advance(now)
        if not self._announced:
            return BOOT
        if self._armed_at == -math.inf:
            return DISARMED
        return RUNNING if self._fresh(now) else ARMED

    def outputs(self, now: float) -> tuple[float, ...]:
        """Present normalised PWM commands, 0 (stop) to 1."""
        return self._target if self.state(now) == RUNNING else STOP

    def conditions(self, now: float) -> int:
        """Bits of the conditions that prevent arming, and of timed-out and saturated targets."""
        numbers, armed = self.numbers, self._armed_at > -math.inf
        return BOOTING * (not self._announced) \
            | NO_HEARTBEAT * (now - self._heartbeat_at >= numbers.heartbeat_timeout) \
            | THROTTLE * (not armed and
                          now - self._nonzero_target_at < numbers.throttle_low_time) \
            | BATTERY_LOW * (not self.voltage >= self._arm_voltage) \
            | ESC_FAILURE * bool(self.failed) \
            | TIMED_OUT * (armed and self._target_at > -math.inf and not self._fresh(now)) \
            | SATURATED * (self._saturated and self._fresh(now))

    def serve(self, data: bytes, now: float) -> list[bytes]:
        """Handle received bytes; return the frames that are due, then the answers."""
        if not self.runs(now):
            return []
        messages = self._due(now)   # before any answer: the first frame is a heartbeat
        for message in self._receiver.feed(data):
            messages += self._receive(message, now)
            if self.on_target and message.get_type() == 'SET_ACTUATOR_CONTROL_TARGET':
                self.on_target(now, message.time_usec)
        return [self._pack(message) for message in messages]

    def _pack(self, message):
        frame = message.pack(self._packer)
        self._packer.seq = (self._packer.seq + 1) % 256
        return frame

    def _receive(self, message, now):
        """Handle a message of the computer; return the answers."""
        kind = message.get_type()
        if kind == 'HEARTBEAT':
            self._heartbeat_at = now
        elif kind == 'TIMESYNC' and message.tc1 == 0:
            return [common.MAVLink_timesync_message(round(1e9 * self.clock(now)), message.ts1)]
        elif kind == 'SET_ACTUATOR_CONTROL_TARGET':
            self._take_target(message, now)
        elif kind == 'COMMAND_LONG' and self._is_for_us(message):
            return [self._command(message, now)]
        return []

    def _due(self, now):
        """Periodic messages due at ``now``."""
        received = self._receiver.counts
        if not self._announced:
            messages = [self._heartbeat(BOOT, now)]
            self._announced = True
            return messages
        messages, beat = [], self._heartbeat(self.state(now), now)
        changed = beat.custom_mode != self._sent_mode \
            and now - self._sent_at >= MIN_HEARTBEAT_PERIOD
        if self._is_due('heartbeat_rate', now) or changed:
            self._sent_mode, self._sent_at = beat.custom_mode, now
            messages.append(beat)
        stamp = round(1e6 * self.clock(now))
        failed = [k in self.failed for k in range(4)]
        works = [not bad for bad in failed]
        if self._is_due('rotor_info_rate', now) or self.failed != self._sent_failed:
            self._sent_failed = self.failed
            self._errors = [count + bad for count, bad in zip(self._errors, failed)]
            messages.append(EscInfo(
                0, stamp, 0, 4, 0, sum(on << k for k, on in enumerate(works)),
                [GENERIC_FAILURE * bad for bad in failed], self._errors,
                [UNKNOWN_TEMPERATURE if bad else round(100 * ESC_TEMPERATURE) for bad in failed]))
        if self._is_due('rotor_rate', now):
            messages.append(EscStatus(
                0, stamp, [round(rpm) * on for rpm, on in zip(self.rpm, works)],
                [self.voltage * on for on in works], [self.current / 4 * on for on in works]))
        total, current = max(0, round(1000 * self.voltage)), round(100 * self.current)
        if self._is_due('battery_rate', now):
            messages.append(common.MAVLink_battery_status_message(
                0, 0, 1, UNKNOWN_TEMPERATURE, [total, *[UNKNOWN_CELL] * 9], current, -1, -1, -1))
        if self._is_due('reception_rate', now):
            counts = (received['lost'], received['bad_crc'], sum(self.refused.values()),
                      self.timeouts)
            messages.append(common.MAVLink_sys_status_message(
                0, 0, 0, 0, total, current, -1, 0, *(min(count, 65535) for count in (
                    received['lost'] + received['bad_crc'], *counts))))
        return messages

    def _is_due(self, rate, now):
        """Whether a message with this rate is due: without drift, and once after a pause."""
        if now < self._next[rate]:
            return False
        period = 1 / getattr(self.numbers, rate)
        self._next[rate] += period * (1 + math.floor((now - self._next[rate]) / period))
        return True

    def _heartbeat(self, state, now):
        mode = state | self._stop_reason << 8 | self.conditions(now) << 16 | CONTRACT_VERSION << 24
        armed = state in (ARMED, RUNNING)
        status = 1 if state == BOOT else 5 if self.failed else 4 if armed else 3
        return common.MAVLink_heartbeat_message(2, 0, 1 | 128 * armed, mode, status, 3)

    def _fresh(self, now):
        return now - self._target_at < self.numbers.target_timeout

    def _advance(self, now):
        """Advance the state to ``now``."""
        numbers = self.numbers
        if self._armed_at == -math.inf:
            return
        if now - self._heartbeat_at >= numbers.heartbeat_timeout:
            self._disarm(HEARTBEAT_LOST)
        elif now - max(self._target_at, self._armed_at) >= numbers.idle_timeout:
            self._disarm(IDLE)
        elif self._target is not STOP and not self._fresh(now):
            self._target = STOP
            self.timeouts += 1

    def _disarm(self, reason):
        self._armed_at, self._stop_reason = -math.inf, reason
        self._target, self._target_at = STOP, -math.inf

    def _is_for_us(self, message):
        return (message.target_system, message.target_component) == BOARD

    def _take_target(self, message, now):
        stamp, controls = message.time_usec / 1e6, message.controls
        reason = self._refusal(message, stamp, controls, now)
        if not reason:
            newer, self._target_stamp = stamp > self._target_stamp, stamp
            if max(controls) > 0:
                self._nonzero_target_at = now
            reason = 'not armed' if self._armed_at == -math.inf else ''
        if reason:
            self.refused[reason] = self.refused.get(reason, 0) + 1
            return
        if newer:       # a repeated target does not prevent the timeout
            self._target_at = now
        if self._fresh(now):
            self._saturated = min(controls) < 0 or max(controls) > 1
            self._target = tuple(math.floor(PULSE_STEPS * min(1.0, max(0.0, control)) + 0.5)
                                 / PULSE_STEPS for control in controls[:4])

    def _refusal(self, message, stamp, controls, now):
        age = self.clock(now) - stamp
        if not self._is_for_us(message):
            return 'other addressee'
        if message.group_mlx:
            return 'other group'
        if not all(map(math.isfinite, controls)):
            return 'not finite'
        if any(controls[4:]):
            return 'more than four rotors'
        if age > self.numbers.target_age_limit:
            return 'stale stamp'
        if age < -self.numbers.target_future_limit:
            return 'stamp in the future'
        return 'older than the last' if stamp < self._target_stamp else ''

    def _command(self, message, now):
        arm, detail, armed = message.param1, 0, self._armed_at > -math.inf
        if message.command != common.MAV_CMD_COMPONENT_ARM_DISARM:
            result = UNSUPPORTED
        elif arm not in (0.0, 1.0) or arm and message.param2:
            result, detail = DENIED, int(arm == 1.0)    # nothing overrides the conditions
        elif arm:
            blocking = 0 if armed else self.conditions(now) & BLOCKS_ARMING
            result, detail = TEMPORARILY_REJECTED if blocking else ACCEPTED, 1 | blocking << 8
            if not blocking and not armed:
                self._armed_at = now
        else:
            result = ACCEPTED
            if armed:
                self._disarm(ASKED)
        return common.MAVLink_command_ack_message(message.command, result, 0, detail,
                                                  message.get_srcSystem(),
                                                  message.get_srcComponent())


class EmulatedMotorBoard(Device):
    """
    A motor board whose PWM the rotor map of the true ``robot`` converts to thrust.

    A plant reads :attr:`thrust_targets` and sets the sensors, from any thread. Before
    :meth:`set_battery` the battery is full, and before :meth:`set_rotors` the rotors report no
    speed. ``changes`` are of NUMBERS. ``firmware_type`` may be replaced by another firmware with
    the methods of BoardFirmware; a test does this with the one in C of the folder firmware.
    """

    firmware_type = BoardFirmware

    def __init__(self, robot: RobotParameters | None = None, *, seed: int = 0,
                 port: str | Path | None = None, **changes: float):
        robot = robot or RobotParameters.load()
        self._map = ThrustMap(robot.rotors)
        self.faults = BoardFaults()
        self.firmware = self.firmware_type(robot.battery.cells, time.monotonic(), **changes)
        self.set_battery(robot.battery.full_voltage, 0.0)
        super().__init__('motor_board', port, seed)

    @property
    def armed(self) -> bool:
        """Whether the board is armed."""
        with self._lock:
            return self.firmware.state(time.monotonic()) >= ARMED

    @property
    def commands(self) -> np.ndarray:
        """(4,) present normalised PWM commands, 0 (stop) to 1, also of failed ESCs."""
        with self._lock:
            # Handle received bytes, because the thread may not have been scheduled.
            now = time.monotonic()
            self._serve(now)
            return np.array(self.firmware.outputs(now))

    @property
    def thrust_targets(self) -> np.ndarray:
        """(4,) targets of the rotors [N] for the PWM commands at the true voltage."""
        thrust = self._map.thrust(duty_of_command(self.commands), self.firmware.voltage)
        thrust[list(self.firmware.failed)] = 0.0
        return thrust

    def set_battery(self, voltage: float, current: float) -> None:
        """Set voltage [V] and drawn current [A]."""
        self.firmware.voltage, self.firmware.current = float(voltage), float(current)

    def set_rotors(self, thrust: np.ndarray) -> None:
        """Set present thrusts (4,) [N] of the rotors."""
        self.firmware.rpm = (RPM_AT_1_NEWTON * np.sqrt(np.maximum(thrust, 0.0))).tolist()

    def reboot(self) -> None:
        """Reset the board, as its watchdog does."""
        with self._lock:
            self.firmware.reboot(time.monotonic())

    def _due(self):
        telemetry = self.firmware.next_due
        return telemetry if telemetry > time.monotonic() else math.inf

    def _serve(self, now):
        """Receive, execute and send."""
        received = self._spoilt(self._read(), self.faults.drop_in, self.faults.corrupt_in)
        # Read the clock after the bytes, as a board does, because this thread may have waited.
        now = time.monotonic()
        self.firmware.failed = frozenset(int(rotor) - 1 for rotor in self.faults.failed_escs)
        for frame in self.firmware.serve(received, now):
            self._send(self._spoilt(frame, self.faults.drop_out, self.faults.corrupt_out))
