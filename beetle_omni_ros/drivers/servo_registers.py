"""
Control table of the XC330-T181-T: registers, units and codes.

Source: emanual.robotis.com/docs/en/dxl/x/xc330-t181 (addresses, sizes, units), .../dxl/protocol2
(errors). Indirect addresses (168 on) are left out, because they depend on the firmware version.
"""

from dataclasses import dataclass
from math import pi


@dataclass(frozen=True, slots=True)
class Register:
    """A register: first address, size [B], whether it is in two's complement."""

    name: str
    address: int
    size: int
    signed: bool = False

    @property
    def permanent(self) -> bool:
        """Whether it is in EEPROM, kept without power and writable only with torque off."""
        return self.address < 64

    def encoded(self, value: int) -> list[int]:
        """Bytes of a value, in the form of the SDK."""
        return list(int(value).to_bytes(self.size, 'little', signed=self.signed))

    def decoded(self, data) -> int:
        """Value of bytes; the SDK has no signed values."""
        return int.from_bytes(bytes(data), 'little', signed=self.signed)


MODEL_NUMBER = Register('Model Number', 0, 2)
MODEL_INFORMATION = Register('Model Information', 2, 4)
FIRMWARE = Register('Firmware Version', 6, 1)
ID = Register('ID', 7, 1)
BAUD_RATE = Register('Baud Rate', 8, 1)
RETURN_DELAY = Register('Return Delay Time', 9, 1)
DRIVE_MODE = Register('Drive Mode', 10, 1)
OPERATING_MODE = Register('Operating Mode', 11, 1)
SHADOW_ID = Register('Secondary(Shadow) ID', 12, 1)
PROTOCOL = Register('Protocol Type', 13, 1)
HOMING_OFFSET = Register('Homing Offset', 20, 4, True)
MOVING_THRESHOLD = Register('Moving Threshold', 24, 4)
TEMPERATURE_LIMIT = Register('Temperature Limit', 31, 1)
MAX_VOLTAGE = Register('Max Voltage Limit', 32, 2)
MIN_VOLTAGE = Register('Min Voltage Limit', 34, 2)
PWM_LIMIT = Register('PWM Limit', 36, 2)
CURRENT_LIMIT = Register('Current Limit', 38, 2)
VELOCITY_LIMIT = Register('Velocity Limit', 44, 4)
MAX_POSITION = Register('Max Position Limit', 48, 4)
MIN_POSITION = Register('Min Position Limit', 52, 4)
STARTUP = Register('Startup Configuration', 60, 1)
PWM_SLOPE = Register('PWM Slope', 62, 1)
SHUTDOWN = Register('Shutdown', 63, 1)
TORQUE_ENABLE = Register('Torque Enable', 64, 1)
LED = Register('LED', 65, 1)
STATUS_LEVEL = Register('Status Return Level', 68, 1)
REGISTERED = Register('Registered Instruction', 69, 1)
HARDWARE_ERROR = Register('Hardware Error Status', 70, 1)
VELOCITY_I = Register('Velocity I Gain', 76, 2)
VELOCITY_P = Register('Velocity P Gain', 78, 2)
POSITION_D = Register('Position D Gain', 80, 2)
POSITION_I = Register('Position I Gain', 82, 2)
POSITION_P = Register('Position P Gain', 84, 2)
FEEDFORWARD_2 = Register('Feedforward 2nd Gain', 88, 2)
FEEDFORWARD_1 = Register('Feedforward 1st Gain', 90, 2)
WATCHDOG = Register('Bus Watchdog', 98, 1)
GOAL_PWM = Register('Goal PWM', 100, 2, True)
GOAL_CURRENT = Register('Goal Current', 102, 2, True)
GOAL_VELOCITY = Register('Goal Velocity', 104, 4, True)
PROFILE_ACCELERATION = Register('Profile Acceleration', 108, 4)
PROFILE_VELOCITY = Register('Profile Velocity', 112, 4)
GOAL_POSITION = Register('Goal Position', 116, 4, True)
TICK = Register('Realtime Tick', 120, 2)
MOVING = Register('Moving', 122, 1)
MOVING_STATUS = Register('Moving Status', 123, 1)
PRESENT_PWM = Register('Present PWM', 124, 2, True)
PRESENT_CURRENT = Register('Present Current', 126, 2, True)
PRESENT_VELOCITY = Register('Present Velocity', 128, 4, True)
PRESENT_POSITION = Register('Present Position', 132, 4, True)
VELOCITY_TRAJECTORY = Register('Velocity Trajectory', 136, 4, True)
POSITION_TRAJECTORY = Register('Position Trajectory', 140, 4, True)
INPUT_VOLTAGE = Register('Present Input Voltage', 144, 2)
TEMPERATURE = Register('Present Temperature', 146, 1)
BACKUP_READY = Register('Backup Ready', 147, 1)

ALL = tuple(value for value in list(globals().values()) if isinstance(value, Register))

MODEL = 1210                # XC330-T181-T
FIRST_FAST_FIRMWARE = 46    # fast sync read and startup configuration exist from here on

COUNTS_PER_TURN = 4096
POSITION_UNIT = 2 * pi / COUNTS_PER_TURN  # [rad]
VELOCITY_UNIT = 0.229 * 2 * pi / 60       # [rad/s] 0.229 rev/min
CURRENT_UNIT = 0.001        # [A] "about 1 mA" in the manual, at the supply input
VOLTAGE_UNIT = 0.1          # [V]
WATCHDOG_UNIT = 0.02        # [s]
WATCHDOG_EXPIRED = 255      # -1 in one byte

BAUD_CODES = {9600: 0, 57600: 1, 115200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5,
              4_000_000: 6}
MODE_CODES = {'extended_position': 4, 'current_based_position': 5}

# Bits of Hardware Error Status (70) and Shutdown (63).
OVERLOAD = 0x20
OVERHEATING = 0x04
HARDWARE_ERRORS = {
    0x01: 'input voltage outside its limits', OVERHEATING: 'overheated', 0x08: 'encoder fault',
    0x10: 'electrical shock or too little power', OVERLOAD: 'overload'}

# Error number of a status packet; bit 7 is the alert that HARDWARE_ERROR explains.
ALERT = 0x80
PACKET_ERRORS = {
    1: 'could not execute it', 2: 'unknown instruction', 3: 'received a bad CRC',
    4: 'value out of range', 5: 'wrong data length', 6: 'value beyond a limit register',
    7: 'no access (unknown or read-only register, or EEPROM while torque is on)'}


def hardware_errors(status: int) -> tuple[str, ...]:
    """Decode Hardware Error Status (70)."""
    return tuple(text for bit, text in HARDWARE_ERRORS.items() if status & bit)
