"""Upkeep of the running bus: silent servos, recovery, health registers, reconnection."""

from collections.abc import Iterator
import time

from beetle_omni_ros.drivers import servo_registers as registers
from beetle_omni_ros.drivers.servo_link import NoAnswer, ServoBusError, ServoLink
from beetle_omni_ros.drivers.servo_parameters import ServoBusParameters
from beetle_omni_ros.drivers.servo_port import PortLost
from beetle_omni_ros.drivers.servo_recovery import recovery
from beetle_omni_ros.drivers.servo_setup import watchdog_counts
from beetle_omni_ros.drivers.servo_state import FEEDBACK_SIZE, Servo, ServoHealth

# First register and number of bytes, read in turn from all servos at once. A range has no gap,
# because a servo may refuse undefined addresses. All lengths differ, because an answer does not
# contain its address, and a late answer must not be mistaken for another register.
HEALTH = ((registers.TORQUE_ENABLE, 2), (registers.STATUS_LEVEL, 3), (registers.WATCHDOG, 1),
          (registers.INPUT_VOLTAGE, 4))
WATCHDOG_MARGIN = 0.8   # a pause above this share of the watchdog's time may have expired it
REPEAT_AFTER = 1.0      # [s] until an equal line is logged again


class ServoUpkeep:
    """Updates, checks and recovers servos; :meth:`step` does at most one transaction."""

    def __init__(self, link: ServoLink, parameters: ServoBusParameters, servos: list[Servo]):
        self._link, self._parameters, self._servos = link, parameters, servos
        # ID -> (servo, forced, generator once started), the next one first
        self._recoveries: dict[int, tuple[Servo, bool, Iterator[None] | None]] = {}
        self._last_sent = -1e9
        self._next_health = self._next_open = 0.0
        self._group = 0
        self._events: list[str] = []
        self._logged: dict[str, float] = {}

    # --- the log ------------------------------------------------------------------------------

    def log(self, line: str):
        """Add a line to the log, unless an equal one was added within a second."""
        now = time.monotonic()
        if now - self._logged.get(line, -REPEAT_AFTER) >= REPEAT_AFTER:
            self._logged[line] = now
            self._events.append(line)

    def take_events(self) -> list[str]:
        """Return the lines since the last call."""
        events, self._events = self._events, []
        self._logged = {line: logged for line, logged in self._logged.items()
                        if time.monotonic() - logged < REPEAT_AFTER}
        return events

    # --- the port -----------------------------------------------------------------------------

    def port_lost(self, error: Exception | str = 'unplugged'):
        """Close the failed port; :meth:`reconnect` opens it again."""
        if self._link.is_open:
            self.log(f'{self._link.where()}: {error}; trying again every '
                     f'{self._parameters.timing.reconnect:g} s')
        self._link.close()
        self.drop_recoveries()
        self._next_open = time.monotonic() + self._parameters.timing.reconnect

    def reconnect(self, enabled: bool):
        """Open the port again if it is time, and restore the torque state of the servos."""
        if time.monotonic() < self._next_open:
            return
        self._next_open = time.monotonic() + self._parameters.timing.reconnect
        try:
            self._link.open()
            self.log(f'{self._link.where()}: connected again')
            if enabled:
                # Their watchdogs have stopped them, and they may have restarted.
                self.feed_watchdog()
                for servo in self._servos:
                    self.recover(servo)
            else:
                self._link.sync_write(registers.TORQUE_ENABLE,
                                      {servo.identifier: 0 for servo in self._servos})
        except PortLost:
            self._link.close()

    # --- the watchdog -------------------------------------------------------------------------

    def packet_sent(self):
        """Record that a packet was sent, which restarts the servos' watchdogs."""
        self._last_sent = time.monotonic()

    def feed_watchdog(self):
        """Clear the watchdogs after a pause, because expired ones refuse goals without answer."""
        pause = time.monotonic() - self._last_sent
        if pause > WATCHDOG_MARGIN * self._parameters.timing.watchdog:
            self._restart_watchdog(self._servos)

    def _restart_watchdog(self, servos):
        for counts in (0, watchdog_counts(self._parameters)):
            self._link.sync_write(registers.WATCHDOG,
                                  {servo.identifier: counts for servo in servos})
        self.packet_sent()

    # --- servos -------------------------------------------------------------------------------

    def handle_feedback(self, asked: list[Servo], answers: dict[int, tuple[int, bytes]],
                        enabled: bool) -> set[int]:
        """Update the servos; return the IDs that answered. The first without answer is missed."""
        missing, answered, now = None, set(), time.monotonic()
        for servo in asked:
            error, data = answers.get(servo.identifier, (0, b''))
            if len(data) == FEEDBACK_SIZE and not error:
                answered.add(servo.identifier)
                if servo.update(data, now, enabled):
                    self.handle_restart(servo, enabled)
            elif missing is None:
                missing = servo
        if missing is not None:
            self.count_miss(missing)
        return answered

    def count_miss(self, servo: Servo):
        """Count a missing answer; after several in a row the servo is silent and only pinged."""
        servo.misses += 1
        timing = self._parameters.timing
        if servo.misses >= timing.silent_after and not servo.silent:
            servo.silent, servo.torque = True, None
            servo.probe_wait = timing.probe_first
            servo.next_probe = time.monotonic() + servo.probe_wait
            self.log(f'{self._where(servo)}: silent; check its cable and power')

    def handle_restart(self, servo: Servo, enabled: bool):
        """Recover a servo whose reading jumped by whole turns, because it has restarted."""
        if not enabled:
            servo.turns_known = False
        if servo.identifier not in self._recoveries:
            self.log(f'{self._where(servo)}: lost its turn count, taken as '
                     f'{servo.position:+.2f} rad')
            self.recover(servo)

    def recover(self, servo: Servo, forced: bool = False):
        """Start the recovery of a servo; with ``forced``, restart it in any case."""
        if forced or servo.identifier not in self._recoveries:
            servo.torque = None  # unknown until it is read
            self._recoveries[servo.identifier] = (servo, forced, None)

    def drop_recoveries(self):
        """Cancel all recoveries."""
        self._recoveries.clear()

    def step(self, enabled: bool):
        """Do at most one transaction; none after a timeout in this tick."""
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
        elif not self._handle_alert(enabled) and now >= self._next_health:
            self._next_health = now + self._parameters.timing.health / len(HEALTH)
            self._read_health(enabled)
        else:
            return
        self.packet_sent()

    def report(self, enabled: bool) -> list[ServoHealth]:
        """Last known health of each servo."""
        return [servo.describe(servo.identifier in self._recoveries, enabled, self._where(servo))
                for servo in self._servos]

    def _where(self, servo):
        return f'{servo.name} ({self._link.where(servo.identifier)})'

    def _recover_step(self, enabled):
        identifier, (servo, forced, steps) = next(iter(self._recoveries.items()))
        if steps is None:
            steps = recovery(self._link, self._parameters, servo, enabled, forced,
                             time.monotonic, self.log)
        del self._recoveries[identifier]
        try:
            next(steps)
            self._recoveries[identifier] = (servo, forced, steps)  # behind the others
        except StopIteration:
            pass
        except ServoBusError as error:
            self.log(f'{servo.name}: {error}')
            if isinstance(error, NoAnswer):
                self.count_miss(servo)

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
            other.next_probe = now  # the cause may have been the bus
        self.log(f'{self._where(servo)}: answers again')
        self.recover(servo)

    def _handle_alert(self, enabled):
        """Start the recovery of a servo with a new alert bit; return whether there is one."""
        for servo in self._servos:
            if servo.identifier not in self._link.alerts:
                servo.error = 0
            elif not servo.error and not servo.silent:
                self.recover(servo)
                servo.kept_off = False
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
                self._update_health(servo, register, data, enabled)

    def _update_health(self, servo, register, data, enabled):
        if register is registers.TORQUE_ENABLE:
            servo.torque = bool(data[0])
            if enabled and not servo.torque and not servo.kept_off:
                self.recover(servo)
            elif servo.torque and not enabled:
                # It did not answer when the torque was switched off.
                self._link.sync_write(register, {servo.identifier: 0})
                self.log(f'{self._where(servo)}: still had torque, switched off')
        elif register is registers.STATUS_LEVEL:
            servo.error = data[2]  # Hardware Error Status is the third
        elif register is registers.WATCHDOG:
            servo.watchdog_expired = data[0] == registers.WATCHDOG_EXPIRED
            if servo.watchdog_expired and enabled:
                self.log(f'{self._where(servo)}: was stopped by its watchdog, continues')
                self._restart_watchdog([servo])
        else:
            servo.voltage = int.from_bytes(data[:2], 'little') * registers.VOLTAGE_UNIT
            servo.temperature = float(data[2])
