"""Driver of the servo bus for the joint bridge: settings, torque, goals, feedback, recovery."""

from collections import deque
from collections.abc import Callable
from itertools import cycle
from subprocess import Popen
import time

import numpy as np

from beetle_omni_ros.drivers import servo_guard
from beetle_omni_ros.drivers import servo_xc330 as xc330
from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.drivers.servo_link import ServoLink
from beetle_omni_ros.drivers.servo_xc330 import nearest_turns, ServoBusError
from beetle_omni_ros.model.parts import JointParameters
from beetle_omni_ros.model.readings import JointReading

WATCHDOG_MARGIN = 0.8   # a pause above this share of the watchdog's time may have expired it
REPEAT_AFTER = 1.0      # [s] until an equal line is logged again
PING_PERIOD = 0.02      # [s]
PROBE = 0.1             # [s] between two pings of a silent servo
HEALTH_PERIOD = 0.1     # [s] in which all health registers are read once
RECONNECT = 0.2         # [s] between attempts to open a lost port
DONE = object()         # end of a recovery
RECOVERIES = 3          # restarts of a servo after overloads; then it stays off


class ServoBus:
    """
    Four tilt servos. Only one thread may use it, between :meth:`open` and :meth:`close`.

    A loop of 200 Hz calls :meth:`write_goals`, :meth:`read` and :meth:`upkeep` in each tick. If
    the cable is unplugged or servos are silent, they raise nothing and report it in their
    results. Together they then take at most one reply time. They recover without further calls.

    ``clock`` gives the stamps of readings [s]. ``enabled`` is whether the servos should have
    torque, ``stamp`` the time of the last request for feedback.
    """

    def __init__(self, parameters: ServoBusParameters, joints: JointParameters,
                 clock: Callable[[], float] = time.time):
        self.parameters, self.travel = parameters, joints.position_limit
        self.servos = xc330.make_servos(parameters)
        self.enabled, self._clock, self.stamp = False, clock, 0.0
        self.link = ServoLink(parameters.port, parameters.baud_rate, parameters.reply_time)
        self._guard: Popen | None = None
        self._torque_off = xc330.TORQUE_ENABLE, {one.identifier: 0 for one in self.servos}
        self._next_health = self._next_open = 0.0
        self._health = cycle(xc330.HEALTH)
        self._events: deque[str] = deque(maxlen=200)    # lines for the log
        self._logged: dict[str, float] = {}

    def open(self):
        """Open the port; raises SerialPortError, as the next two methods if it is lost."""
        self.link.open()

    def close(self):
        """Switch the torque off and close the port; may be called at any time, repeatedly."""
        self.disable()
        if self._guard is not None:
            self._guard.stdin.close()   # no servo has confirmed it: the guard switches it off
            self._guard = None
        self.link.close()

    def configure(self):
        """
        Switch the torque off, write all settings, EEPROM only where it differs, read the angles.

        ServoBusError names all servos that are missing or wrong, or refuse a setting.
        """
        self.disable()
        problems = []
        for servo in self.servos:
            _, firmware, problem, remedy = xc330.examine(self.link, servo)
            if problem:
                problems.append(f'{servo.name} (id {servo.identifier}): {problem}; {remedy}')
                continue
            try:
                xc330.configure(self.link, servo, self.parameters, firmware)
            except ServoBusError as error:
                problems.append(f'{servo.name}: {error}')
        if problems:
            raise ServoBusError(f'{self.link.path}: ' + ' | '.join(problems))
        for servo in self.servos:
            servo.kept_off, servo.misses, servo.recoveries = False, 0, 0
            servo.torque, servo.error = False, 0
        xc330.locate(self.link, self.servos, self.parameters)

    def enable(self):
        """
        Switch the torque on with the present angles as goals.

        ServoBusError: an angle is ambiguous, or a servo failed; then none has torque.
        """
        xc330.locate(self.link, self.servos, self.parameters)
        if doubts := xc330.settle(self.servos, self.travel):
            limit = xc330.unambiguous_limit(self.travel)
            raise ServoBusError(
                f'{self.link.path}: no torque, the turn is lost: {doubts}; turn it by hand to '
                f'within +-{limit:.2f} rad, cables untwisted')
        if self.parameters.guard and self._guard is None:
            self._guard = servo_guard.start(self.link.path, self.link.baud_rate,
                                            self.link.packet_of_sync_write(*self._torque_off))
        self.enabled = True
        try:
            for servo in self.servos:
                for register, value in ((xc330.WATCHDOG, 0), *xc330.power_on(
                        servo.counts(servo.position))):
                    self.link.write(servo.identifier, register, value)
                servo.torque = True
        except (ServoBusError, SerialPortError):
            self.disable()
            raise

    def disable(self) -> bool:
        """Switch the torque of all servos off; return whether every servo has confirmed it."""
        was_enabled = self.enabled
        self.enabled = False
        for servo in self.servos:
            servo.recovery = None
        if not self.link.is_open:
            return not was_enabled
        confirmed = True
        try:
            self.link.sync_write(*self._torque_off)
            for servo in self.servos:
                try:
                    self.link.write(servo.identifier, xc330.TORQUE_ENABLE, 0)
                    servo.torque = False
                except ServoBusError as error:
                    confirmed = False
                    self.log(f'torque off is not confirmed: {error}')
        except SerialPortError as error:
            self._port_lost(error)
            return False
        if self._guard is not None and confirmed:
            servo_guard.dismiss(self._guard)
            self._guard = None
        return confirmed

    def reboot(self, index: int):
        """Start the restart of a servo; calls of :meth:`upkeep` finish it in about 0.5 s."""
        servo = self.servos[index]
        servo.recoveries, servo.kept_off = 0, False     # a missing answer does not end it
        self._recover(servo, forced=True)

    def write_goals(self, tilt: np.ndarray) -> bool:
        """
        Send tilt targets (4,) [rad], limited to the travel, to all servos with one packet.

        Return whether it was sent; False without torque or port.
        """
        if not self.enabled or not self.link.is_open:
            return False
        legal = np.clip(tilt, -self.travel, self.travel)
        try:
            self._feed_watchdog()
            return self.link.sync_write(xc330.GOAL_POSITION, {
                servo.identifier: servo.counts(angle)
                for servo, angle in zip(self.servos, legal, strict=True)})
        except SerialPortError as error:
            self._port_lost(error)
            return False

    def read(self) -> np.ndarray:
        """Read current, velocity and position of all servos except silent ones; return whose."""
        self.stamp, now, answered = self._clock(), time.monotonic(), []
        if not self.link.is_open:
            self._reconnect()
        else:
            asked = sorted((servo for servo in self.servos if not servo.silent),
                           key=lambda servo: servo.misses)
            try:
                for servo, data in self._sync_read(asked, *xc330.FEEDBACK):
                    answered.append(servo)
                    if servo.update(data, now, self.enabled):
                        servo.turns_known &= self.enabled
                        if servo.recovery is None:
                            self.log(f'{servo.where}: lost its turn count, taken as '
                                     f'{servo.position:+.2f} rad')
                            self._recover(servo)
                # Only the first without answer missed: those behind it cannot answer.
                for missing in [servo for servo in asked if servo not in answered][:1]:
                    self._count_miss(missing)
            except SerialPortError as error:
                self._port_lost(error)
        return np.array([servo in answered for servo in self.servos])

    def reading(self, which: np.ndarray) -> JointReading:
        """Last feedback of the servos ``which`` (4,) bool, NaN if there is none; unwrapped."""
        return xc330.reading([servo for servo, is_chosen in zip(self.servos, which) if is_chosen],
                             self.stamp)

    def upkeep(self):
        """
        Do at most one transaction besides goals and feedback; none after a timeout in this tick.

        It is a step of a servo's recovery, a ping of a silent servo, or a read of torque,
        watchdog, voltage and temperature of all servos.
        """
        if not self.link.is_open:
            return
        now = time.monotonic()
        try:
            if self.link.late:
                self.link.late = False
            elif recovering := [servo for servo in self.servos if servo.recovery]:
                self._recover_step(recovering[0])
            elif any(servo.silent and now >= servo.next_probe for servo in self.servos):
                self._probe(now)
            elif now >= self._next_health:
                self._next_health = now + HEALTH_PERIOD / len(xc330.HEALTH)
                self._read_health()
        except SerialPortError as error:
            self._port_lost(error)

    @property
    def obeying(self) -> np.ndarray:
        """(4,) bool: whether a servo is connected, answers and has torque, as last known."""
        return np.array([self.link.is_open and not servo.silent and servo.torque is True
                         for servo in self.servos])

    def take_events(self) -> list[str]:
        """Return the lines for the log since the last call, which may come from any thread."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def log(self, line):
        """Add a line to the log, unless an equal one was added within a second."""
        now = time.monotonic()
        if now - self._logged.get(line, -REPEAT_AFTER) >= REPEAT_AFTER:
            self._logged[line] = now
            self._events.append(line)

    def _port_lost(self, error):
        """Close the failed port; :meth:`_reconnect` opens it again."""
        if self.link.is_open:
            self.log(f'{error}; trying again every {RECONNECT:g} s')
        self.link.close()
        for servo in self.servos:
            servo.recovery = None
        self._next_open = time.monotonic() + RECONNECT

    def _reconnect(self):
        """Open the port again if it is time, and restore the torque state of the servos."""
        if time.monotonic() < self._next_open:
            return
        self._next_open = time.monotonic() + RECONNECT
        try:
            self.link.open()
            self.log(f'{self.link.path}: connected again')
            if self.enabled:
                # Their watchdogs have stopped them, and they may have restarted.
                self._feed_watchdog()
                for servo in self.servos:
                    self._recover(servo)
            else:
                self.link.sync_write(*self._torque_off)
        except SerialPortError:
            self.link.close()

    def _feed_watchdog(self):
        """Clear the watchdogs after a pause, because expired ones refuse goals without answer."""
        pause = time.monotonic() - self.link.last_sent
        if pause > WATCHDOG_MARGIN * xc330.WATCHDOG_TIME:
            self._restart_watchdog(self.servos)

    def _restart_watchdog(self, servos):
        for counts in (0, xc330.WATCHDOG_COUNTS):
            self.link.sync_write(xc330.WATCHDOG, {servo.identifier: counts for servo in servos})

    def _sync_read(self, asked, address, length):
        """Pairs of the servos with a valid answer and their data."""
        answers = self.link.sync_read(address, length, [servo.identifier for servo in asked]) \
            if asked else {}
        found = []
        for servo in asked:
            if servo.identifier not in answers:
                continue
            error, data = answers[servo.identifier]
            if not error & xc330.ALERT:
                servo.error = 0
            elif not servo.error and servo.recovery is None:
                servo.kept_off = False
                self._recover(servo)    # its recovery reads the hardware error
            if not error & ~xc330.ALERT:
                found.append((servo, data))
        return found

    def _count_miss(self, servo):
        """Count a missing answer; after several in a row the servo is silent and only pinged."""
        servo.misses += 1
        if servo.misses == xc330.SILENT_AFTER:
            servo.torque = None
            servo.next_probe = time.monotonic() + PROBE
            self.log(f'{servo.where}: silent; check its cable and power')

    def _probe(self, now):
        servo = min((servo for servo in self.servos if servo.silent),
                    key=lambda servo: servo.next_probe)
        try:
            self.link.ping(servo.identifier)
        except ServoBusError:
            if self.link.late:      # otherwise it answers, with an error
                self.link.late = False
                servo.next_probe = now + (PING_PERIOD if servo.restarting else PROBE)
                return
        if not servo.restarting:
            self.log(f'{servo.where}: answers again')
            for other in self.servos:
                other.next_probe = now  # the cause may have been the bus
        servo.misses, servo.boot_ends = 0, 0.0
        self._recover(servo)

    def _read_health(self):
        register, length = next(self._health)
        asked = [servo for servo in self.servos if not servo.silent]
        for servo, data in self._sync_read(asked, register.address, length):
            if register is xc330.TORQUE_ENABLE:
                servo.torque = bool(data[0])
                if self.enabled and not servo.torque and not servo.kept_off:
                    self._recover(servo)
                elif servo.torque and not self.enabled:
                    # It did not answer when the torque was switched off.
                    self.link.sync_write(register, {servo.identifier: 0})
                    self.log(f'{servo.where}: still had torque, switched off')
            elif register is xc330.WATCHDOG:
                if data[0] == xc330.WATCHDOG_EXPIRED and self.enabled:
                    self.log(f'{servo.where}: was stopped by its watchdog, continues')
                    self._restart_watchdog([servo])
            else:
                servo.voltage = int.from_bytes(data[:2], 'little') * xc330.VOLTAGE_UNIT
                servo.temperature = float(data[2])

    def _recover(self, servo, forced=False):
        """Start the recovery of a servo; with ``forced``, restart it in any case."""
        if forced or servo.recovery is None:
            servo.torque = None     # unknown until it is read
            servo.recovery = self._recovery(servo, forced)

    def _recover_step(self, servo):
        try:
            if next(servo.recovery, DONE) is not DONE:
                return
        except ServoBusError as error:
            self.log(f'{servo.name}: {error}')
            if self.link.late:
                self._count_miss(servo)
        servo.recovery = None

    def _recovery(self, servo, forced):
        """Read the state of a servo and recover it; yields after each transaction."""
        # A restarted servo has lost gains, watchdog, torque and turn count. At the end it has
        # torque if the bus is enabled. With ``forced``, and after a shutdown, it is restarted; the
        # ping that it answers starts another recovery. So does a missing answer, as long as the
        # servo is not kept off.
        link, identifier = self.link, servo.identifier
        if not forced:
            servo.error = link.read(identifier, xc330.HARDWARE_ERROR)
            yield
            servo.torque = bool(link.read(identifier, xc330.TORQUE_ENABLE))
            yield
            if servo.torque:
                return
        if forced or servo.error:
            if not forced and not (self.enabled and servo.recoveries < RECOVERIES
                                   and not servo.error & xc330.OVERHEATING):
                self.log(f'{servo.where}: shut down ({", ".join(servo.errors)}); it stays off '
                         'until it is rebooted')
                servo.kept_off = True
                return
            servo.recoveries += 1
            self.log(f'{servo.where}: restarting it')
            link.reboot(identifier)
            servo.restarted()
            return
        for register, value in xc330.volatile_settings(self.parameters):
            link.write(identifier, register, value, attempts=1)
            yield
        counts = link.read(identifier, xc330.PRESENT_POSITION)
        servo.turns = nearest_turns(servo.angle(counts), servo.position)
        yield
        servo.kept_off = False
        if not self.enabled:
            servo.turns_known = False
            self.log(f'{servo.where}: is back, without torque')
            return
        # The goals of the running loop also use the new turn count.
        for register, value in xc330.power_on(counts):
            yield
            link.write(identifier, register, value, attempts=1)
        servo.torque = True
        self.log(f'{servo.where}: had restarted, is back at {servo.position:+.2f} rad')
