"""
Emulated XC330-T181-T servos on a pseudo-terminal, as far as a driver of their positions uses them.

Sources: emanual.robotis.com/docs/en/dxl/protocol2 and .../dxl/x/xc330-t181. The maker's SDK is not
used, so that tests can compare both. If the manual does not define a behaviour, the servos have
the one that is worse for a driver, and a comment states it.

A packet is ``FF FF FD 00 | ID | length (2 B) | instruction | parameters | CRC (2 B)``. The length
is that of the rest of the packet. In instruction and parameters an ``FD`` is stuffed after each
``FF FF FD``, so that the header is unique.
"""

from collections import deque
from collections.abc import Container, Iterator, Sequence
import itertools
from math import floor, inf, pi
import time
from typing import NamedTuple

import numpy as np

from beetle_omni_ros.sim.emulated.device import Device, ServoFaults

HEADER = b'\xff\xff\xfd\x00'
BROADCAST = 0xFE
HEAD_SIZE = 7       # [B] header, ID and length
LENGTH_LIMIT = 1024 # [B] larger than any instruction of the SDK for 253 servos
PING, READ, WRITE, REBOOT, STATUS, SYNC_READ, SYNC_WRITE = (
    0x01, 0x02, 0x03, 0x08, 0x55, 0x82, 0x83)

EEPROM_END = 64     # registers below it keep their value without power
COUNTS_PER_TURN = 4096
POSITION_UNIT = 2 * pi / COUNTS_PER_TURN    # [rad]
ZERO = 2048         # position reading in the middle of the turn
VELOCITY_UNIT = 0.229 * 2 * pi / 60         # [rad/s] 0.229 rev/min
VOLTAGE_UNIT, VOLTAGE_LIMITS = 0.1, (5.5, 14.0)    # [V]
WATCHDOG_UNIT, WATCHDOG_EXPIRED = 0.02, 255     # [s]
# [N m] for one count (about 1 mA) of current: the maker's model file xc330_t181_fw52.model
TORQUE_UNIT = 0.000670947
# Hardware Error Status (70) and Shutdown (63)
VOLTAGE_ERROR, OVERHEATING, OVERLOAD = 0x01, 0x04, 0x20
# Errors in the lower seven bits of the error byte in a status packet; ALERT is the eighth bit.
NONE, RESULT_FAIL, INSTRUCTION, DATA_RANGE, ACCESS, ALERT = 0, 1, 2, 4, 7, 0x80

PAUSE = 0.05        # [s] silence after which an incomplete packet is dropped


class EmulatedRegister(NamedTuple):
    """A register: address, size [B], value after power-up, values that may be written, sign."""

    address: int
    size: int
    initial: int = 0
    legal: Container[int] = ()
    signed: bool = False


GAIN = range(16384)
TABLE = {
    'Model Number': EmulatedRegister(0, 2, 1210),
    'Firmware Version': EmulatedRegister(6, 1, 52),
    'ID': EmulatedRegister(7, 1, 1, range(253)),
    'Return Delay Time': EmulatedRegister(9, 1, 250, range(255)),
    'Drive Mode': EmulatedRegister(10, 1, 0, (0, 1, 4, 5, 8, 9, 12, 13)),
    'Operating Mode': EmulatedRegister(11, 1, 3, (0, 1, 3, 4, 5, 16)),
    'Secondary(Shadow) ID': EmulatedRegister(12, 1, 255, (*range(253), 255)),
    'Homing Offset': EmulatedRegister(20, 4, 0, range(-1_044_479, 1_044_480), True),
    'Temperature Limit': EmulatedRegister(31, 1, 70, range(101)),
    'Current Limit': EmulatedRegister(38, 2, 910, range(911)),
    'Startup Configuration': EmulatedRegister(60, 1, 0, range(4)),
    'Shutdown': EmulatedRegister(63, 1, 52, range(0x3E)),
    'Torque Enable': EmulatedRegister(64, 1, 0, range(2)),
    'LED': EmulatedRegister(65, 1, 0, range(2)),
    'Status Return Level': EmulatedRegister(68, 1, 2, range(3)),
    'Registered Instruction': EmulatedRegister(69, 1),
    'Hardware Error Status': EmulatedRegister(70, 1),
    'Velocity I Gain': EmulatedRegister(76, 2, 1200, GAIN),
    'Position D Gain': EmulatedRegister(80, 2, 0, GAIN),
    'Position I Gain': EmulatedRegister(82, 2, 0, GAIN),
    'Position P Gain': EmulatedRegister(84, 2, 900, GAIN),
    'Feedforward 2nd Gain': EmulatedRegister(88, 2, 0, GAIN),
    'Feedforward 1st Gain': EmulatedRegister(90, 2, 0, GAIN),
    'Bus Watchdog': EmulatedRegister(98, 1, 0, range(128)),
    'Profile Acceleration': EmulatedRegister(108, 4, 0, range(32768)),
    'Profile Velocity': EmulatedRegister(112, 4, 0, range(32768)),
    'Goal Position': EmulatedRegister(116, 4, 0, range(-1_048_575, 1_048_576), True),
    'Present Current': EmulatedRegister(126, 2, signed=True),
    'Present Velocity': EmulatedRegister(128, 4, signed=True),
    'Present Position': EmulatedRegister(132, 4, signed=True),
    'Present Input Voltage': EmulatedRegister(144, 2, 120),
    'Present Temperature': EmulatedRegister(146, 1, 35),
    'Backup Ready': EmulatedRegister(147, 1),
}
NAMES = {register.address: name for name, register in TABLE.items()}
DEFINED = frozenset(address for register in TABLE.values()
                    for address in range(register.address, register.address + register.size))


# Remainders of the polynomial x^16 + x^15 + x^2 + 1 for each leading byte.
CRC_TABLE = []
for byte in range(256):
    remainder = byte << 8
    for _ in range(8):
        remainder = (remainder << 1) ^ (0x8005 if remainder & 0x8000 else 0)
    CRC_TABLE.append(remainder & 0xFFFF)


def sealed(data: bytes) -> bytes:
    """Bytes with their CRC-16 (polynomial 0x8005, not reflected)."""
    crc = 0
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ CRC_TABLE[(crc >> 8) ^ byte]
    return data + crc.to_bytes(2, 'little')


def packet(identifier: int, instruction: int, parameters: bytes = b'') -> bytes:
    """Build a packet."""
    body = (bytes((instruction,)) + parameters).replace(b'\xff\xff\xfd', b'\xff\xff\xfd\xfd')
    return sealed(HEADER + bytes((identifier,)) + (len(body) + 2).to_bytes(2, 'little') + body)


def packets(buffer: bytearray) -> Iterator[tuple[int, int, bytes]]:
    """Take the packets with a correct CRC from a stream: ID, instruction, parameters."""
    while (start := buffer.find(HEADER)) >= 0:
        del buffer[:start]
        if len(buffer) < HEAD_SIZE:
            return
        length = int.from_bytes(buffer[5:7], 'little')
        end = HEAD_SIZE + length
        if 3 <= length <= LENGTH_LIMIT and len(buffer) < end:
            return
        raw = bytes(buffer[:end])
        if not 3 <= length <= LENGTH_LIMIT or sealed(raw[:-2]) != raw:
            del buffer[:len(HEADER)]        # its rest may have the start of the next one
            continue
        del buffer[:end]
        body = raw[HEAD_SIZE:-2].replace(b'\xff\xff\xfd\xfd', b'\xff\xff\xfd')
        yield raw[4], body[0], body[1:]


class EmulatedServo:
    """
    Registers, watchdog, shutdown and turn count of one servo.

    Angles are those of the robot's joint [rad]; ``sign`` and ``zero`` convert them to counts. The
    owner sets ``angle``, ``velocity`` [rad/s] and ``effort`` [N m] of the shaft.
    """

    def __init__(self, identifier: int, *, sign: int = 1, zero: int = ZERO,
                 reboot_time: float = 0.3):
        self.sign, self.zero, self.reboot_time = sign, zero, reboot_time
        self.angle = self.velocity = self.effort = 0.0
        self.last_packet, self.boots_at = 0.0, -inf
        self._memory = bytearray(max(DEFINED) + 1)
        for name, register in TABLE.items():
            self[name] = register.initial
        self['ID'] = identifier
        self._to_one_turn()

    def __getitem__(self, name: str) -> int:
        """Value of a register."""
        register = TABLE[name]
        raw = self._memory[register.address:register.address + register.size]
        return int.from_bytes(raw, 'little', signed=register.signed)

    def __setitem__(self, name: str, value: int):
        """Set a register without checks."""
        register = TABLE[name]
        self._memory[register.address:register.address + register.size] = \
            value.to_bytes(register.size, 'little', signed=register.signed)

    @property
    def torque(self) -> bool:
        """Whether the motor is powered."""
        return bool(self['Torque Enable'])

    @property
    def expired(self) -> bool:
        """Whether the bus watchdog has stopped it."""
        return self['Bus Watchdog'] == WATCHDOG_EXPIRED

    @property
    def goal(self) -> float:
        """Goal angle of the joint [rad]."""
        counts = self['Goal Position'] + COUNTS_PER_TURN * self._turns
        return self.sign * (counts - self.zero) * POSITION_UNIT

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Read bytes of the control table; error ACCESS for undefined addresses."""
        end = address + length
        if not length or not all(place in DEFINED for place in range(address, end)):
            return ACCESS, b''
        self['Present Current'] = round(self.sign * self.effort / TORQUE_UNIT)
        self['Present Velocity'] = round(self.sign * self.velocity / VELOCITY_UNIT)
        self['Present Position'] = self._present()
        return NONE, bytes(self._memory[address:end])

    def write(self, address: int, data: bytes) -> int:
        """Write one register; return the error."""
        name = NAMES.get(address)
        if name is None or (address < EEPROM_END and self.torque):
            return ACCESS
        register = TABLE[name]
        if not register.legal or len(data) != register.size:
            return ACCESS
        value = int.from_bytes(data, 'little', signed=register.signed)
        if value not in register.legal or (self.expired and (
                name == 'Goal Position' or name == 'Bus Watchdog' and value)):
            return DATA_RANGE
        # The manual defines the refusal, but not its error.
        if name == 'Torque Enable' and value and self['Hardware Error Status'] & self['Shutdown']:
            return RESULT_FAIL
        if name == 'Operating Mode' and self[name] != value:
            for other in TABLE:
                if 'Gain' in other or 'Profile' in other:
                    self[other] = TABLE[other].initial
        self[name] = value      # a goal remains, so torque without a new one causes a jump
        return NONE

    def reboot(self, now: float):
        """Restart with initial RAM, torque off, position within one turn; silent until booted."""
        for name, register in TABLE.items():
            if register.address >= EEPROM_END:
                self[name] = register.initial
        self.boots_at = now + self.reboot_time
        self._to_one_turn()

    def advance(self, now: float, voltage: float):
        """Check watchdog, temperature and supply voltage [V]."""
        limit, silence = self['Bus Watchdog'], now - self.last_packet
        if self.torque and 0 < limit < WATCHDOG_EXPIRED and silence > limit * WATCHDOG_UNIT:
            self.expire()
        if self['Present Temperature'] > self['Temperature Limit']:
            self.trip(OVERHEATING)
        self['Present Input Voltage'] = round(voltage / VOLTAGE_UNIT)
        if not VOLTAGE_LIMITS[0] <= voltage <= VOLTAGE_LIMITS[1]:
            self.trip(VOLTAGE_ERROR)

    def expire(self):
        """Expire the watchdog: hold the present position (the manual has only "stop")."""
        self['Bus Watchdog'], self['Goal Position'] = WATCHDOG_EXPIRED, self._present()

    def trip(self, error: int):
        """Set a hardware error; the errors in Shutdown (63) switch the torque off."""
        self['Hardware Error Status'] |= error
        if error & self['Shutdown']:
            self['Torque Enable'] = 0

    def _present(self):
        counts = round(self.zero + self.sign * self.angle / POSITION_UNIT)
        return counts - COUNTS_PER_TURN * self._turns

    def _to_one_turn(self):
        self._turns = 0
        self._turns = floor(self._present() / COUNTS_PER_TURN)


class EmulatedServoBus(Device):
    """
    XC330 servos on one serial port, with IDs, signs and zeros [counts] in the order of the joints.

    A plant reads :meth:`drive` and calls :meth:`set_state`. Without a plant servos with torque
    move at ``speed`` [rad/s]. After a reboot they are silent for ``reboot_time`` [s]. ``refusals``
    is the number of refused instructions.
    """

    def __init__(self, identifiers: Sequence[int] = (1, 2, 3, 4), *, port: str | None = None,
                 signs: Sequence[int] = (1,) * 4, zeros: Sequence[int] = (ZERO,) * 4,
                 speed: float = 0.0, reboot_time: float = 0.3, seed: int = 0):
        self.faults, self.refusals = ServoFaults(), 0
        self.servos = [EmulatedServo(name, sign=sign, zero=zero, reboot_time=reboot_time)
                       for name, sign, zero in zip(identifiers, signs, zeros, strict=True)]
        self._speed, self._buffer = speed, bytearray()
        self._answers: deque[tuple[float, bytes]] = deque()     # when they are sent [s]
        self._last_data = self._last_move = time.monotonic()
        super().__init__('servo_bus', port, seed)

    def drive(self) -> tuple[list[float], list[bool]]:
        """Goals [rad], and whether motors are powered; without power a joint is free."""
        with self._lock:
            # Handle received bytes, because the thread may not have been scheduled.
            self._serve(time.monotonic())
            return ([servo.goal for servo in self.servos],
                    [servo.torque for servo in self.servos])

    def set_state(self, position: np.ndarray, velocity: np.ndarray, effort: np.ndarray):
        """Set the joints' true angles [rad], rates [rad/s] and torques [N m], each (n,)."""
        with self._lock:
            for servo, *state in zip(self.servos, position, velocity, effort, strict=True):
                servo.angle, servo.velocity, servo.effort = map(float, state)

    def reboot(self, index: int):
        """Restart servo ``index`` as a brown-out does: torque off, turn count lost."""
        with self._lock:
            self.servos[index].reboot(time.monotonic())

    def _serve(self, now):
        """Move the servos, handle received packets, check the servos, send due answers."""
        step, self._last_move = self._speed * (now - self._last_move), now
        for servo in self.servos if step else ():
            if servo.torque:
                servo.angle += max(-step, min(step, servo.goal - servo.angle))
        if data := self._read():
            if now - self._last_data > PAUSE:
                self._buffer.clear()
            self._last_data = now
            self._buffer += data
            faults = self.faults
            for received in packets(self._buffer):
                for answer in self.handle(received, now):
                    late = faults.delay * (self._random.random() < faults.delayed)
                    self._answers.append((now + late, self._spoilt(
                        answer, faults.dropped, faults.bad_crc)))
        # After the data, so that waiting packets restart the watchdogs of a late thread.
        for servo in self.servos:
            servo.advance(now, self.faults.supply_voltage)
            if servo['ID'] in self.faults.overload and servo.torque:
                servo.trip(OVERLOAD)
        # In one write, so that a stall of this thread does not split the answers to one request.
        due = b''
        while self._due() <= now:
            due += self._answers.popleft()[1]
        if due:
            self._send(due)

    def _due(self):
        return self._answers[0][0] if self._answers else inf

    def handle(self, received: tuple[int, int, bytes], now: float) -> list[bytes]:
        """Execute a packet in every servo that receives it; return the answers in order."""
        listening = {servo['ID']: servo for servo in self.servos
                     if servo['ID'] not in self.faults.silent and now >= servo.boots_at}
        for servo in listening.values():
            servo.last_packet = now
        name, code, given = received
        address, length = (int.from_bytes(given[k:k + 2], 'little') for k in (0, 2))
        if code == SYNC_WRITE:
            for k in range(4, len(given), length + 1):
                if given[k] in listening:
                    error = listening[given[k]].write(address, given[k + 1:k + 1 + length])
                    self.refusals += error != NONE
            return []
        answers = []
        # Each waits for the previous one, so a silent one ends a common answer.
        for one in itertools.takewhile(listening.__contains__,
                                       given[4:] if code == SYNC_READ else [name]):
            servo, data, error = listening[one], b'', NONE
            if code == PING:
                data = servo.read(0, 2)[1] + bytes((servo['Firmware Version'],))
            elif code in (READ, SYNC_READ):
                error, data = servo.read(address, length)
            elif code == WRITE:
                error = servo.write(address, given[2:])
            elif code == REBOOT:
                servo.reboot(now)
            else:
                error = INSTRUCTION
            self.refusals += error != NONE
            answers.append(packet(one, STATUS, bytes((
                error | ALERT * bool(servo['Hardware Error Status']),)) + data))
        return answers
