"""The emulated servo bus: servos behind a pseudo-terminal, with faults that can be switched on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import heapq
import itertools
from random import Random
from threading import Lock, Thread
import time

import numpy as np

from beetle_omni_ros.robot.parameters import JointParameters
from beetle_omni_ros.robot.servo import NUMPY, Servo, Step
from beetle_omni_ros.sim.emulated import servo_table as table
from beetle_omni_ros.sim.emulated.dynamixel import Receiver
from beetle_omni_ros.sim.emulated.pseudo_terminal import PseudoTerminal
from beetle_omni_ros.sim.emulated.servo import EmulatedServo
from beetle_omni_ros.sim.emulated.servo_network import ServoNetwork

STEP = 0.001  # [s] far below the period of the servo's 11 Hz
WATCH = 0.01       # [s] how often watchdogs and temperatures are looked at
PAUSE = 0.05       # [s] silence after which an unfinished packet is forgotten
BITS_PER_BYTE = 10  # start, eight data, stop


class SecondOrderMotion:
    """
    Free servos, without load.

    Attributes:
        position: (n,) [rad].
        velocity: (n,) [rad/s].
        effort: (n,) [N m].

    """

    def __init__(self, joints: JointParameters, count: int):
        self._servo = Servo.of(joints)
        self._step = Step(NUMPY, self._servo, STEP)
        self.position, self.velocity, self.effort = np.zeros((3, count))
        self._time = None

    def advance(self, now: float, goals: np.ndarray, powered: np.ndarray):
        """Move until ``now`` [s] towards ``goals`` [rad]; without power a servo stays put."""
        if self._time is None or now - self._time > 1.0:
            self._time = now
        while self._time + STEP <= now:
            self._time += STEP
            moved = self._step(goals, self.position, np.where(powered, self.velocity, 0.0))
            self.position, self.velocity = np.where(
                powered, moved, [self.position, np.zeros_like(self.velocity)])
            self.effort = np.where(powered, self._servo.motor(
                NUMPY, goals - self.position, self.velocity), 0.0)


@dataclass
class ServoFaults:
    """
    Faults of the bus; set and reset them at any time.

    Attributes:
        bad_crc: share of answers with a flipped bit.
        dropped: share of answers that are lost.
        delayed: share of answers that come ``delay`` [s] late.
        silent: IDs that neither hear nor answer.
        overload: IDs with a lasting overload: they shut down, again after each reboot.
        overheated: IDs above their temperature limit.
        supply_voltage: [V] instead of 12.

    """

    bad_crc: float = 0.0
    dropped: float = 0.0
    delayed: float = 0.0
    delay: float = 0.02
    silent: set[int] = field(default_factory=set)
    overload: set[int] = field(default_factory=set)
    overheated: set[int] = field(default_factory=set)
    supply_voltage: float | None = None


class EmulatedServoBus:
    """
    XC330 servos on one serial port; use as a context manager.

    A plant moves them: it reads :attr:`goals` and :attr:`torque_enabled` and calls
    :meth:`set_state`. With ``motion`` they move by themselves.

    Args:
        identifiers: IDs in the order of the joints.
        port: path of the port to make; a temporary one by default.
        firmware: version that the servos report; below 46 without fast sync read.
        baud_rate: that the servos are set to [bit/s].
        signs: +1 or -1 for each servo: sense of its counts against the joint's angle.
        zeros: counts at which each joint's angle is zero.
        motion: servo model to move by, or None.
        timing: whether answers take the time of the wire and the return delay.
        reboot_time: silence after a reboot [s].
        seed: of the faults.

    """

    def __init__(self, identifiers: Sequence[int] = (1, 2, 3, 4), *, port: str | None = None,
                 firmware: int = table.FIRMWARE, baud_rate: int = 1_000_000,
                 signs: Sequence[int] | None = None, zeros: Sequence[int] | None = None,
                 motion: JointParameters | None = None, timing: bool = False,
                 reboot_time: float = 0.3, seed: int = 0):
        count = len(identifiers)
        self.faults = ServoFaults()
        self.network = ServoNetwork([
            EmulatedServo(name, firmware=firmware, baud_rate=baud_rate, sign=int(sign),
                          zero=int(zero), reboot_time=reboot_time)
            for name, sign, zero in zip(identifiers, signs or [1] * count,
                                        zeros or [table.ZERO] * count, strict=True)])
        self.timing = timing
        self._motion = SecondOrderMotion(motion, count) if motion else None
        self._terminal = PseudoTerminal(port, 'servo_bus')
        self._receiver = Receiver()
        self._random = Random(seed)
        self._late: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()
        self._lock = Lock()
        self._heard = self._watched = time.monotonic()
        self._running = True
        self._thread = Thread(target=self._run, name='emulated servo bus', daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    @property
    def port(self) -> str:
        """Path that a driver opens."""
        return self._terminal.port

    @property
    def servos(self) -> list[EmulatedServo]:
        """The servos, in the order of the joints."""
        return self.network.servos

    # --- the plant's side ---------------------------------------------------------------------

    def drive(self) -> tuple[list[float], list[bool], list[bool]]:
        """
        All that a plant needs to know, of one moment.

        Returns:
            what :attr:`goals`, :attr:`torque_enabled` and :attr:`stopped` tell.

        """
        with self._lock:
            # What has arrived counts, also where the thread had no turn on a busy computer.
            self._serve(time.monotonic())
            servos = self.servos
            return ([servo.goal for servo in servos], [servo.torque for servo in servos],
                    [servo.expired for servo in servos])

    @property
    def goals(self) -> np.ndarray:
        """(n,) joint angles that the servos drive to [rad]."""
        with self._lock:
            return np.array([servo.goal for servo in self.servos])

    @property
    def torque_enabled(self) -> np.ndarray:
        """(n,) bool: whether a servo's motor is powered; without power the joint is free."""
        with self._lock:
            return np.array([servo.torque for servo in self.servos])

    @property
    def stopped(self) -> np.ndarray:
        """(n,) bool: stopped by the bus watchdog, goals refused."""
        with self._lock:
            return np.array([servo.expired for servo in self.servos])

    def set_state(self, position: np.ndarray, velocity: np.ndarray, effort: np.ndarray):
        """Set the joints' true angles [rad], rates [rad/s] and torques [N m], each (n,)."""
        with self._lock:
            for servo, *state in zip(self.servos, position, velocity, effort, strict=True):
                servo.move(*state)
            if self._motion:
                self._motion.position = np.array(position, dtype=float)
                self._motion.velocity = np.array(velocity, dtype=float)

    # --- events -------------------------------------------------------------------------------

    def reboot(self, index: int):
        """Restart servo ``index`` as a brown-out does: torque off, turns forgotten."""
        with self._lock:
            self.servos[index].reboot(time.monotonic())

    def expire_watchdog(self, index: int):
        """Let the watchdog of servo ``index`` expire now."""
        with self._lock:
            if self.servos[index].torque:
                self.servos[index].expire()

    def unplug(self):
        """Pull the cable of the adapter; the servos keep their power."""
        with self._lock:
            self._terminal.unplug()
            self._forget()

    def replug(self):
        """Put the cable back."""
        with self._lock:
            if not self._terminal.plugged:
                self._terminal.plug()
                self._forget()

    def _forget(self):
        self._receiver.forget()
        self._late.clear()

    def close(self):
        """Stop the thread and remove the port."""
        if self._running:
            self._running = False
            self._terminal.interrupt()
            self._thread.join(2.0)
            self._terminal.close()

    # --- the thread ---------------------------------------------------------------------------

    def _run(self):
        while self._running:
            self._terminal.wait(self._patience())
            with self._lock:
                self._serve(time.monotonic())

    def _serve(self, now):
        """Do all that is due."""
        data = self._terminal.read()
        if data:
            if now - self._heard > PAUSE:
                self._receiver.forget()
            self._heard = now
            self._take(data, now)
        # After the data: a late thread must not take waiting packets for silence.
        if now - self._watched >= WATCH:
            self._watched = now
            self._watch(now)
        while self._late and self._late[0][0] <= now:
            self._terminal.write(heapq.heappop(self._late)[2])

    def _patience(self):
        if not self._late:
            return WATCH
        return min(WATCH, max(0.0, self._late[0][0] - time.monotonic()))

    def _watch(self, now):
        faults = self.faults
        self.network.silent = set(faults.silent)
        for servo in self.servos:
            name = servo['ID']
            servo.temperature = servo['Temperature Limit'] + 10 if name in faults.overheated \
                else None
            servo.voltage = faults.supply_voltage
            servo.advance(now)
            if name in faults.overload and servo.torque:
                servo.trip(table.OVERLOAD)
        self._move(now)

    def _move(self, now):
        if self._motion is None:
            return
        goals = np.array([servo.goal for servo in self.servos])
        powered = np.array([servo.torque for servo in self.servos])
        self._motion.advance(now, goals, powered)
        for servo, *state in zip(self.servos, self._motion.position, self._motion.velocity,
                                 self._motion.effort, strict=True):
            servo.move(*state)

    def _take(self, data, now):
        baud_rate = self._terminal.baud_rate
        for packet in self._receiver.feed(data):
            self.network.silent = set(self.faults.silent)
            self._move(now)
            arrived = now + (len(packet.parameters) + 10) * BITS_PER_BYTE / max(baud_rate, 1)
            for reply in self.network.handle(packet, baud_rate, now):
                arrived += reply.delay + len(reply.data) * BITS_PER_BYTE / max(baud_rate, 1)
                self._answer(reply.data, arrived if self.timing else 0.0)

    def _answer(self, data, due):
        faults, draw = self.faults, self._random.random
        if draw() < faults.dropped:
            return
        if draw() < faults.bad_crc:
            place = self._random.randrange(len(data))
            data = data[:place] + bytes((data[place] ^ 1 << self._random.randrange(8),)) \
                + data[place + 1:]
        if draw() < faults.delayed:
            due = max(due, time.monotonic()) + faults.delay
        if due:
            heapq.heappush(self._late, (due, next(self._order), data))
        else:
            self._terminal.write(data)
