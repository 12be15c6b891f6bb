"""Driver of the servo bus for the joint bridge: tilt goals, feedback, health."""

from collections.abc import Callable
import time

import numpy as np

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_guard import Guard
from beetle_omni_ros.drivers.servo_link import LinkStatistics, ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_port import PortLost
from beetle_omni_ros.drivers.servo_setup import (
    configure,
    enable_torque,
    examine,
    locate,
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
from beetle_omni_ros.drivers.servo_turns import settle, unambiguous_limit
from beetle_omni_ros.drivers.servo_upkeep import ServoUpkeep
from beetle_omni_ros.robot.parameters import JointParameters


class ServoBus:
    """
    Four tilt servos. Only one thread may use it, between :meth:`open` and :meth:`close`.

    A loop of 200 Hz calls :meth:`write_goals`, :meth:`read` and :meth:`poll_health` in each tick.
    If the cable is unplugged or servos are silent, they raise nothing and report it in their
    results. Together they then take at most one reply time. They recover without further calls.

    Args:
        joints: joint parameters, for the travel of the tilts.
        clock: clock of the stamps of readings [s].

    Attributes:
        parameters: may be replaced while torque is off.
        enabled: whether the servos should have torque.
        clipped: number of goals limited to the travel.
        rejected: number of goals that are not four finite numbers.

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
        self._upkeep = ServoUpkeep(self._link, parameters, self._servos)
        self._guard: Guard | None = None

    # --- lifecycle ----------------------------------------------------------------------------

    def open(self):
        """
        Open the port.

        Raises:
            ServoBusError: it cannot be opened.

        """
        try:
            self._link.open()
        except PortLost as error:
            raise ServoBusError(f'{self._link.where()}: {error}') from None

    def close(self):
        """Switch the torque off and close the port; may be called at any time, repeatedly."""
        self.disable()
        if self._guard is not None:
            self._guard.trigger()
            self._guard = None
        self._link.close()

    def check(self) -> list[ServoFinding]:
        """Examine each servo without changing anything."""
        try:
            with self._link.patient():
                return [examine(self._link, servo) for servo in self._servos]
        except PortLost as error:
            self._upkeep.port_lost()
            return [ServoFinding(servo.name, servo.identifier, problem=f'{self._link.where()}: '
                                 f'{error}', remedy='plug the adapter in') for servo in
                    self._servos]

    def configure(self):
        """
        Switch the torque off, write all settings and read the angles.

        Raises:
            ServoBusError: servos are missing or wrong; the message names all of them.

        """
        self._call(self.disable)
        self._link.fast = False
        self._link.fast = self._call(configure, self._link, self.parameters, self._servos)
        for servo in self._servos:
            servo.silent, servo.kept_off, servo.misses, servo.recoveries = False, False, 0, 0
            servo.torque, servo.error, servo.watchdog_expired = False, 0, False
        self._call(locate, self._link, self.parameters, self._servos)

    def enable(self):
        """
        Switch the torque on with the present angles as goals.

        Raises:
            ServoBusError: an angle is ambiguous, or a servo is silent or shut down. No servo has
                torque then.

        """
        self._call(locate, self._link, self.parameters, self._servos)
        confirmed = self.parameters.confirmed_tilts if self.parameters.confirm_tilts else None
        doubts = settle(self._servos, self.travel, confirmed)
        if doubts:
            raise ServoBusError(
                f'{self._link.where()}: no torque, the turn is lost: {doubts}; turn it by hand '
                f'to within +-{unambiguous_limit(self.travel):.2f} rad, or measure it and set '
                'confirmed_tilts and confirm_tilts')
        try:
            if self.parameters.guard and self._guard is None:
                packet = self._link.packet_of_sync_write(
                    registers.TORQUE_ENABLE, {servo.identifier: 0 for servo in self._servos})
                self._guard = Guard(self.parameters.port, self.parameters.baud_rate, packet)
            for servo in self._servos:
                self._call(enable_torque, self._link, self.parameters, servo)
                self._upkeep.packet_sent()
        except ServoBusError:
            self.enabled = True
            self.disable()
            raise
        self.enabled = True

    def disable(self) -> bool:
        """
        Switch the torque of all servos off.

        Returns:
            whether every servo has confirmed it.

        """
        was_enabled, self.enabled = self.enabled, False
        self._upkeep.drop_recoveries()
        if not self._link.is_open:
            return not was_enabled
        try:
            with self._link.patient():
                confirmed = self._torque_off()
        except PortLost as error:
            self._upkeep.port_lost(error)
            return False
        if self._guard is not None and confirmed:
            self._guard.dismiss()
            self._guard = None
        return confirmed

    def reboot(self, identifier: int):
        """
        Start the restart of a servo; calls of :meth:`poll_health` finish it in about 0.5 s.

        Raises:
            ServoBusError: no servo has this ID.

        """
        for servo in self._servos:
            if servo.identifier == identifier:
                self._upkeep.recover(servo, forced=True)
                return
        raise ServoBusError(f'{self._link.where(identifier)}: no such servo; ids are '
                            f'{[servo.identifier for servo in self._servos]}')

    # --- the loop -----------------------------------------------------------------------------

    def write_goals(self, tilt: np.ndarray) -> bool:
        """
        Send tilt targets to all servos with one packet.

        Args:
            tilt: (4,) tilt targets [rad], limited to the travel.

        Returns:
            whether the packet was sent; False without torque, port or finite numbers.

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
            self._upkeep.feed_watchdog()
            sent = self._link.sync_write(registers.GOAL_POSITION, {
                servo.identifier: servo.counts(angle)
                for servo, angle in zip(self._servos, legal, strict=True)})
        except PortLost as error:
            self._upkeep.port_lost(error)
            return False
        self._upkeep.packet_sent()
        return sent

    def read(self) -> ServoReadings:
        """Read current, velocity and position of all servos except silent ones."""
        stamp = self._clock()
        asked = sorted((servo for servo in self._servos if not servo.silent),
                       key=lambda servo: servo.misses)
        answers = {}
        if self._link.is_open and asked:
            try:
                answers = self._link.sync_read(FEEDBACK, FEEDBACK_SIZE,
                                               [servo.identifier for servo in asked])
                self._upkeep.packet_sent()
            except PortLost as error:
                self._upkeep.port_lost(error)
        if self._link.is_open:
            answered = self._upkeep.handle_feedback(asked, answers, self.enabled)
        else:
            answered = set()
            self._upkeep.reconnect(self.enabled)
        return readings(self._servos, stamp, answered, self.parameters.torque_per_current)

    def upkeep(self):
        """
        Do at most one transaction besides goals and feedback.

        It is a step of a servo's recovery, a ping of a silent servo, or a read of torque, hardware
        error, watchdog, voltage and temperature of all servos.
        """
        try:
            self._upkeep.step(self.enabled)
        except PortLost as error:
            self._upkeep.port_lost(error)

    def health(self) -> list[ServoHealth]:
        """Last known health of each servo, without a transaction."""
        return self._upkeep.report(self.enabled)

    def poll_health(self) -> list[ServoHealth]:
        """Do :meth:`upkeep` and return :meth:`health`."""
        self.upkeep()
        return self.health()

    @property
    def obeying(self) -> np.ndarray:
        """(4,) bool: whether a servo is connected, answers and has torque, as last known."""
        return np.array([self._link.is_open and not servo.silent and servo.torque is True
                         for servo in self._servos])

    def take_events(self) -> list[str]:
        """Return the lines for the log since the last call."""
        return self._upkeep.take_events()

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._link.is_open

    @property
    def statistics(self) -> LinkStatistics:
        """Counts of the link."""
        return self._link.statistics

    # --- inside -------------------------------------------------------------------------------

    def _torque_off(self):
        """Switch the torque off by one packet, then for each servo with confirmation."""
        self._link.sync_write(registers.TORQUE_ENABLE,
                              {servo.identifier: 0 for servo in self._servos})
        confirmed = True
        for servo in self._servos:
            try:
                self._link.write(servo.identifier, registers.TORQUE_ENABLE, 0)
                servo.torque = False
            except ServoBusError as error:
                confirmed = False
                self._upkeep.log(f'torque off is not confirmed: {error}')
        return confirmed

    def _call(self, function, *arguments):
        try:
            with self._link.patient():
                return function(*arguments)
        except PortLost as error:
            self._upkeep.port_lost(error)
            raise ServoBusError(f'{self._link.where()}: {error}') from None
