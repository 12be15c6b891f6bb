"""The emulated servo bus: servos and faults on a pseudo-terminal."""

from collections.abc import Sequence
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
from beetle_omni_ros.sim.emulated.fault_switches import ServoFaults
from beetle_omni_ros.sim.emulated.pseudo_terminal import PseudoTerminal
from beetle_omni_ros.sim.emulated.servo import EmulatedServo
from beetle_omni_ros.sim.emulated.servo_network import ServoNetwork

STEP = 0.001        # [s] of the motion, small against the servo's natural frequency of 11 Hz
CHECK_PERIOD = 0.01 # [s] between checks of watchdog, temperature and voltage
PAUSE = 0.05        # [s] silence after which an incomplete packet is dropped
BITS_PER_BYTE = 10  # start, eight data, stop


class SecondOrderMotion:
    """
    Motion of ``count`` servos without load.

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
        """Advance to ``now`` [s] with ``goals`` [rad]; a servo without power does not move."""
        if self._time is None or now - self._time > 1.0:
            self._time = now
        while self._time + STEP <= now:
            self._time += STEP
            moved = self._step(goals, self.position, np.where(powered, self.velocity, 0.0))
            self.position, self.velocity = np.where(
                powered, moved, [self.position, np.zeros_like(self.velocity)])
            self.effort = np.where(powered, self._servo.motor(
                NUMPY, goals - self.position, self.velocity), 0.0)


class EmulatedServoBus:
    """
    XC330 servos on one serial port, as a context manager.

    A plant reads :meth:`drive` and calls :meth:`set_state`. With ``motion`` the servos move
    without a plant.

    Args:
        identifiers: IDs in the order of the joints.
        port: path of the created port; by default a temporary one.
        firmware: firmware version of the servos; below 46 without fast sync read.
        baud_rate: baud rate of the servos [bit/s].
        signs: +1 or -1 for each servo: counts rise or fall with the joint's angle.
        zeros: counts at which the angle of each joint is zero.
        motion: parameters of the servo model, or None for servos moved by a plant.
        timing: whether answers take the time on the wire and the return delay.
        reboot_time: time without answers after a reboot [s].
        seed: seed of the faults.

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
        self._last_data = self._last_check = time.monotonic()
        self._running = True
        self._thread = Thread(target=self._run, name='emulated servo bus', daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    @property
    def port(self) -> str:
        """Path of the serial port."""
        return self._terminal.port

    @property
    def servos(self) -> list[EmulatedServo]:
        """The servos, in the order of the joints."""
        return self.network.servos

    # --- the plant's side ---------------------------------------------------------------------

    def drive(self) -> tuple[list[float], list[bool], list[bool]]:
        """
        Inputs of a plant at one time.

        Returns:
            values of :attr:`goals`, :attr:`torque_enabled` and :attr:`stopped`.

        """
        with self._lock:
            # Handle received bytes, because the thread may not have been scheduled.
            self._serve(time.monotonic())
            servos = self.servos
            return ([servo.goal for servo in servos], [servo.torque for servo in servos],
                    [servo.expired for servo in servos])

    @property
    def goals(self) -> np.ndarray:
        """(n,) goal angles of the joints [rad]."""
        with self._lock:
            return np.array([servo.goal for servo in self.servos])

    @property
    def torque_enabled(self) -> np.ndarray:
        """(n,) bool: whether a motor is powered; without power the joint is free."""
        with self._lock:
            return np.array([servo.torque for servo in self.servos])

    @property
    def stopped(self) -> np.ndarray:
        """(n,) bool: whether the bus watchdog has stopped a servo, which then refuses goals."""
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
        """Restart servo ``index`` as a brown-out does: torque off, turn count lost."""
        with self._lock:
            self.servos[index].reboot(time.monotonic())

    def expire_watchdog(self, index: int):
        """Expire the watchdog of servo ``index``."""
        with self._lock:
            if self.servos[index].torque:
                self.servos[index].expire()

    def unplug(self):
        """Unplug the adapter; the servos keep their power."""
        with self._lock:
            self._terminal.unplug()
            self._forget()

    def replug(self):
        """Plug the adapter in."""
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
            self._terminal.wait(self._wait_time())
            with self._lock:
                self._serve(time.monotonic())

    def _serve(self, now):
        """Handle received packets, check the servos, send due answers."""
        data = self._terminal.read()
        if data:
            if now - self._last_data > PAUSE:
                self._receiver.forget()
            self._last_data = now
            self._take(data, now)
        # After the data, so that waiting packets restart the watchdogs of a late thread.
        if now - self._last_check >= CHECK_PERIOD:
            self._last_check = now
            self._check_servos(now)
        while self._late and self._late[0][0] <= now:
            self._terminal.write(heapq.heappop(self._late)[2])

    def _wait_time(self):
        if not self._late:
            return CHECK_PERIOD
        return min(CHECK_PERIOD, max(0.0, self._late[0][0] - time.monotonic()))

    def _check_servos(self, now):
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
