"""Emulated devices: serial ports without hardware, their faults, and the coupling to a plant."""

from __future__ import annotations

from collections import deque
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from math import ceil
import os
from pathlib import Path
from random import Random
import select
import shutil
import tempfile
from threading import RLock, Thread
import time
import tty
from typing import Any, TYPE_CHECKING

import numpy as np

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import parameter, ParameterError
from beetle_omni_ros.sim.fault_kinds import Drive
from beetle_omni_ros.sim.sensors import Frame
from beetle_omni_ros.sim.simulator import ROUNDING, Simulator

if TYPE_CHECKING:       # pymavlink is needed by an emulated board only
    from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard
    from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus

CHUNK = 4096    # [B] size of the kernel's buffer
PERIOD = 0.01   # [s] longest sleep of the thread
SHARE = {'low': 0, 'high': 1}
LISTED = {'low': 1, 'high': 252}


@dataclass(kw_only=True)
class ServoFaults:
    """Faults of the servo bus, which may be changed at any time."""

    bad_crc: float = parameter(0.0, doc='share of answers with a flipped bit', **SHARE)
    dropped: float = parameter(0.0, doc='share of lost answers', **SHARE)
    delayed: float = parameter(0.0, doc='share of late answers', **SHARE)
    delay: float = parameter(0.02, doc='delay of late answers', unit='s', low=0, high=10)
    silent: np.ndarray = parameter([], doc='IDs that receive and answer nothing', **LISTED)
    overload: np.ndarray = parameter([], doc='IDs with a permanent overload', **LISTED)
    supply_voltage: float = parameter(12.0, doc='supply voltage of the servos', unit='V', low=0,
                                      high=30)


@dataclass(kw_only=True)
class BoardFaults:
    """Faults of motor board, rotors and cable, as :class:`ServoFaults`."""

    corrupt_out: float = parameter(0.0, doc='share of packets of the board with a flipped bit',
                                   **SHARE)
    corrupt_in: float = parameter(0.0, doc='share of packets to the board with a flipped bit',
                                  **SHARE)
    drop_out: float = parameter(0.0, doc='share of lost packets of the board', **SHARE)
    drop_in: float = parameter(0.0, doc='share of lost packets to the board', **SHARE)
    failed_escs: np.ndarray = parameter([], doc='rotors (1 to 4) that do not turn', low=1, high=4)


def switched_on(faults: ServoFaults | BoardFaults) -> list[str]:
    """Faults that differ from their defaults, such as 'silent [2]'."""
    healthy = vars(type(faults)())
    return [f'{name} {value.astype(int).tolist() if isinstance(value, np.ndarray) else value}'
            for name, value in vars(faults).items() if not np.array_equal(value, healthy[name])]


class Device(AbstractContextManager):
    """
    The device's end of a serial cable, as a context manager.

    A thread calls ``_serve(now)`` of the subclass, at the latest at the time ``_due()`` [s]. The
    path ``port`` for the driver, by default ``name`` in a temporary folder, is a link to the
    present terminal. It exists while plugged in; an OSError reports that it cannot be created.
    """

    def __init__(self, name: str, port: str | Path | None, seed: int):
        self._folder = None if port else tempfile.mkdtemp(prefix='emulated_')
        self.port = str(port or Path(self._folder) / name)
        self._lock, self._device, self._line = RLock(), -1, -1
        self._random = Random(seed)
        self._running = True
        self.plug()
        self._thread = Thread(target=self._run, name=f'emulated {name}', daemon=True)
        self._thread.start()

    def __exit__(self, *_):
        self.close()

    def close(self) -> None:
        """Stop the thread and remove the port."""
        if self._running:
            self._running = False
            self._thread.join(2.0)
            self.unplug()
            if self._folder:
                shutil.rmtree(self._folder, ignore_errors=True)

    def plug(self) -> None:
        """Plug the cable in, unless it is."""
        link = Path(self.port)
        with self._lock:
            if self._device >= 0:
                return
            if os.path.lexists(link) and not link.is_symlink():
                raise OSError(f'{link}: cannot be used as a port, it exists and is no link')
            # The driver's end is kept open, because a serial device cannot detect its driver.
            self._device, self._line = os.openpty()
            tty.setraw(self._line)
            os.set_blocking(self._device, False)
            try:
                link.unlink(missing_ok=True)
                link.symlink_to(os.ttyname(self._line))
            except OSError as error:
                self.unplug()
                raise OSError(f'{link}: cannot be used as a port ({error.strerror})') from None

    def unplug(self) -> None:
        """Unplug the cable; a driver that has the port open gets an error or an end of file."""
        with self._lock:
            if self._device < 0:
                return
            link = Path(self.port)
            if link.is_symlink() and os.readlink(link) == os.ttyname(self._line):
                link.unlink()       # another device may have replaced it
            os.close(self._line)
            os.close(self._device)
            self._device = self._line = -1

    def _run(self):
        while self._running:
            now = time.monotonic()
            timeout = max(0.0, min(self._due(), now + PERIOD) - now)
            device = self._device
            with suppress(OSError, ValueError):     # it was unplugged meanwhile
                select.select([device] if device >= 0 else [], [], [], timeout)
            with self._lock:
                self._serve(time.monotonic())

    def _read(self) -> bytes:
        """Received bytes; empty without any, or if unplugged."""
        with suppress(OSError):
            return os.read(self._device, CHUNK)
        return b''

    def _send(self, data: bytes) -> None:
        """Send; it is lost if the buffer is full or the cable unplugged."""
        with suppress(OSError):
            os.write(self._device, data)

    def _spoilt(self, data: bytes, lost: float, corrupt: float) -> bytes:
        """Bytes after a cable that loses them, or flips a bit, with these probabilities."""
        draw = self._random.random
        if not data or draw() < lost:
            return b''
        if draw() < corrupt:
            bit = self._random.randrange(8 * len(data))
            return (int.from_bytes(data, 'big') ^ 1 << bit).to_bytes(len(data), 'big')
        return data

    def _due(self) -> float:
        raise NotImplementedError

    def _serve(self, now: float) -> None:
        raise NotImplementedError


class EmulatedActuators:
    """
    Couples the devices with the simulator, which follows their goals and sets their sensors.

    The devices run in real time, so :meth:`step` is called once in each tick of real time. Their
    outputs act after the command delay of the conditions. A command for the IMU sample of one
    tick, received before the next tick, then acts at the same time as without devices.
    """

    def __init__(self, simulator: Simulator, bus: EmulatedServoBus, board: EmulatedMotorBoard):
        self.bus, self.board = bus, board
        self._simulator = simulator
        tilt, thrust = simulator.command_delays
        self._tilts = _line(tilt, simulator.tick, lambda: (np.zeros(4), [False] * 4))
        self._thrusts = _line(thrust, simulator.tick, lambda: np.zeros(4))
        truth = simulator.truth
        bus.set_state(truth.tilt, truth.tilt_velocity, np.zeros(4))
        board.set_rotors(truth.thrust)
        board.set_battery(simulator.battery.voltage, simulator.battery.current)

    @classmethod
    def of(cls, simulator: Simulator, robot: RobotParameters, servos: Any, *, seed: int = 0,
           servo_port: str = '', board_port: str = '') -> EmulatedActuators:
        """
        Make and connect both devices.

        ``servos`` has ids, signs and zeros of the servos; a port '' is a temporary one.
        """
        from beetle_omni_ros.sim.emulated.motor_board import EmulatedMotorBoard  # has pymavlink
        from beetle_omni_ros.sim.emulated.servo_bus import EmulatedServoBus
        bus = EmulatedServoBus(
            servos.ids.astype(int).tolist(), port=servo_port or None,
            signs=servos.signs.astype(int).tolist(), zeros=servos.zeros.astype(int).tolist(),
            seed=seed)
        return cls(simulator, bus, EmulatedMotorBoard(robot, seed=seed, port=board_port or None))

    def close(self) -> None:
        """Stop both devices and remove their ports."""
        self.bus.close()
        self.board.close()

    def step(self) -> Frame:
        """Advance the simulator by one tick."""
        goals, powered = self.bus.drive()
        self._tilts.append((np.array(goals), powered))
        self._thrusts.append(self.board.thrust_targets)
        tilt, powered = self._tilts[0]
        frame = self._simulator.step(Drive(tilt, self._thrusts[0], powered))
        joints, battery = frame.joints, self._simulator.battery
        # The current of a servo without torque is zero.
        self.bus.set_state(joints.position, joints.velocity, joints.effort * powered)
        self.board.set_battery(battery.voltage, battery.current)
        self.board.set_rotors(frame.truth.thrust)
        return frame

    def set_faults(self, servo: ServoFaults, board: BoardFaults) -> None:
        """
        Switch faults on and off.

        A ParameterError reports an unknown servo, without any change.
        """
        ids = [one['ID'] for one in self.bus.servos]
        for wanted in (*servo.silent, *servo.overload):
            if wanted not in ids:
                raise ParameterError(f'servo_faults: no servo has the id {wanted:g}; the ids are '
                                     f'{ids}')
        self.bus.faults, self.board.faults = servo, board

    @property
    def faults(self) -> list[str]:
        """Active faults as texts such as 'servo silent [2]'."""
        return [f'{name} {text}' for name, device in (('servo', self.bus), ('board', self.board))
                for text in switched_on(device.faults)]

    def status(self) -> dict[str, object]:
        """States and refusals of the devices, for diagnostics."""
        bus, board = self.bus, self.board
        return {'servo_port': bus.port, 'board_port': board.port, 'armed': board.armed,
                'torque': bus.drive()[1], 'servo refused': bus.refusals,
                **{f'board refused: {reason}': count
                   for reason, count in board.firmware.refused.items()}}


def _line(delay, tick, make):
    """Queue whose first entry is older than its last by ``delay`` [s], rounded up to ticks."""
    length = 1 + max(0, ceil(delay / tick - ROUNDING))
    return deque((make() for _ in range(length)), maxlen=length)
