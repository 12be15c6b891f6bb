"""
One emulated XC330-T181-T: control table, checks of writes, and protections.

:meth:`EmulatedServo.move` sets the state of the shaft. Angles are those of the robot's joint
[rad]; ``sign`` and ``zero`` convert them to counts. If the manual does not define a behaviour, the
servo has the one that is worse for a driver, and a comment states it.
"""

from math import floor, inf

from beetle_omni_ros.sim.emulated import servo_table as table
from beetle_omni_ros.sim.emulated.dynamixel import Error


class EmulatedServo:
    """Registers, watchdog, shutdown and turn count of one servo."""

    def __init__(self, identifier: int, *, firmware: int = table.FIRMWARE,
                 baud_rate: int = 1_000_000, sign: int = 1, zero: int = table.ZERO,
                 reboot_time: float = 0.3):
        self.sign, self.zero, self.reboot_time = sign, zero, reboot_time
        self.angle = self.velocity = self.effort = 0.0
        self.temperature = self.voltage = None
        self._memory = bytearray(table.SIZE)
        self._turns = 0
        self._last_packet = 0.0
        self._boots_at = -inf
        for register in table.REGISTERS:
            self[register.name] = register.initial
        self['ID'], self['Firmware Version'] = identifier, firmware
        self['Baud Rate'] = table.BAUD_RATES.index(baud_rate)
        self['Return Delay Time'] = 250
        self._to_one_turn()

    def __getitem__(self, name: str) -> int:
        """Value of a register."""
        register = table.BY_NAME[name]
        raw = self._memory[register.address:register.address + register.size]
        return int.from_bytes(raw, 'little', signed=register.signed)

    def __setitem__(self, name: str, value: int):
        """Set a register without checks."""
        register = table.BY_NAME[name]
        self._memory[register.address:register.address + register.size] = \
            value.to_bytes(register.size, 'little', signed=register.signed)

    @property
    def torque(self) -> bool:
        """Whether the motor is powered."""
        return bool(self['Torque Enable'])

    @property
    def expired(self) -> bool:
        """Whether the bus watchdog has stopped it."""
        return self['Bus Watchdog'] == 255

    @property
    def baud_rate(self) -> int:
        """Baud rate [bit/s]."""
        return table.BAUD_RATES[self['Baud Rate']]

    @property
    def goal(self) -> float:
        """Goal angle of the joint [rad]; the present angle in modes without position control."""
        if self['Operating Mode'] not in (table.POSITION_MODE, table.EXTENDED_MODE,
                                          table.CURRENT_POSITION_MODE):
            return self.angle
        counts = self['Goal Position'] - self['Homing Offset'] \
            + table.COUNTS_PER_TURN * self._turns
        return self.sign * (counts - self.zero) * table.POSITION_UNIT

    @property
    def alert(self) -> int:
        """Alert bit of its error bytes."""
        return Error.ALERT if self['Hardware Error Status'] else 0

    def booted(self, now: float) -> bool:
        """Whether it has booted."""
        return now >= self._boots_at

    def move(self, angle: float, velocity: float, effort: float):
        """Set the shaft's state: [rad], [rad/s], [N m]."""
        self.angle, self.velocity, self.effort = float(angle), float(velocity), float(effort)

    # --- instructions -------------------------------------------------------------------------

    def feed_watchdog(self, now: float):
        """Restart the watchdog, because an instruction packet was on the bus."""
        self._last_packet = now

    def read(self, address: int, length: int, now: float) -> tuple[Error, bytes]:
        """Read bytes of the control table; error ACCESS for undefined addresses."""
        end = address + length
        if not length or not all(place in table.DEFINED for place in range(address, end)):
            return Error.ACCESS, b''
        if end > 120:
            self._measure(now)
        return Error.NONE, bytes(self._memory[address:end])

    def write(self, address: int, data: bytes) -> Error:
        """Write complete registers, all or none of them."""
        error, values = self._parsed(address, data)
        if error is Error.NONE:
            for register, value in values:
                self._apply(register.name, value)
        return error

    def reboot(self, now: float):
        """Restart with initial RAM, torque off, position within one turn; silent until booted."""
        for register in table.REGISTERS:
            if register.address >= table.EEPROM_END:
                self[register.name] = register.initial
        self._boots_at = now + self.reboot_time
        self._to_one_turn()
        if self['Startup Configuration'] & 1:
            self['Torque Enable'] = 1

    # --- protection ---------------------------------------------------------------------------

    def advance(self, now: float):
        """Check watchdog, temperature and voltage."""
        limit = self['Bus Watchdog']
        silence = now - self._last_packet
        if self.torque and 0 < limit < 255 and silence > limit * table.WATCHDOG_UNIT:
            self.expire()
        self['Present Temperature'] = round(35 if self.temperature is None else self.temperature)
        if self['Present Temperature'] > self['Temperature Limit']:
            self.trip(table.OVERHEATING)
        self['Present Input Voltage'] = \
            round((12.0 if self.voltage is None else self.voltage) / table.VOLTAGE_UNIT)
        if not self['Min Voltage Limit'] <= self['Present Input Voltage'] \
                <= self['Max Voltage Limit']:
            self.trip(table.VOLTAGE_ERROR)

    def expire(self):
        """Expire the watchdog: hold the present position (the manual has only "stop")."""
        self['Bus Watchdog'] = 255
        self['Goal Position'] = self._present()
        self['Profile Acceleration'] = self['Profile Velocity'] = 0

    def trip(self, error: int):
        """Set a hardware error; the errors in Shutdown (63) switch the torque off."""
        self['Hardware Error Status'] |= error
        if error & self['Shutdown']:
            self['Torque Enable'] = 0

    # --- inside -------------------------------------------------------------------------------

    def _parsed(self, address, data):
        """Parse a write into registers and values, or return the error of a refusal."""
        values, place, end = [], address, address + len(data)
        if not data:
            return Error.DATA_LENGTH, ()
        while place < end:
            register = table.BY_ADDRESS.get(place)
            if register is None:
                return (Error.DATA_LENGTH if place in table.DEFINED else Error.ACCESS), ()
            if not register.writable or (place < table.EEPROM_END and self.torque):
                return Error.ACCESS, ()
            place += register.size
            if place > end:
                return Error.DATA_LENGTH, ()
            raw = data[register.address - address:place - address]
            value = int.from_bytes(raw, 'little', signed=register.signed)
            error = self._error_of(register, value)
            if error is not Error.NONE:
                return error, ()
            values.append((register, value))
        return Error.NONE, values

    def _error_of(self, register, value):
        """Error of writing a value to a register."""
        name = register.name
        if not register.low <= value <= register.high \
                or (register.choices and value not in register.choices):
            return Error.DATA_RANGE
        if self.expired and (name in table.GOALS or (name == 'Bus Watchdog' and value)):
            return Error.DATA_RANGE
        # The manual defines the refusal, but not its error.
        if name == 'Torque Enable' and value \
                and self['Hardware Error Status'] & self['Shutdown']:
            return Error.RESULT_FAIL
        limit = {'Goal PWM': 'PWM Limit', 'Goal Current': 'Current Limit',
                 'Goal Velocity': 'Velocity Limit'}.get(name)
        if limit and abs(value) > self[limit]:
            return Error.DATA_LIMIT
        if name == 'Goal Position' and self['Operating Mode'] == table.POSITION_MODE \
                and not self['Min Position Limit'] <= value <= self['Max Position Limit']:
            return Error.DATA_LIMIT
        return Error.NONE

    def _apply(self, name, value):
        changed = self[name] != value
        self[name] = value
        if name == 'Operating Mode' and changed:
            for gain in table.RESET_BY_MODE:
                self[gain] = table.BY_NAME[gain].initial
            self['Goal PWM'], self['Goal Current'] = self['PWM Limit'], self['Current Limit']
            if value == table.POSITION_MODE:
                self._to_one_turn()
        elif name == 'Torque Enable' and value and changed:
            # The old goal remains, so a driver that does not set it causes a jump.
            if self['Operating Mode'] == table.POSITION_MODE:
                self._to_one_turn()
        elif name in table.GOALS and self['Drive Mode'] & 8:
            self['Torque Enable'] = 1

    def _counts(self):
        return round(self.zero + self.sign * self.angle / table.POSITION_UNIT)

    def _present(self):
        return self._counts() - table.COUNTS_PER_TURN * self._turns + self['Homing Offset']

    def _to_one_turn(self):
        self._turns = floor(self._counts() / table.COUNTS_PER_TURN)

    def _measure(self, now):
        speed = round(self.sign * self.velocity / table.VELOCITY_UNIT)
        current = round(self.sign * self.effort / table.TORQUE_UNIT)
        self['Realtime Tick'] = int(now * 1000) % 32768
        self['Moving'] = int(abs(speed) > self['Moving Threshold'])
        self['Present Current'] = max(-32768, min(32767, current))
        self['Present Velocity'] = speed
        self['Present Position'] = self._present()
        self['Position Trajectory'] = self['Goal Position']
