"""
Control table of the XC330-T181-T, as far as the driver uses it, and the turns of its angle.

Source: emanual.robotis.com/docs/en/dxl/x/xc330-t181 (addresses, sizes, units), .../dxl/protocol2
(errors). Indirect addresses (168 on) are left out, because they depend on the firmware version.
"""

from collections.abc import Sequence
from math import ceil, floor, pi
from typing import NamedTuple


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

BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
EXTENDED_POSITION = 4       # operating mode

# Bits of Hardware Error Status (70) and Shutdown (63).
OVERHEATING = 0x04
HARDWARE_ERRORS = {
    0x01: 'input voltage outside its limits', OVERHEATING: 'overheated', 0x08: 'encoder fault',
    0x10: 'electrical shock or too little power', 0x20: 'overload'}

ALERT = 0x80    # bit of a status packet's error number, which HARDWARE_ERROR explains


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


def settle(servos: Sequence, travel: float) -> str:
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
