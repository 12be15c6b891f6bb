"""
Control table of the XC330-T181-T.

Source: emanual.robotis.com/docs/en/dxl/x/xc330-t181, control tables of the EEPROM and RAM areas.
Indirect addresses (168 on) are left out, because they depend on the firmware version.
"""

from dataclasses import dataclass
from math import pi

MODEL_NUMBER = 1210
EEPROM_END = 64         # registers below it keep their value without power
FIRST_FAST_FIRMWARE = 46  # first version with fast sync read and startup configuration
FIRMWARE = 52

COUNTS_PER_TURN = 4096
POSITION_UNIT = 2 * pi / COUNTS_PER_TURN  # [rad]
ZERO = 2048             # position reading in the middle of the turn
VELOCITY_UNIT = 0.229 * 2 * pi / 60       # [rad/s] 0.229 rev/min
VOLTAGE_UNIT = 0.1      # [V]
WATCHDOG_UNIT = 0.02    # [s]
DELAY_UNIT = 2e-6       # [s]
# [N m] for one count (about 1 mA) of current: the maker's model file xc330_t181_fw52.model
TORQUE_UNIT = 0.000670947
MULTI_TURN_LIMIT = 1_048_575  # goal positions in modes 4 and 5
BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)

POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE = 3, 4, 5   # Operating Mode (11)

# Hardware Error Status (70) and Shutdown (63)
VOLTAGE_ERROR, OVERHEATING, ENCODER_ERROR, SHOCK, OVERLOAD = 0x01, 0x04, 0x08, 0x10, 0x20


@dataclass(frozen=True, slots=True)
class Register:
    """
    One entry of the control table.

    Attributes:
        address: address of the first byte.
        size: number of bytes.
        writable: whether it can be written.
        initial: value of a new servo, or after power-up in the RAM area.
        low: smallest legal value.
        high: largest legal value.
        signed: whether it is in two's complement.
        choices: legal values, if not all between ``low`` and ``high`` are.

    """

    name: str
    address: int
    size: int
    writable: bool
    initial: int = 0
    low: int = 0
    high: int = 0
    signed: bool = False
    choices: tuple[int, ...] = ()


def _read(name, address, size, initial=0, signed=False):
    return Register(name, address, size, False, initial, signed=signed)


def _write(name, address, size, initial, low, high, choices=()):
    return Register(name, address, size, True, initial, low, high, low < 0, choices)


GAIN = 16383
REGISTERS = (
    _read('Model Number', 0, 2, MODEL_NUMBER),
    _read('Model Information', 2, 4),
    _read('Firmware Version', 6, 1, FIRMWARE),
    _write('ID', 7, 1, 1, 0, 252),
    _write('Baud Rate', 8, 1, 1, 0, 6),
    _write('Return Delay Time', 9, 1, 250, 0, 254),
    _write('Drive Mode', 10, 1, 0, 0, 13, (0, 1, 4, 5, 8, 9, 12, 13)),
    _write('Operating Mode', 11, 1, 3, 0, 16, (0, 1, 3, 4, 5, 16)),
    _write('Secondary(Shadow) ID', 12, 1, 255, 0, 255, (*range(253), 255)),
    _write('Protocol Type', 13, 1, 2, 2, 22, (2, 20, 21, 22)),
    _write('Homing Offset', 20, 4, 0, -1_044_479, 1_044_479),
    _write('Moving Threshold', 24, 4, 10, 0, 1023),
    _write('Temperature Limit', 31, 1, 70, 0, 100),
    _write('Max Voltage Limit', 32, 2, 140, 55, 140),
    _write('Min Voltage Limit', 34, 2, 55, 55, 140),
    _write('PWM Limit', 36, 2, 885, 0, 885),
    _write('Current Limit', 38, 2, 910, 0, 910),
    _write('Velocity Limit', 44, 4, 510, 0, 2047),
    _write('Max Position Limit', 48, 4, 4095, 0, 4095),
    _write('Min Position Limit', 52, 4, 0, 0, 4095),
    _write('Startup Configuration', 60, 1, 0, 0, 3),
    _write('PWM Slope', 62, 1, 255, 1, 255),
    _write('Shutdown', 63, 1, 52, 0, 0x3D),
    _write('Torque Enable', 64, 1, 0, 0, 1),
    _write('LED', 65, 1, 0, 0, 1),
    _write('Status Return Level', 68, 1, 2, 0, 2),
    _read('Registered Instruction', 69, 1),
    _read('Hardware Error Status', 70, 1),
    _write('Velocity I Gain', 76, 2, 1200, 0, GAIN),
    _write('Velocity P Gain', 78, 2, 40, 0, GAIN),
    _write('Position D Gain', 80, 2, 0, 0, GAIN),
    _write('Position I Gain', 82, 2, 0, 0, GAIN),
    _write('Position P Gain', 84, 2, 900, 0, GAIN),
    _write('Feedforward 2nd Gain', 88, 2, 0, 0, GAIN),
    _write('Feedforward 1st Gain', 90, 2, 0, 0, GAIN),
    _write('Bus Watchdog', 98, 1, 0, 0, 127),
    _write('Goal PWM', 100, 2, 885, -885, 885),
    _write('Goal Current', 102, 2, 910, -910, 910),
    _write('Goal Velocity', 104, 4, 0, -2047, 2047),
    _write('Profile Acceleration', 108, 4, 0, 0, 32767),
    _write('Profile Velocity', 112, 4, 0, 0, 32767),
    _write('Goal Position', 116, 4, 0, -MULTI_TURN_LIMIT, MULTI_TURN_LIMIT),
    _read('Realtime Tick', 120, 2),
    _read('Moving', 122, 1),
    _read('Moving Status', 123, 1),
    _read('Present PWM', 124, 2, signed=True),
    _read('Present Current', 126, 2, signed=True),
    _read('Present Velocity', 128, 4, signed=True),
    _read('Present Position', 132, 4, signed=True),
    _read('Velocity Trajectory', 136, 4, signed=True),
    _read('Position Trajectory', 140, 4, signed=True),
    _read('Present Input Voltage', 144, 2, 120),
    _read('Present Temperature', 146, 1, 35),
    _read('Backup Ready', 147, 1),
)

BY_NAME = {register.name: register for register in REGISTERS}
BY_ADDRESS = {register.address: register for register in REGISTERS}
SIZE = max(register.address + register.size for register in REGISTERS)
DEFINED = frozenset(address for register in REGISTERS
                    for address in range(register.address, register.address + register.size))
GOALS = frozenset(('Goal PWM', 'Goal Current', 'Goal Velocity', 'Goal Position'))
# Registers that a change of the operating mode resets.
RESET_BY_MODE = ('Velocity I Gain', 'Velocity P Gain', 'Position D Gain', 'Position I Gain',
                 'Position P Gain', 'Feedforward 2nd Gain', 'Feedforward 1st Gain',
                 'Profile Acceleration', 'Profile Velocity')
