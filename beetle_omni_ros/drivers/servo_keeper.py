"""Upkeep of the bus while it runs: silent servos, restarts, health registers, reconnection."""

from __future__ import annotations

from collections.abc import Iterator
import time

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_link import NoAnswer, ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_port import PortLost
from beetle_omni_ros.drivers.servo_recovery import recovery
from beetle_omni_ros.drivers.servo_setup import watchdog_counts
from beetle_omni_ros.drivers.servo_state import FEEDBACK_SIZE, Servo, ServoHealth

# Read in turn, each from all servos at once: first register and number of bytes. No gaps: a
# servo may refuse to read across addresses that do not exist. All of another length: an answer
# does not say to what, and a late one must not be taken for another register.
HEALTH = ((registers.TORQUE_ENABLE, 2), (registers.STATUS_LEVEL, 3), (registers.WATCHDOG, 1),
          (registers.INPUT_VOLTAGE, 4))
WATCHDOG_MARGIN = 0.8   # a longer pause than this share of the watchdog's time may have been seen
REPEAT_AFTER = 1.0      # [s] until the same line is said again


class ServoKeeper:
    """
    Keeps the bus in order; one call of :meth:`step` does at most one transaction.

    Args:
        link: the bus.
        parameters: of the bus.
        servos: the driver's memory, updated here.

    """

    def __init__(self, link: ServoLink, parameters: ServoBusParameters, servos: list[Servo]):
        self._link, self._parameters, self._servos = link, parameters, servos
        # ID -> (servo, forced, steps once begun), the next one first
        self._recoveries: dict[int, tuple[Servo, bool, Iterator[None] | None]] = {}
        self._spoke = -1e9
        self._next_health = self._next_open = 0.0
        self._group = 0
        self._events: list[str] = []
        self._said: dict[str, float] = {}

    # --- the log ------------------------------------------------------------------------------

    def say(self, line: str):
        """Keep a line for the log; the same one not more than once in a second."""
        now = time.monotonic()
        if now - self._said.get(line, -REPEAT_AFTER) >= REPEAT_AFTER:
            self._said[line] = now
            self._events.append(line)

    def take_events(self) -> list[str]:
        """Lines since the last call."""
        events, self._events = self._events, []
        self._said = {line: said for line, said in self._said.items()
                      if time.monotonic() - said < REPEAT_AFTER}
        return events

    # --- the port -----------------------------------------------------------------------------

    def lost(self, error: Exception | str = 'unplugged'):
        """Close the port that failed; :meth:`reconnect` opens it again."""
        if self._link.is_open:
            self.say(f'{self._link.where()}: {error}; trying again every '
                     f'{self._parameters.timing.reconnect:g} s')
        self._link.close()
        self.drop_recoveries()
        self._next_open = time.monotonic() + self._parameters.timing.reconnect

    def reconnect(self, enabled: bool):
        """Open the port again, when it is time; servos go on as they are wanted."""
        if time.monotonic() < self._next_open:
            return
        self._next_open = time.monotonic() + self._parameters.timing.reconnect
        try:
            self._link.open()
            self.say(f'{self._link.where()}: connected again')
            if enabled:
                # They had stopped, or even restarted.
                self.feed_watchdog()
                for servo in self._servos:
                    self.recover(servo)
            else:
                self._link.sync_write(registers.TORQUE_ENABLE,
                                      {servo.identifier: 0 for servo in self._servos})
        except PortLost:
            self._link.close()

    # --- the watchdog -------------------------------------------------------------------------

    def spoke(self):
        """Note that a packet went out: the servos' watchdogs start again."""
        self._spoke = time.monotonic()

    def feed_watchdog(self):
        """After a pause, clear watchdogs that have seen it; goals would be refused unheard."""
        pause = time.monotonic() - self._spoke
        if pause > WATCHDOG_MARGIN * self._parameters.timing.watchdog:
            self._restart_watchdog(self._servos)

    def _restart_watchdog(self, servos):
        for counts in (0, watchdog_counts(self._parameters)):
            self._link.sync_write(registers.WATCHDOG,
                                  {servo.identifier: counts for servo in servos})
        self.spoke()

    # --- servos -------------------------------------------------------------------------------

    def take(self, asked: list[Servo], answers: dict[int, tuple[int, bytes]],
             enabled: bool) -> set[int]:
        """Hand out feedback, return whose; the first servo without an answer is the suspect."""
        suspect, answered, now = None, set(), time.monotonic()
        for servo in asked:
            error, data = answers.get(servo.identifier, (0, b''))
            if len(data) == FEEDBACK_SIZE and not error:
                answered.add(servo.identifier)
                if servo.take(data, now, enabled):
                    self.restarted(servo, enabled)
            elif suspect is None:
                suspect = servo
        if suspect is not None:
            self.missed(suspect)
        return answered

    def missed(self, servo: Servo):
        """Count a missing answer; after some in a row leave the servo out and look for it."""
        servo.misses += 1
        timing = self._parameters.timing
        if servo.misses >= timing.silent_after and not servo.silent:
            servo.silent, servo.torque = True, None
            servo.probe_wait = timing.probe_first
            servo.next_probe = time.monotonic() + servo.probe_wait
            self.say(f'{self._place(servo)}: silent; check its cable and power')

    def restarted(self, servo: Servo, enabled: bool):
        """Its reading jumped by whole turns: it has restarted."""
        if not enabled:
            servo.turns_known = False
        if servo.identifier not in self._recoveries:
            self.say(f'{self._place(servo)}: lost its turn count, taken as '
                     f'{servo.position:+.2f} rad')
            self.recover(servo)

    def recover(self, servo: Servo, forced: bool = False):
        """Look what is the matter with a servo and bring it back, or restart it in any case."""
        if forced or servo.identifier not in self._recoveries:
            servo.torque = None  # unknown until it has been read
            self._recoveries[servo.identifier] = (servo, forced, None)

    def drop_recoveries(self):
        """Bring nobody back any more."""
        self._recoveries.clear()

    def step(self, enabled: bool):
        """Do at most one transaction; none where this tick has already waited in vain."""
        if not self._link.is_open:
            return
        if self._link.late:
            self._link.late = False
            return
        now = time.monotonic()
        if self._recoveries:
            self._recover_step(enabled)
        elif any(servo.silent and now >= servo.next_probe for servo in self._servos):
            self._probe(now)
        elif not self._look_at_alert(enabled) and now >= self._next_health:
            self._next_health = now + self._parameters.timing.health / len(HEALTH)
            self._read_health(enabled)
        else:
            return
        self.spoke()

    def report(self, enabled: bool) -> list[ServoHealth]:
        """What is known about each servo."""
        return [servo.describe(servo.identifier in self._recoveries, enabled, self._place(servo))
                for servo in self._servos]

    def _place(self, servo):
        return f'{servo.name} ({self._link.where(servo.identifier)})'

    def _recover_step(self, enabled):
        identifier, (servo, forced, steps) = next(iter(self._recoveries.items()))
        if steps is None:
            steps = recovery(self._link, self._parameters, servo, enabled, forced,
                             time.monotonic, self.say)
        del self._recoveries[identifier]
        try:
            next(steps)
            self._recoveries[identifier] = (servo, forced, steps)  # behind the others
        except StopIteration:
            pass
        except ServoBusError as error:
            self.say(f'{servo.name}: {error}')
            if isinstance(error, NoAnswer):
                self.missed(servo)

    def _probe(self, now):
        servo = min((servo for servo in self._servos if servo.silent),
                    key=lambda servo: servo.next_probe)
        try:
            self._link.ping(servo.identifier)
        except NoAnswer:
            self._link.late = False
            servo.probe_wait = min(2 * servo.probe_wait, self._parameters.timing.probe_longest)
            servo.next_probe = now + servo.probe_wait
            return
        except ServoBusError:
            pass
        servo.silent, servo.misses = False, 0
        for other in self._servos:
            other.next_probe = now  # perhaps it was the bus
        self.say(f'{self._place(servo)}: answers again')
        self.recover(servo)

    def _look_at_alert(self, enabled):
        """Ask a servo that has just raised the alert bit what it is; tell whether one had."""
        for servo in self._servos:
            if servo.identifier not in self._link.alerts:
                servo.error = 0
            elif not servo.error and not servo.silent:
                self.recover(servo)
                servo.resting = False
                self._recover_step(enabled)
                return True
        return False

    def _read_health(self, enabled):
        asked = [servo for servo in self._servos if not servo.silent]
        register, length = HEALTH[self._group]
        self._group = (self._group + 1) % len(HEALTH)
        if not asked:
            return
        answers = self._link.sync_read(register.address, length,
                                       [servo.identifier for servo in asked])
        for servo in asked:
            error, data = answers.get(servo.identifier, (0, b''))
            if len(data) == length and not error:
                self._note(servo, register, data, enabled)

    def _note(self, servo, register, data, enabled):
        if register is registers.TORQUE_ENABLE:
            servo.torque = bool(data[0])
            if enabled and not servo.torque and not servo.resting:
                self.recover(servo)
            elif servo.torque and not enabled:
                # It could not be reached when the torque was taken off.
                self._link.sync_write(register, {servo.identifier: 0})
                self.say(f'{self._place(servo)}: had torque left, taken off')
        elif register is registers.STATUS_LEVEL:
            servo.error = data[2]  # Hardware Error Status is the third
        elif register is registers.WATCHDOG:
            servo.watchdog_expired = data[0] == registers.WATCHDOG_EXPIRED
            if servo.watchdog_expired and enabled:
                self.say(f'{self._place(servo)}: was stopped by its watchdog, goes on')
                self._restart_watchdog([servo])
        else:
            servo.voltage = int.from_bytes(data[:2], 'little') * registers.VOLTAGE_UNIT
            servo.temperature = float(data[2])
