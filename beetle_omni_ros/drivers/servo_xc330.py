"""
The servo XC330-T181-T: control table, state with the turns of its angle, and settings.

Source: emanual.robotis.com/docs/en/dxl/x/xc330-t181 (addresses, sizes, units), .../dxl/protocol2
(errors). Indirect addresses (168 on) are left out, because they depend on the firmware version.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil, floor, pi
import struct
import time
from typing import NamedTuple

import numpy as np

from beetle_omni_ros.drivers.device_parameters import ServoBusParameters
from beetle_omni_ros.model.parameters import JOINT_NAMES
from beetle_omni_ros.model.readings import JointReading


class Register(NamedTuple):
    """A register: first address, size [B], whether it is in two's complement."""

    name: str
    address: int
    size: int
    signed: bool = False

    def __str__(self) -> str:
        """Name and address, for messages."""
        return f'{self.name}({self.address})'

    def encoded(self, value: int) -> list[int]:
        """Bytes of a value, in the form of the SDK."""
        return list(int(value).to_bytes(self.size, 'little', signed=self.signed))

    def decoded(self, data) -> int:
        """Value of bytes; the SDK has no signed values."""
        return int.from_bytes(bytes(data), 'little', signed=self.signed)


# EEPROM: kept without power and writable only with torque off.
FIRMWARE = Register('Firmware Version', 6, 1)
RETURN_DELAY = Register('Return Delay Time', 9, 1)
DRIVE_MODE = Register('Drive Mode', 10, 1)
OPERATING_MODE = Register('Operating Mode', 11, 1)
HOMING_OFFSET = Register('Homing Offset', 20, 4, True)
CURRENT_LIMIT = Register('Current Limit', 38, 2)
STARTUP = Register('Startup Configuration', 60, 1)
# RAM
TORQUE_ENABLE = Register('Torque Enable', 64, 1)
STATUS_LEVEL = Register('Status Return Level', 68, 1)
HARDWARE_ERROR = Register('Hardware Error Status', 70, 1)
VELOCITY_I = Register('Velocity I Gain', 76, 2)
POSITION_D = Register('Position D Gain', 80, 2)
POSITION_I = Register('Position I Gain', 82, 2)
POSITION_P = Register('Position P Gain', 84, 2)
WATCHDOG = Register('Bus Watchdog', 98, 1)
PROFILE_ACCELERATION = Register('Profile Acceleration', 108, 4)
PROFILE_VELOCITY = Register('Profile Velocity', 112, 4)
GOAL_POSITION = Register('Goal Position', 116, 4, True)
PRESENT_CURRENT = Register('Present Current', 126, 2, True)
PRESENT_POSITION = Register('Present Position', 132, 4, True)
INPUT_VOLTAGE = Register('Present Input Voltage', 144, 2)
TEMPERATURE = Register('Present Temperature', 146, 1)

MODEL = 1210                # XC330-T181-T
STARTUP_FIRMWARE = 46       # the startup configuration exists from here on

TURN = 2 * pi
POSITION_UNIT = TURN / 4096         # [rad]
VELOCITY_UNIT = 0.229 * TURN / 60   # [rad/s] 0.229 rev/min
CURRENT_UNIT = 0.001        # [A] "about 1 mA" in the manual, at the supply input
TORQUE_PER_CURRENT = 0.671  # [N m/A] in joint_states
VOLTAGE_UNIT = 0.1          # [V]
WATCHDOG_UNIT = 0.02        # [s]
WATCHDOG_EXPIRED = 255      # -1 in one byte

EXTENDED_POSITION = 4       # operating mode

# Bits of Hardware Error Status (70) and Shutdown (63).
OVERHEATING = 0x04
HARDWARE_ERRORS = {
    0x01: 'input voltage outside its limits', OVERHEATING: 'overheated', 0x08: 'encoder fault',
    0x10: 'electrical shock or too little power', 0x20: 'overload'}

ALERT = 0x80    # bit of a status packet's error number, which HARDWARE_ERROR explains

Setting = tuple[Register, int]
# Current, velocity and position have consecutive addresses.
FEEDBACK_LAYOUT = struct.Struct('<hii')
FEEDBACK = PRESENT_CURRENT.address, FEEDBACK_LAYOUT.size
# First register and number of bytes, read in turn from all servos at once. A range has no gap,
# because a servo may refuse undefined addresses. All lengths differ, because an answer does not
# contain its address, and a late answer must not be mistaken for another register.
HEALTH = (TORQUE_ENABLE, 2), (WATCHDOG, 1), (INPUT_VOLTAGE, 4)
# A value that only a configured servo has: a restart sets the register to its default, 1200. The
# register has an effect only in velocity mode.
MARK: Setting = (VELOCITY_I, 1201)
ATTEMPTS = 3            # of reads outside the loop
TRACKED = 0.2           # [s] half a turn takes longer at the servo's largest speed, 12 rad/s
WATCHDOG_TIME = 0.1     # [s] silence of the bus after which the servos stop
WATCHDOG_COUNTS = round(WATCHDOG_TIME / WATCHDOG_UNIT)
FIRST_PING = 0.2        # [s] after a reboot; a servo does not answer earlier
BOOT = 2.0              # [s] from a reboot; a servo that is silent for longer has a fault
SILENT_AFTER = 10       # consecutive missing answers after which a servo is only pinged


class ServoBusError(RuntimeError):
    """The bus or a servo failed, or a servo answered with an error; one line with port and ID."""


@dataclass(slots=True, eq=False)
class ServoState:
    """State of one servo as last known, NaN or None if unknown."""

    name: str
    identifier: int
    sign: int
    zero: int
    where: str                          # joint, port and ID, for messages
    position: float = float('nan')      # [rad], with the sign of the tilt, as the next two
    velocity: float = 0.0               # [rad/s]
    current: float = 0.0                # [A]
    updated: float = float('-inf')      # monotonic time of the last feedback [s]
    turns: int = 0                      # to add to its reading
    turns_known: bool = False
    misses: int = 0                     # consecutive missing answers; many after a restart
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
        return self.sign * (counts - self.zero) * POSITION_UNIT

    def counts(self, tilt: float) -> int:
        """Goal for a tilt [rad], in the servo's present frame."""
        return round(self.zero + self.sign * (tilt - TURN * self.turns) / POSITION_UNIT)

    def update(self, data: bytes, now: float, enabled: bool) -> bool:
        """Update it from feedback at monotonic ``now`` [s]; return whether it has restarted."""
        current, velocity, counts = FEEDBACK_LAYOUT.unpack(data)
        self.current = self.sign * current * CURRENT_UNIT
        self.velocity = self.sign * velocity * VELOCITY_UNIT
        angle, before = self.angle(counts), self.turns
        if enabled or now - self.updated < TRACKED:
            # A servo cannot move by half a turn between two readings. After a pause without
            # torque, in which it can be turned by hand, the servo's own count is used.
            self.turns = nearest_turns(angle, self.position)
        self.position = angle + TURN * self.turns
        self.updated, self.misses = now, 0
        return self.turns != before

    @property
    def silent(self) -> bool:
        """Whether it is only pinged, after several missing answers or a restart."""
        return self.misses >= SILENT_AFTER

    @property
    def restarting(self) -> bool:
        """Whether it is silent because of a restart."""
        return self.silent and time.monotonic() < self.boot_ends

    def restarted(self) -> None:
        """Ping it only, until it answers, so that reads of the others do not wait for it."""
        now = time.monotonic()
        self.misses, self.next_probe, self.boot_ends = SILENT_AFTER, now + FIRST_PING, now + BOOT

    @property
    def errors(self) -> tuple[str, ...]:
        """Hardware errors in words."""
        return tuple(text for bit, text in HARDWARE_ERRORS.items() if self.error & bit)

    @property
    def message(self) -> str:
        """Problem and remedy; '' without a problem."""
        errors = ', '.join(self.errors)
        if self.silent and not self.restarting:
            return f'{self.where}: silent; check its cable and power'
        if errors and not self.torque:
            return f'{self.where}: shut down ({errors}); remove the cause, reboot it'
        return f'{self.where}: {errors}' if errors else ''


def make_servos(parameters: ServoBusParameters) -> list[ServoState]:
    """Initial state of the servo of each joint."""
    return [ServoState(name, int(identifier), int(sign), int(zero),
                       f'{name} ({parameters.port}, id {int(identifier)})')
            for name, identifier, sign, zero in zip(
                JOINT_NAMES, parameters.ids, parameters.signs, parameters.zeros, strict=True)]


def reading(servos: Sequence[ServoState], stamp: float) -> JointReading:
    """Last feedback of servos, stamped [s]."""
    return JointReading(stamp, np.array([servo.position for servo in servos]),
                        np.array([servo.velocity for servo in servos]),
                        TORQUE_PER_CURRENT * np.array([servo.current for servo in servos]),
                        [servo.name for servo in servos])


def examine(link, servo: ServoState) -> tuple[int | None, int | None, str, str]:
    """
    Read its state into ``servo`` through a :class:`ServoLink` and change nothing.

    Returned are model and firmware, None without an answer; problem or '', and remedy.
    """
    model = None
    try:
        model = link.ping(servo.identifier, ATTEMPTS)
        voltage, temperature, servo.error, position, firmware = (
            link.read(servo.identifier, register, ATTEMPTS) for register in (
                INPUT_VOLTAGE, TEMPERATURE, HARDWARE_ERROR, PRESENT_POSITION, FIRMWARE))
    except ServoBusError as error:
        if model is not None:
            return model, None, str(error), 'check its cable, and whether two servos have this id'
        return (None, None, 'does not answer', 'check power, cable, id and baud rate') \
            if link.late else (None, None, str(error), 'reboot it')
    servo.temperature, servo.voltage = float(temperature), voltage * VOLTAGE_UNIT
    servo.position = servo.angle(position) + TURN * servo.turns
    if model != MODEL:
        return (model, firmware, f'model {model}, expected {MODEL} (XC330-T181-T)',
                'another servo has this id, or ids is wrong')
    return (model, firmware, ', '.join(servo.errors),
            'remove the cause, then reboot the servo' if servo.error else '')


# --- turns --------------------------------------------------------------------------------------

# A servo counts turns only while it has power. After power-up or reboot its position is within
# one turn. An angle beyond +-(2 pi - travel) then has a second solution, one turn away, within
# the travel. With a travel of +-3.96 rad, readings beyond +-2.32 rad (0.74 pi) are ambiguous.

def candidates(angle: float, travel: float) -> list[float]:
    """Angles within +-``travel`` [rad] that differ from ``angle`` by whole turns, ascending."""
    first, last = ceil((-travel - angle) / TURN), floor((travel - angle) / TURN)
    return [angle + TURN * turn for turn in range(first, last + 1)]


def nearest_turns(angle: float, reference: float) -> int:
    """Number of whole turns that brings ``angle`` [rad] nearest to ``reference``."""
    return round((reference - angle) / TURN)


def unambiguous_limit(travel: float) -> float:
    """Angle up to which a reading within one turn is unambiguous [rad]."""
    return TURN - travel if travel > pi else travel


def settle(servos: Sequence[ServoState], travel: float) -> str:
    """
    Determine the unknown turn counts of servos; return '' or a message about ambiguous ones.

    Their ``position`` [rad], ``turns`` and ``turns_known`` are updated. ``travel`` is that of the
    joints to each side [rad].
    """
    doubts = []
    for servo in servos:
        if servo.turns_known:
            continue
        options = candidates(servo.position, travel)
        if len(options) != 1:
            places = ' or '.join(f'{angle:+.2f}' for angle in options or [servo.position])
            doubts.append(f'{servo.name} (id {servo.identifier}) stands at {places} rad')
            continue
        servo.turns += nearest_turns(servo.position, options[0])
        servo.position, servo.turns_known = options[0], True
    return '; '.join(doubts)


# --- settings -----------------------------------------------------------------------------------

def permanent_settings(parameters: ServoBusParameters, firmware: int) -> list[Setting]:
    """Settings in EEPROM; the mode is first, because it resets the gains."""
    return [(OPERATING_MODE, EXTENDED_POSITION), (DRIVE_MODE, 0), (HOMING_OFFSET, 0),
            (RETURN_DELAY, 0), (CURRENT_LIMIT, round(parameters.current_limit / CURRENT_UNIT)),
            # Nothing is restored after power-up.
            *([(STARTUP, 0)] if firmware >= STARTUP_FIRMWARE else [])]


def volatile_settings(parameters: ServoBusParameters) -> list[Setting]:
    """Settings in RAM, lost by a restart, except torque and watchdog."""
    return [MARK, (STATUS_LEVEL, 2), (POSITION_P, parameters.position_p_gain),
            (POSITION_I, parameters.position_i_gain), (POSITION_D, parameters.position_d_gain),
            (PROFILE_ACCELERATION, 0), (PROFILE_VELOCITY, 0)]


def power_on(counts: int) -> list[Setting]:
    """Settings that switch the torque on with a goal, which holds the servo."""
    return [(GOAL_POSITION, counts), (WATCHDOG, WATCHDOG_COUNTS), (TORQUE_ENABLE, 1)]


def is_marked(link, servo: ServoState) -> bool:
    """Whether the servo has its settings, because it has not restarted since."""
    return link.read(servo.identifier, MARK[0], ATTEMPTS) == MARK[1]


def configure(link, servo: ServoState, parameters: ServoBusParameters, firmware: int) -> None:
    """Switch its torque off and write all settings, in EEPROM only where they differ."""
    servo.turns_known &= is_marked(link, servo)
    for register in (WATCHDOG, TORQUE_ENABLE):
        link.write(servo.identifier, register, 0)
    for register, value in permanent_settings(parameters, firmware):
        if link.read(servo.identifier, register, ATTEMPTS) != value:
            link.write(servo.identifier, register, value)
    for register, value in volatile_settings(parameters):
        link.write(servo.identifier, register, value)


def locate(link, servos: Sequence[ServoState], parameters: ServoBusParameters) -> None:
    """Read all angles; restarted servos get their RAM settings and have unknown turns."""
    for servo in servos:
        if not is_marked(link, servo):
            servo.turns_known = False
            for register, value in volatile_settings(parameters):
                link.write(servo.identifier, register, value)
        counts = link.read(servo.identifier, PRESENT_POSITION, ATTEMPTS)
        servo.turns *= servo.turns_known
        servo.position = servo.angle(counts) + TURN * servo.turns
