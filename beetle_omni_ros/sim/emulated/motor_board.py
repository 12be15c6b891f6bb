"""The emulated motor board: firmware, sensors and faults on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Callable
import heapq
import math
from pathlib import Path
import random
import threading
import time

import numpy as np

from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.thrust_map import duty_of_command, ThrustMap
from beetle_omni_ros.sim.emulated import mavlink
from beetle_omni_ros.sim.emulated.board_firmware import BoardFirmware, EmulatedBoardParameters
from beetle_omni_ros.sim.emulated.fault_switches import BoardFaults
from beetle_omni_ros.sim.emulated.pseudo_terminal import PseudoTerminal

TICK = 0.01             # [s] longest sleep of the thread


class Line:
    """One direction of a cable, which loses, corrupts and delays frames by a seed."""

    def __init__(self, seed: int):
        self._random = random.Random(seed)
        self._waiting: list = []
        self._count = 0

    def put(self, data: bytes, now: float, corrupt: float, drop: float, delay: float) -> None:
        """Send a frame at ``now`` [s] with these faults."""
        if drop and self._random.random() < drop:
            return
        if corrupt and self._random.random() < corrupt:
            corrupted = bytearray(data)
            corrupted[self._random.randrange(len(data))] ^= 1 << self._random.randrange(8)
            data = bytes(corrupted)
        self._count += 1
        heapq.heappush(self._waiting, (now + delay, self._count, data))

    def take(self, now: float) -> bytes:
        """Receive everything that has arrived by ``now`` [s]."""
        pieces = []
        while self._waiting and self._waiting[0][0] <= now:
            pieces.append(heapq.heappop(self._waiting)[2])
        return b''.join(pieces)

    def next(self) -> float:
        """Arrival of the next frame [s], inf without one."""
        return self._waiting[0][0] if self._waiting else float('inf')

    def clear(self) -> None:
        """Lose all frames that have not arrived."""
        self._waiting.clear()


def frames(data: bytes) -> list[bytes]:
    """Split a sequence of valid MAVLink 2 packets; an incomplete rest is one more piece."""
    pieces = []
    while data:
        size = 12 + data[1] if len(data) > 1 and data[0] == 0xFD else len(data)
        pieces.append(data[:size])
        data = data[size:]
    return pieces


class EmulatedMotorBoard:
    """
    A motor board that a driver can open by :attr:`port`.

    A thread serves the port in real time. A plant reads :attr:`commands` or
    :attr:`thrust_targets` and sets the sensors, from any thread. Before :meth:`set_battery` the
    battery is full, and before :meth:`set_rotors` the rotors follow their targets without lag.

    Args:
        robot: the true robot, whose rotor map converts PWM to thrust.
        parameters: parameters of the board; default: params/emulated_board.yaml.
        port: path of the created port; by default a temporary one.

    Attributes:
        faults: present faults; their attributes may be set at any time.
        on_target: called in the board's thread after each target with its arrival
            [s, monotonic] and its wire values, for measurements.

    Raises:
        OSError: the port cannot be created.

    """

    def __init__(self, robot: RobotParameters | None = None,
                 parameters: EmulatedBoardParameters | None = None, seed: int = 0,
                 port: str | Path | None = None):
        robot = robot or RobotParameters.load()
        self._parameters = parameters or EmulatedBoardParameters.load()
        self._map = ThrustMap(robot.rotors)
        self.faults = BoardFaults()
        self.on_target: Callable[[float, tuple], None] | None = None
        self._lock = threading.RLock()
        self._firmware = BoardFirmware(self._parameters, robot.battery.cells, time.monotonic())
        self._voltage, self._current = robot.battery.full_voltage, 0.0
        self._error = 0.0, 0.0
        self._thrust: np.ndarray | None = None
        self._parser = mavlink.Parser()
        self._incoming, self._outgoing = Line(seed), Line(seed + 1)
        self._sequence, self._executes = 0, True
        self._terminal = PseudoTerminal(port, 'motor_board')
        self._stop = False
        self._thread = threading.Thread(target=self._run, name='emulated_motor_board', daemon=True)
        self._thread.start()

    @property
    def port(self) -> str:
        """Path of the serial port, which does not change when it is unplugged."""
        return self._terminal.port

    def close(self) -> None:
        """Stop the thread and remove the port."""
        if self._stop:
            return
        self._stop = True
        self._terminal.interrupt()
        self._thread.join(2.0)
        self._terminal.close()

    def __enter__(self) -> EmulatedMotorBoard:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    @property
    def armed(self) -> bool:
        """Whether the board is armed."""
        with self._lock:
            return self._firmware.state(time.monotonic()) >= 2

    @property
    def commands(self) -> np.ndarray:
        """(4,) present normalised PWM commands, 0 (stop) to 1, also of failed ESCs."""
        with self._lock:
            # Handle received bytes, because the thread may not have been scheduled.
            now = time.monotonic()
            self._step(now)
            return np.array(self._firmware.outputs(now))

    @property
    def thrust_targets(self) -> np.ndarray:
        """(4,) targets of the rotors [N] for the PWM commands at the true voltage."""
        with self._lock:
            return self._thrusts(self.commands)

    def _thrusts(self, commands):
        thrust = self._map.thrust(duty_of_command(commands), self.voltage)
        for rotor in self.faults.failed_escs:
            thrust[int(rotor) - 1] = 0.0
        return thrust

    @property
    def voltage(self) -> float:
        """True battery voltage with the sag fault [V]."""
        return self._voltage - self.faults.voltage_sag

    @property
    def refused(self) -> dict[str, int]:
        """Reason -> number of refused targets since the start of the board."""
        return dict(self._firmware.refused)

    def set_battery(self, voltage: float, current: float,
                    error: tuple[float, float] = (0.0, 0.0)) -> None:
        """
        Set the state of the battery.

        Args:
            voltage: true voltage under load [V].
            current: true drawn current [A, positive].
            error: errors of the measured voltage and current [V, A].

        """
        self._voltage, self._current, self._error = float(voltage), float(current), error

    def set_rotors(self, thrust: np.ndarray, temperature: np.ndarray | None = None) -> None:
        """Set present thrusts (4,) [N] and ESC temperatures (4,) [C] of the rotors."""
        self._thrust = np.array(thrust, dtype=float)
        if temperature is not None:
            self._firmware.telemetry.temperature = [float(value) for value in temperature]

    def reboot(self) -> None:
        """Reset the board, as a brown-out does."""
        with self._lock:
            self._firmware.reboot(time.monotonic())
            self._clear_stream()

    def hang(self) -> None:
        """Hang the firmware until its watchdog resets it."""
        with self._lock:
            self._firmware.hang(time.monotonic())

    def unplug(self) -> None:
        """Unplug the cable."""
        with self._lock:
            self._terminal.unplug()
            self._incoming.clear()
            self._outgoing.clear()

    def plug(self) -> None:
        """Plug the cable in; the port has its old path."""
        with self._lock:
            self._terminal.plug()

    def _clear_stream(self):
        self._parser, self._sequence = mavlink.Parser(), 0

    def _run(self):
        while not self._stop:
            self._terminal.wait(self._wait_time())
            with self._lock:
                self._step(time.monotonic())

    def _wait_time(self):
        """Time until something is due [s]."""
        now = time.monotonic()
        telemetry = self._firmware.telemetry.next()
        return min(telemetry if telemetry > now else now + TICK, self._incoming.next(),
                   self._outgoing.next(), now + TICK) - now

    def _step(self, now):
        """Receive, execute and send."""
        faults, executed = self.faults, self._executes
        self._executes = executes = self._firmware.runs(now)
        if executed and not executes:
            self._clear_stream()
        received = self._terminal.read()
        # Read the clock after the bytes, as a board does, because this thread may have waited.
        now = time.monotonic()
        for frame in frames(received):
            self._incoming.put(frame, now, faults.corrupt_in, faults.drop_in, faults.delay_in)
        data = self._incoming.take(now)
        if executes:
            self._measure(now)
            for message in self._parser.feed(data):
                self._send(self._firmware.receive(message, now), now)
                if self.on_target and message.number == mavlink.ACTUATOR_TARGET:
                    self.on_target(now, message.values)
            self._send(self._firmware.due(now, self._parser), now)
        out = self._outgoing.take(now)
        if out:
            self._terminal.write(out)

    def _send(self, messages, now):
        faults = self.faults
        for number, values in messages:
            frame = mavlink.pack(number, values, self._sequence, self._parameters.system,
                                 self._parameters.component)
            self._sequence = (self._sequence + 1) % 256
            self._outgoing.put(frame, now, faults.corrupt_out, 1.0 if faults.mute
                               else faults.drop_out, faults.delay_out)

    def _measure(self, now):
        """Set the measurements of the telemetry."""
        telemetry = self._firmware.telemetry
        telemetry.voltage = self.voltage + self._error[0]
        telemetry.current = self._current + self._error[1]
        telemetry.failed = frozenset(int(rotor) - 1 for rotor in self.faults.failed_escs)
        thrust = self._thrust
        if thrust is None:
            thrust = self._thrusts(np.array(self._firmware.outputs(now)))
        powers = [max(0.0, f) ** 1.5 for f in thrust.tolist()]
        total = sum(powers)
        telemetry.rpm = [self._parameters.rpm_at_1_newton * math.sqrt(max(0.0, f))
                         for f in thrust.tolist()]
        # The battery current is divided among the rotors by aerodynamic power.
        telemetry.rotor_current = [self._current * power / total if total else 0.0
                                   for power in powers]
