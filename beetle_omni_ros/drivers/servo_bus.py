"""The servo bus as the joint bridge uses it: goals out, angles in, nothing stalls."""

from __future__ import annotations

from collections.abc import Callable
import time

import numpy as np

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_guard import Guard
from beetle_omni_ros.drivers.servo_keeper import ServoKeeper
from beetle_omni_ros.drivers.servo_link import LinkStatistics, ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_port import PortLost
from beetle_omni_ros.drivers.servo_setup import (
    configure,
    examine,
    locate,
    power,
    ServoFinding,
)
from beetle_omni_ros.drivers.servo_state import (
    FEEDBACK,
    FEEDBACK_SIZE,
    make_servos,
    readings,
    ServoHealth,
    ServoReadings,
)
from beetle_omni_ros.drivers.servo_turns import certain_limit, settle
from beetle_omni_ros.robot.parameters import JointParameters


class ServoBus:
    """
    Four tilt servos. For one thread; between :meth:`open` and :meth:`close`.

    A loop of 200 Hz calls :meth:`write_goals`, :meth:`read` and :meth:`poll_health` in each tick.
    None of them raises when the cable is out or servos are silent: they say so in what they
    return, take at most one reply time together, and go on by themselves when things are back.

    Args:
        parameters: of the bus.
        joints: for the travel of the tilts.
        clock: stamps of readings [s].

    Attributes:
        parameters: may be replaced while torque is off.
        enabled: whether torque is wanted.
        clipped: goals beyond the travel that were cut off.
        rejected: goals that were no numbers.

    """

    def __init__(self, parameters: ServoBusParameters, joints: JointParameters,
                 clock: Callable[[], float] = time.time):
        self.parameters = parameters
        self.travel = joints.position_limit
        self.enabled = False
        self.clipped = self.rejected = 0
        self._clock = clock
        self._link = ServoLink(parameters.port, parameters.baud_rate, parameters.timing.reply)
        self._servos = make_servos(parameters)
        self._keeper = ServoKeeper(self._link, parameters, self._servos)
        self._guard: Guard | None = None

    # --- lifecycle ----------------------------------------------------------------------------

    def open(self):
        """
        Open the port.

        Raises:
            ServoBusError: it cannot be opened; one line with what helps.

        """
        try:
            self._link.open()
        except PortLost as error:
            raise ServoBusError(f'{self._link.where()}: {error}') from None

    def close(self):
        """Take the torque off and close the port; safe to call at any time, more than once."""
        self.disable()
        if self._guard is not None:
            self._guard.release()
            self._guard = None
        self._link.close()

    def check(self) -> list[ServoFinding]:
        """Look at each servo without changing anything."""
        try:
            with self._link.patient():
                return [examine(self._link, servo) for servo in self._servos]
        except PortLost as error:
            self._keeper.lost()
            return [ServoFinding(servo.name, servo.identifier, problem=f'{self._link.where()}: '
                                 f'{error}', remedy='plug the adapter in') for servo in
                    self._servos]

    def configure(self):
        """
        Take the torque off, make all settings ours and read the angles once.

        Raises:
            ServoBusError: one line that names each servo that is missing or wrong.

        """
        self._call(self.disable)
        self._link.fast = False
        self._link.fast = self._call(configure, self._link, self.parameters, self._servos)
        for servo in self._servos:
            servo.silent, servo.resting, servo.misses, servo.recoveries = False, False, 0, 0
            servo.torque, servo.error, servo.watchdog_expired = False, 0, False
        self._call(locate, self._link, self.parameters, self._servos)

    def enable(self):
        """
        Turn the torque on where the servos stand.

        Raises:
            ServoBusError: an angle is ambiguous, or a servo is silent or shut down; no servo has
                torque then.

        """
        self._call(locate, self._link, self.parameters, self._servos)
        confirmed = self.parameters.confirmed_tilts if self.parameters.confirm_tilts else None
        doubts = settle(self._servos, self.travel, confirmed)
        if doubts:
            raise ServoBusError(
                f'{self._link.where()}: no torque, the turn is lost: {doubts}; turn it by hand '
                f'to within +-{certain_limit(self.travel):.2f} rad, or look where it is and set '
                'confirmed_tilts and confirm_tilts')
        try:
            if self.parameters.guard and self._guard is None:
                packet = self._link.packet_of_sync_write(
                    registers.TORQUE_ENABLE, {servo.identifier: 0 for servo in self._servos})
                self._guard = Guard(self.parameters.port, self.parameters.baud_rate, packet)
            for servo in self._servos:
                self._call(power, self._link, self.parameters, servo)
                self._keeper.spoke()
        except ServoBusError:
            self.enabled = True
            self.disable()
            raise
        self.enabled = True

    def disable(self) -> bool:
        """
        Take the torque off all servos.

        Returns:
            whether every servo has confirmed it.

        """
        was_enabled, self.enabled = self.enabled, False
        self._keeper.drop_recoveries()
        if not self._link.is_open:
            return not was_enabled
        try:
            with self._link.patient():
                confirmed = self._cut()
        except PortLost as error:
            self._keeper.lost(error)
            return False
        if self._guard is not None and confirmed:
            self._guard.dismiss()
            self._guard = None
        return confirmed

    def reboot(self, identifier: int):
        """
        Restart a servo; :meth:`poll_health` carries it out, step by step, in some 0.5 s.

        Raises:
            ServoBusError: no servo has this ID.

        """
        for servo in self._servos:
            if servo.identifier == identifier:
                self._keeper.recover(servo, forced=True)
                return
        raise ServoBusError(f'{self._link.where(identifier)}: no such servo; ids are '
                            f'{[servo.identifier for servo in self._servos]}')

    # --- the loop -----------------------------------------------------------------------------

    def write_goals(self, tilt: np.ndarray) -> bool:
        """
        Send tilt targets to all servos with one packet.

        Args:
            tilt: (4,) [rad]; beyond the travel they are cut off.

        Returns:
            whether the packet went out; False without torque, port, or numbers.

        """
        tilt = np.asarray(tilt, dtype=float)
        if tilt.shape != (len(self._servos),) or not np.all(np.isfinite(tilt)):
            self.rejected += 1
            return False
        if not self.enabled or not self._link.is_open:
            return False
        legal = np.clip(tilt, -self.travel, self.travel)
        self.clipped += int(np.any(legal != tilt))
        try:
            self._keeper.feed_watchdog()
            sent = self._link.sync_write(registers.GOAL_POSITION, {
                servo.identifier: servo.counts(angle)
                for servo, angle in zip(self._servos, legal, strict=True)})
        except PortLost as error:
            self._keeper.lost(error)
            return False
        self._keeper.spoke()
        return sent

    def read(self) -> ServoReadings:
        """Read current, velocity and position of all servos that are not known to be silent."""
        stamp = self._clock()
        asked = sorted((servo for servo in self._servos if not servo.silent),
                       key=lambda servo: servo.misses)
        answers = {}
        if self._link.is_open and asked:
            try:
                answers = self._link.sync_read(FEEDBACK, FEEDBACK_SIZE,
                                               [servo.identifier for servo in asked])
                self._keeper.spoke()
            except PortLost as error:
                self._keeper.lost(error)
        if self._link.is_open:
            answered = self._keeper.take(asked, answers, self.enabled)
        else:
            answered = set()
            self._keeper.reconnect(self.enabled)
        return readings(self._servos, stamp, answered, self.parameters.torque_per_current)

    def upkeep(self):
        """
        Do at most one transaction beside goals and feedback.

        That is: a step in bringing a servo back, a look for a silent one, or reading torque,
        hardware error, watchdog, voltage and temperature of all.
        """
        try:
            self._keeper.step(self.enabled)
        except PortLost as error:
            self._keeper.lost(error)

    def health(self) -> list[ServoHealth]:
        """What is known about each servo, without a transaction."""
        return self._keeper.report(self.enabled)

    def poll_health(self) -> list[ServoHealth]:
        """Do :meth:`upkeep`, then report the :meth:`health`."""
        self.upkeep()
        return self.health()

    @property
    def obeying(self) -> np.ndarray:
        """(4,) bool: connected, answering, and with torque, as far as known."""
        return np.array([self._link.is_open and not servo.silent and servo.torque is True
                         for servo in self._servos])

    def take_events(self) -> list[str]:
        """Lines for the log since the last call."""
        return self._keeper.take_events()

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._link.is_open

    @property
    def statistics(self) -> LinkStatistics:
        """Transactions, missing and corrupt answers, refusals, connections."""
        return self._link.statistics

    # --- inside -------------------------------------------------------------------------------

    def _cut(self):
        """Take the torque off: all at once, then each with its confirmation."""
        self._link.sync_write(registers.TORQUE_ENABLE,
                              {servo.identifier: 0 for servo in self._servos})
        confirmed = True
        for servo in self._servos:
            try:
                self._link.write(servo.identifier, registers.TORQUE_ENABLE, 0)
                servo.torque = False
            except ServoBusError as error:
                confirmed = False
                self._keeper.say(f'torque off is not confirmed: {error}')
        return confirmed

    def _call(self, function, *arguments):
        try:
            with self._link.patient():
                return function(*arguments)
        except PortLost as error:
            self._keeper.lost(error)
            raise ServoBusError(f'{self._link.where()}: {error}') from None
