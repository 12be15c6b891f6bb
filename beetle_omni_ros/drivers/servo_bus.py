"""Driver of the servo bus for the joint bridge: settings, torque, goals, feedback, recovery."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import struct
from subprocess import Popen
import time

import numpy as np

from beetle_omni_ros.drivers import servo_guard
from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.drivers.serial_port import SerialPortError
from beetle_omni_ros.drivers.servo_link import ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_registers import nearest_turns, TURN
from beetle_omni_ros.model.parameters import JOINT_NAMES
from beetle_omni_ros.model.parts import JointParameters
from beetle_omni_ros.model.readings import JointReading

# Current, velocity and position have consecutive addresses.
FEEDBACK, FEEDBACK_LAYOUT = registers.PRESENT_CURRENT.address, struct.Struct('<hii')
# First register and number of bytes, read in turn from all servos at once. A range has no gap,
# because a servo may refuse undefined addresses. All lengths differ, because an answer does not
# contain its address, and a late answer must not be mistaken for another register.
HEALTH = (registers.TORQUE_ENABLE, 2), (registers.WATCHDOG, 1), (registers.INPUT_VOLTAGE, 4)
# A value that only a configured servo has: a restart sets the register to its default, 1200. The
# register has an effect only in velocity mode.
MARK = (registers.VELOCITY_I, 1201)
ATTEMPTS = 3            # of reads outside the loop
TRACKED = 0.2           # [s] half a turn takes longer at the servo's largest speed, 12 rad/s
WATCHDOG = 0.1          # [s] silence of the bus after which the servos stop
WATCHDOG_COUNTS = round(WATCHDOG / registers.WATCHDOG_UNIT)
WATCHDOG_MARGIN = 0.8   # a pause above this share of the watchdog's time may have expired it
REPEAT_AFTER = 1.0      # [s] until an equal line is logged again
FIRST_PING = 0.2        # [s] after a reboot; a servo does not answer earlier
PING_PERIOD = 0.02      # [s]
BOOT = 2.0              # [s] from a reboot; a servo that is silent for longer has a fault
SILENT_AFTER = 10       # consecutive missing answers after which a servo is only pinged
PROBE = 0.1             # [s] between two pings of a silent servo
HEALTH_PERIOD = 0.1     # [s] in which all health registers are read once
RECONNECT = 0.2         # [s] between attempts to open a lost port
RECOVERIES = 3          # restarts of a servo after overloads; then it stays off


@dataclass(slots=True, eq=False)
class Servo:
    """State of one servo as last known, NaN or None if unknown."""

    name: str
    identifier: int
    sign: int
    zero: int
    where: str                          # joint, port and ID, for messages
    model: int | None = None
    firmware: int | None = None
    position: float = float('nan')      # [rad], with the sign of the tilt, as the next two
    velocity: float = 0.0               # [rad/s]
    current: float = 0.0                # [A]
    updated: float = float('-inf')      # monotonic time of the last feedback [s]
    turns: int = 0                      # to add to its reading
    turns_known: bool = False
    misses: int = 0                     # consecutive missing answers
    silent: bool = False                # after several of them: it is only pinged
    next_probe: float = 0.0             # monotonic time of the next ping [s]
    torque: bool | None = None          # whether it has torque
    error: int = 0                      # Hardware Error Status
    voltage: float = float('nan')       # [V]
    temperature: float = float('nan')   # [deg C]
    recovery: Iterator[None] | None = None      # while it is recovered
    boot_ends: float = 0.0              # until then it may be silent because of a restart [s]
    recoveries: int = 0
    kept_off: bool = False              # it has shut down and stays off until it is rebooted

    def angle(self, counts: int) -> float:
        """Tilt of a reading without added turns [rad]."""
        return self.sign * (counts - self.zero) * registers.POSITION_UNIT

    def counts(self, tilt: float) -> int:
        """Goal for a tilt [rad], in the servo's present frame."""
        return round(self.zero + self.sign * (tilt - TURN * self.turns) / registers.POSITION_UNIT)

    def update(self, data: bytes, now: float, enabled: bool) -> bool:
        """Update it from feedback at monotonic ``now`` [s]; return whether it has restarted."""
        current, velocity, counts = FEEDBACK_LAYOUT.unpack(data)
        self.current = self.sign * current * registers.CURRENT_UNIT
        self.velocity = self.sign * velocity * registers.VELOCITY_UNIT
        angle, before = self.angle(counts), self.turns
        if enabled or now - self.updated < TRACKED:
            # A servo cannot move by half a turn between two readings. After a pause without
            # torque, in which it can be turned by hand, the servo's own count is used.
            self.turns = nearest_turns(angle, self.position)
        self.position = angle + TURN * self.turns
        self.updated, self.misses = now, 0
        return self.turns != before

    @property
    def restarting(self) -> bool:
        """Whether it is silent because of a restart."""
        return self.silent and time.monotonic() < self.boot_ends

    @property
    def errors(self) -> tuple[str, ...]:
        """Hardware errors in words."""
        return tuple(text for bit, text in registers.HARDWARE_ERRORS.items() if self.error & bit)

    @property
    def message(self) -> str:
        """Problem and remedy; '' without a problem."""
        errors = ', '.join(self.errors)
        if self.silent and not self.restarting:
            return f'{self.where}: silent; check its cable and power'
        if errors and not self.torque:
            return f'{self.where}: shut down ({errors}); remove the cause, reboot it'
        return f'{self.where}: {errors}' if errors else ''


def make_servos(parameters: ServoBusParameters) -> list[Servo]:
    """Initial state of the servo of each joint."""
    return [Servo(name, int(identifier), int(sign), int(zero),
                  f'{name} ({parameters.port}, id {int(identifier)})')
            for name, identifier, sign, zero in zip(
                JOINT_NAMES, parameters.ids, parameters.signs, parameters.zeros, strict=True)]


def examine(link: ServoLink, servo: Servo) -> tuple[str, str]:
    """Read its state into ``servo`` and change nothing; return (problem or '', remedy)."""
    servo.model = servo.firmware = None
    try:
        servo.model = link.ping(servo.identifier, ATTEMPTS)
        voltage, temperature, servo.error, position, firmware = (
            link.read(servo.identifier, register, ATTEMPTS) for register in (
                registers.INPUT_VOLTAGE, registers.TEMPERATURE, registers.HARDWARE_ERROR,
                registers.PRESENT_POSITION, registers.FIRMWARE))
    except ServoBusError as error:
        if servo.model is not None:
            return str(error), 'check its cable, and whether two servos have this id'
        return ('does not answer', 'check power, cable, id and baud rate') if link.late \
            else (str(error), 'reboot it')
    servo.firmware, servo.temperature = firmware, float(temperature)
    servo.voltage = voltage * registers.VOLTAGE_UNIT
    servo.position = servo.angle(position) + TURN * servo.turns
    if servo.model != registers.MODEL:
        return (f'model {servo.model}, expected {registers.MODEL} (XC330-T181-T)',
                'another servo has this id, or ids is wrong')
    if servo.error:
        return ', '.join(servo.errors), 'remove the cause, then reboot the servo'
    return '', ''


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
        self.servos = make_servos(parameters)
        self.enabled, self._clock, self.stamp = False, clock, 0.0
        self.link = ServoLink(parameters.port, parameters.baud_rate, parameters.reply_time)
        self._guard: Popen | None = None
        self._torque_off = registers.TORQUE_ENABLE, {one.identifier: 0 for one in self.servos}
        self._next_health = self._next_open = 0.0
        self._group = 0
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
            problem, remedy = examine(self.link, servo)
            if problem:
                problems.append(f'{servo.name} (id {servo.identifier}): {problem}; {remedy}')
                continue
            try:
                self._apply_settings(servo)
            except ServoBusError as error:
                problems.append(f'{servo.name}: {error}')
        if problems:
            raise ServoBusError(f'{self.link.path}: ' + ' | '.join(problems))
        for servo in self.servos:
            servo.silent, servo.kept_off, servo.misses, servo.recoveries = False, False, 0, 0
            servo.torque, servo.error = False, 0
        self._locate()

    def enable(self):
        """
        Switch the torque on with the present angles as goals.

        ServoBusError: an angle is ambiguous, or a servo failed; then none has torque.
        """
        self._locate()
        if doubts := registers.settle(self.servos, self.travel):
            limit = registers.unambiguous_limit(self.travel)
            raise ServoBusError(
                f'{self.link.path}: no torque, the turn is lost: {doubts}; turn it by hand to '
                f'within +-{limit:.2f} rad, cables untwisted')
        if self.parameters.guard and self._guard is None:
            self._guard = servo_guard.start(self.link.path, self.link.baud_rate,
                                            self.link.packet_of_sync_write(*self._torque_off))
        self.enabled = True
        try:
            for servo in self.servos:
                for register, value in ((registers.WATCHDOG, 0), *self._power_on(
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
        self._drop_recoveries()
        if not self.link.is_open:
            return not was_enabled
        confirmed = True
        try:
            self.link.sync_write(*self._torque_off)
            for servo in self.servos:
                try:
                    self.link.write(servo.identifier, registers.TORQUE_ENABLE, 0)
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
            return self.link.sync_write(registers.GOAL_POSITION, {
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
                for servo, data in self._sync_read(asked, FEEDBACK, FEEDBACK_LAYOUT.size):
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
        chosen = [servo for servo, is_chosen in zip(self.servos, which) if is_chosen]
        return JointReading(
            self.stamp, np.array([servo.position for servo in chosen]),
            np.array([servo.velocity for servo in chosen]),
            registers.TORQUE_PER_CURRENT * np.array([servo.current for servo in chosen]),
            [servo.name for servo in chosen])

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
                self._next_health = now + HEALTH_PERIOD / len(HEALTH)
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
        self._drop_recoveries()
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

    def _apply_settings(self, servo):
        link, identifier = self.link, servo.identifier
        current = round(self.parameters.current_limit / registers.CURRENT_UNIT)
        permanent = [       # in EEPROM; the mode is first, because it resets the gains
            (registers.OPERATING_MODE, registers.EXTENDED_POSITION),
            (registers.DRIVE_MODE, 0), (registers.HOMING_OFFSET, 0), (registers.RETURN_DELAY, 0),
            (registers.CURRENT_LIMIT, current)]
        if servo.firmware >= registers.STARTUP_FIRMWARE:
            permanent.append((registers.STARTUP, 0))    # nothing is restored after power-up
        servo.turns_known &= self._is_marked(servo)
        for register in (registers.WATCHDOG, registers.TORQUE_ENABLE):
            link.write(identifier, register, 0)
        for register, value in permanent:
            if link.read(identifier, register, ATTEMPTS) != value:
                link.write(identifier, register, value)
        for register, value in self._volatile_settings():
            link.write(identifier, register, value)

    def _volatile_settings(self):
        """RAM settings, lost by a restart, except torque and watchdog."""
        given = self.parameters
        return [MARK, (registers.STATUS_LEVEL, 2),
                (registers.POSITION_P, given.position_p_gain),
                (registers.POSITION_I, given.position_i_gain),
                (registers.POSITION_D, given.position_d_gain),
                (registers.PROFILE_ACCELERATION, 0), (registers.PROFILE_VELOCITY, 0)]

    def _is_marked(self, servo):
        return self.link.read(servo.identifier, MARK[0], ATTEMPTS) == MARK[1]

    def _locate(self):
        """Read all angles; restarted servos get their RAM settings and have unknown turns."""
        for servo in self.servos:
            if not self._is_marked(servo):
                servo.turns_known = False
                for register, value in self._volatile_settings():
                    self.link.write(servo.identifier, register, value)
            counts = self.link.read(servo.identifier, registers.PRESENT_POSITION, ATTEMPTS)
            servo.turns *= servo.turns_known
            servo.position = servo.angle(counts) + TURN * servo.turns

    def _feed_watchdog(self):
        """Clear the watchdogs after a pause, because expired ones refuse goals without answer."""
        pause = time.monotonic() - self.link.last_sent
        if pause > WATCHDOG_MARGIN * WATCHDOG:
            self._restart_watchdog(self.servos)

    def _restart_watchdog(self, servos):
        for counts in (0, WATCHDOG_COUNTS):
            self.link.sync_write(registers.WATCHDOG,
                                  {servo.identifier: counts for servo in servos})

    # --- feedback and health ------------------------------------------------------------------

    def _sync_read(self, asked, address, length):
        """Pairs of the servos with a valid answer and their data."""
        answers = self.link.sync_read(address, length, [servo.identifier for servo in asked]) \
            if asked else {}
        found = []
        for servo in asked:
            if servo.identifier not in answers:
                continue
            error, data = answers[servo.identifier]
            if not error & registers.ALERT:
                servo.error = 0
            elif not servo.error and servo.recovery is None:
                servo.kept_off = False
                self._recover(servo)    # its recovery reads the hardware error
            if not error & ~registers.ALERT:
                found.append((servo, data))
        return found

    def _count_miss(self, servo):
        """Count a missing answer; after several in a row the servo is silent and only pinged."""
        servo.misses += 1
        if servo.misses >= SILENT_AFTER and not servo.silent:
            servo.silent, servo.torque = True, None
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
        servo.silent, servo.misses, servo.boot_ends = False, 0, 0.0
        self._recover(servo)

    def _read_health(self):
        register, length = HEALTH[self._group]
        self._group = (self._group + 1) % len(HEALTH)
        asked = [servo for servo in self.servos if not servo.silent]
        for servo, data in self._sync_read(asked, register.address, length):
            if register is registers.TORQUE_ENABLE:
                servo.torque = bool(data[0])
                if self.enabled and not servo.torque and not servo.kept_off:
                    self._recover(servo)
                elif servo.torque and not self.enabled:
                    # It did not answer when the torque was switched off.
                    self.link.sync_write(register, {servo.identifier: 0})
                    self.log(f'{servo.where}: still had torque, switched off')
            elif register is registers.WATCHDOG:
                if data[0] == registers.WATCHDOG_EXPIRED and self.enabled:
                    self.log(f'{servo.where}: was stopped by its watchdog, continues')
                    self._restart_watchdog([servo])
            else:
                servo.voltage = int.from_bytes(data[:2], 'little') * registers.VOLTAGE_UNIT
                servo.temperature = float(data[2])

    # --- recovery -----------------------------------------------------------------------------

    def _recover(self, servo, forced=False):
        """Start the recovery of a servo; with ``forced``, restart it in any case."""
        if forced or servo.recovery is None:
            servo.torque = None     # unknown until it is read
            servo.recovery = self._recovery(servo, forced)

    def _drop_recoveries(self):
        for servo in self.servos:
            servo.recovery = None

    def _recover_step(self, servo):
        try:
            next(servo.recovery)
            return
        except StopIteration:
            pass
        except ServoBusError as error:
            self.log(f'{servo.name}: {error}')
            if self.link.late:
                self._count_miss(servo)
        servo.recovery = None

    def _recovery(self, servo, forced):
        """
        Read the state of a servo and recover it; yields after each transaction.

        A restarted servo has lost gains, watchdog, torque and turn count. At the end it has
        torque if the bus is enabled. With ``forced``, and after a shutdown, it is restarted; the
        ping that it answers starts another recovery. So does a missing answer, as long as the
        servo is not kept off.
        """
        link, identifier = self.link, servo.identifier
        if not forced:
            servo.error = link.read(identifier, registers.HARDWARE_ERROR)
            yield
            servo.torque = bool(link.read(identifier, registers.TORQUE_ENABLE))
            yield
            if servo.torque:
                return
        if forced or servo.error:
            if not forced and not (self.enabled and servo.recoveries < RECOVERIES
                                   and not servo.error & registers.OVERHEATING):
                self.log(f'{servo.where}: shut down ({", ".join(servo.errors)}); it stays off '
                         'until it is rebooted')
                servo.kept_off = True
                return
            servo.recoveries += 1
            self.log(f'{servo.where}: restarting it')
            link.reboot(identifier)
            now = time.monotonic()
            servo.silent = True     # so that reads of the others do not wait for it
            servo.next_probe, servo.boot_ends = now + FIRST_PING, now + BOOT
            return
        for register, value in self._volatile_settings():
            link.write(identifier, register, value, attempts=1)
            yield
        counts = link.read(identifier, registers.PRESENT_POSITION)
        servo.turns = nearest_turns(servo.angle(counts), servo.position)
        yield
        servo.kept_off = False
        if not self.enabled:
            servo.turns_known = False
            self.log(f'{servo.where}: is back, without torque')
            return
        # The goals of the running loop also use the new turn count.
        for register, value in self._power_on(counts):
            yield
            link.write(identifier, register, value, attempts=1)
        servo.torque = True
        self.log(f'{servo.where}: had restarted, is back at {servo.position:+.2f} rad')

    def _power_on(self, counts):
        """Settings that switch the torque on with a goal, which holds the servo."""
        return ((registers.GOAL_POSITION, counts), (registers.WATCHDOG, WATCHDOG_COUNTS),
                (registers.TORQUE_ENABLE, 1))
