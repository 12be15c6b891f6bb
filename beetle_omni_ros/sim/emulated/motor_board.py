"""
The emulated motor board: the firmware in C of the folder ``firmware`` on a pseudo-terminal.

docs/reference/firmware.md is its contract. ``test/drivers/reference_packets.py`` checks the frames
independently.
"""

import ctypes
from ctypes import c_bool, c_size_t, c_uint32, c_uint64
from functools import cache
import math
from pathlib import Path
import time

import numpy as np

from beetle_omni_ros.model.native import built
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.parts import duty_of_command, ThrustMap
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import unknown
from beetle_omni_ros.sim.emulated.device import BoardFaults, Device
from beetle_omni_ros.sim.parameters import RPM_AT_1_NEWTON

BOOT, DISARMED, ARMED, RUNNING = range(4)
STOP = 1_000_000                # [ns] pulse of a stopped rotor, and its change to full thrust
CLOCK_START, CLOCK_DRIFT = 4.0, 20e-6   # [s], [s/s] of the board's clock, as of a crystal
ESC_TEMPERATURE = 3500          # [0.01 C]
STEP = 0.005                    # [s] longest time between two calls of the firmware
# Section 2 of the contract: times [s], voltage of a cell [V], rates of messages [Hz]; in the order
# of the fields of mb_numbers.
NUMBERS = {
    'target_timeout': 0.1, 'heartbeat_timeout': 1.0, 'idle_timeout': 2.0,
    'throttle_low_time': 1.0, 'target_age_limit': 0.1, 'target_future_limit': 0.05,
    'boot_time': 0.3, 'arm_cell_voltage': 3.5, 'heartbeat_rate': 5.0, 'battery_rate': 50.0,
    'rotor_rate': 100.0, 'rotor_info_rate': 2.0, 'reception_rate': 1.0}
# Why targets are refused, in the order of mb_board.
REFUSALS = ('other addressee', 'other group', 'not finite', 'more than four rotors', 'stale stamp',
            'stamp in the future', 'older than the last', 'not armed')
_SEND = ctypes.CFUNCTYPE(c_bool, ctypes.c_void_p, ctypes.c_void_p, c_size_t)


@cache
def library() -> ctypes.CDLL:
    """Compile and load the firmware; a RunError reports a missing compiler."""
    header, source = (share_path(f'firmware/motor_board.{end}').read_text() for end in 'hc')
    return ctypes.CDLL(str(built('motor_board', source.replace(
        '#include "motor_board.h"', header), ('-std=c11',))))


class BoardFirmware:
    """
    The firmware, powered at ``now`` [s] by a battery of ``cells``, without port.

    All times are arguments on a clock without steps. ``changes`` are of NUMBERS; a ParameterError
    reports another name.

    Attributes:
        voltage, current: of the battery [V], [A]; set from outside, as the next two.
        rpm: of the four rotors [1/min].
        failed: rotors (0 to 3) whose ESC is silent.
        refused: reason -> number of refused targets.
        timeouts: number of timeouts of targets with turning rotors.

    """

    def __init__(self, cells: int, now: float, **changes: float):
        for name in changes.keys() - NUMBERS.keys():
            raise unknown('motor board', 'number', name, NUMBERS)
        # [us], [mV], and 1: the telemetry wires of the ESCs are connected
        self.numbers = (c_uint32 * (len(NUMBERS) + 1))(*(
            round(1000 * cells * value if name == 'arm_cell_voltage' else
                  1e6 / value if name.endswith('_rate') else 1e6 * value)
            for name, value in (NUMBERS | changes).items()), 1)
        self.voltage = self.current = 0.0
        self.rpm, self.failed = [0.0] * 4, frozenset[int]()
        self._frames: list[bytes] = []
        self._send = _SEND(lambda context, frame, size: self._frames.append(
            ctypes.string_at(frame, size)) is None)
        self.reboot(now, CLOCK_START, by_watchdog=False)

    def reboot(self, now: float, clock: float = 0.0, by_watchdog: bool = True) -> None:
        """Reset the board: outputs off, initial state, its clock at ``clock`` [s]."""
        self._zero, self.timeouts = now - clock, 0
        self.refused: dict[str, int] = {}
        self._board = ctypes.create_string_buffer(c_size_t.in_dll(library(), 'mb_size').value)
        library().mb_reset(self._board, self.numbers, self._send, None, by_watchdog,
                           self._micros(now))

    def clock(self, now: float) -> float:
        """Clock of the board [s]."""
        return (now - self._zero) * (1 + CLOCK_DRIFT)

    def _micros(self, now):
        return c_uint64(round(1e6 * self.clock(now)))

    def serve(self, data: bytes, now: float) -> list[bytes]:
        """Handle received bytes; return the frames that are due, then the answers."""
        lib, at = library(), self._micros(now)
        voltage, current = round(1000 * self.voltage), round(1000 * self.current)
        lib.mb_battery(self._board, voltage, round(current / 10))
        for rotor in {0, 1, 2, 3} - self.failed:
            lib.mb_telemetry(self._board, rotor, (c_uint32 * 4)(
                round(self.rpm[rotor]), voltage, round(current / 4), ESC_TEMPERATURE), at)
        lib.mb_step(self._board, at)
        lib.mb_receive(self._board, data, c_size_t(len(data)), at)
        _, _, self.timeouts, *refused = (c_uint32 * (3 + len(REFUSALS))).from_buffer(self._board)
        self.refused = {reason: count for reason, count in zip(REFUSALS, refused) if count}
        frames, self._frames = self._frames, []
        return frames

    def outputs(self, now: float) -> tuple[float, ...]:
        """Present normalised PWM commands, 0 (stop) to 1."""
        pulses = (c_uint32 * 4)()
        library().mb_pulses(self._board, self._micros(now), pulses)
        return tuple((pulse - STOP) / STOP for pulse in pulses)

    def state(self, now: float) -> int:
        """BOOT, DISARMED, ARMED (rotors stopped) or RUNNING (following targets)."""
        return library().mb_state(self._board, self._micros(now))


class EmulatedMotorBoard(Device):
    """
    A motor board whose PWM the rotor map of the true ``robot`` converts to thrust.

    A plant reads :attr:`thrust_targets` and sets the sensors, from any thread. Before
    :meth:`set_battery` the battery is full, and before :meth:`set_rotors` the rotors report no
    speed. ``changes`` are those of BoardFirmware.
    """

    def __init__(self, robot: RobotParameters | None = None, *, seed: int = 0,
                 port: str | Path | None = None, **changes: float):
        robot = robot or RobotParameters.load()
        self._map = ThrustMap(robot.rotors)
        self.faults = BoardFaults()
        self.firmware = BoardFirmware(robot.battery.cells, time.monotonic(), **changes)
        self._next = -math.inf
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
        return self._next

    def _serve(self, now):
        """Receive, execute and send."""
        received = self._spoilt(self._read(), self.faults.drop_in, self.faults.corrupt_in)
        # Read the clock after the bytes, as a board does, because this thread may have waited.
        now = time.monotonic()
        self._next = now + STEP
        self.firmware.failed = frozenset(int(rotor) - 1 for rotor in self.faults.failed_escs)
        for frame in self.firmware.serve(received, now):
            self._send(self._spoilt(frame, self.faults.drop_out, self.faults.corrupt_out))
