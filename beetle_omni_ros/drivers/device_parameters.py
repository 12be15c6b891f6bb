"""Parameters of both devices; read from params/servo_bus.yaml and params/motor_board.yaml."""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.drivers.servo_registers import BAUD_CODES
from beetle_omni_ros.robot.schema import group, parameter, ParameterError, ParameterFile


@dataclass(frozen=True, kw_only=True)
class ServoGains:
    """Gains of the servo's position controller, in units of its control table."""

    proportional: int = parameter(900, doc='Position P Gain', low=0, high=16383)
    integral: int = parameter(0, doc='Position I Gain', low=0, high=16383)
    derivative: int = parameter(0, doc='Position D Gain', low=0, high=16383)
    feedforward_velocity: int = parameter(0, doc='Feedforward 1st Gain', low=0, high=16383)
    feedforward_acceleration: int = parameter(0, doc='Feedforward 2nd Gain', low=0, high=16383)


@dataclass(frozen=True, kw_only=True)
class ServoTiming:
    """Periods and time limits of the driver."""

    reply: float = parameter(0.003, doc='time limit of an answer, without its time on the wire',
                             unit='s', low=0.0002, high=0.1)
    silent_after: int = parameter(10, doc='consecutive missing answers after which a servo is '
                                  'silent and only pinged', low=1, high=100)
    probe: float = parameter(0.1, doc='time between two pings of a silent servo', unit='s',
                             low=0.005, high=10)
    health: float = parameter(0.1, doc='period in which all health registers are read once',
                              unit='s', low=0.02, high=10)
    reconnect: float = parameter(0.2, doc='time between attempts to open a lost port',
                                 unit='s', low=0.01, high=10)
    watchdog: float = parameter(0.1, doc='silence of the bus after which the servos stop',
                                unit='s', low=0.02, high=2.54)
    reboot: float = parameter(2.0, doc='time limit of the first answer after a reboot', unit='s',
                              low=0.1, high=10)


@dataclass(frozen=True, kw_only=True)
class ServoBusParameters(ParameterFile, file='servo_bus.yaml'):
    """Four servos on one serial port, in the order of gimbal1 to gimbal4."""

    port: str = parameter(doc='serial port', read_only=True)
    baud_rate: int = parameter(1_000_000, doc='baud rate of the servos', unit='bit/s',
                               low=9600, high=4_000_000, read_only=True)
    ids: np.ndarray = parameter(doc='ID of each servo', shape=(4,), low=0, high=252,
                                read_only=True)
    signs: np.ndarray = parameter(doc='+1 or -1: counts rise or fall with the tilt', shape=(4,),
                                  low=-1, high=1, read_only=True)
    zeros: np.ndarray = parameter(doc='reading at zero tilt', unit='counts', shape=(4,), low=0,
                                  high=4095, read_only=True)
    current_limit: float = parameter(0.91, doc='largest current', unit='A', low=0.02, high=0.91,
                                     read_only=True)
    torque_per_current: float = parameter(
        0.671, doc='torque in joint_states for each ampere', unit='N m/A', low=0, high=100)
    gains: ServoGains = group(ServoGains, 'position controller')
    timing: ServoTiming = group(ServoTiming, 'periods and time limits')
    reboot_after_overload: bool = parameter(
        True, doc='restart a servo that shut down while torque was on (not when overheated)')
    recoveries: int = parameter(3, doc='restarts of one servo after which it stays off', low=0,
                                high=1000)
    guard: bool = parameter(True, doc='a second process switches the torque off if the driver is '
                            'killed', read_only=True)
    confirm_tilts: bool = parameter(False, doc='use confirmed_tilts if the turn of a joint is '
                                     'ambiguous')
    confirmed_tilts: np.ndarray = parameter(
        [0, 0, 0, 0], doc='tilts measured by the operator, correct to half a turn', unit='rad',
        shape=(4,), low=-10, high=10)

    def __post_init__(self):
        """Check IDs, zeros, signs and baud rate."""
        for name in ('ids', 'zeros'):
            values = getattr(self, name)
            if np.any(values != np.round(values)):
                raise ParameterError(f'{name} must be whole numbers, found {values}')
        if len(set(self.ids)) != len(self.ids):
            raise ParameterError(f'ids must differ, found {self.ids.astype(int)}')
        if not np.all(np.abs(self.signs) == 1):
            raise ParameterError(f'signs must be +1 or -1, found {self.signs}')
        if self.baud_rate not in BAUD_CODES:
            raise ParameterError(f"baud_rate {self.baud_rate} is none of the servos' "
                                 f'{", ".join(map(str, BAUD_CODES))}')


@dataclass(frozen=True, kw_only=True)
class MotorBoardParameters(ParameterFile, file='motor_board.yaml'):
    """Port, MAVLink IDs, rates and time limits of the driver of the motor board."""

    port: str = parameter(doc='serial port', read_only=True)
    baud: int = parameter(
        921600, doc='baud rate of the port', unit='bit/s', low=9600, high=4000000, read_only=True)
    board_system: int = parameter(1, doc="board's MAVLink system ID", low=1, high=255)
    board_component: int = parameter(1, doc="board's MAVLink component ID", low=1, high=255)
    host_system: int = parameter(1, doc='MAVLink system ID of this computer', low=1, high=255)
    host_component: int = parameter(
        191, doc='MAVLink component ID of this computer', low=1, high=255)
    target_rate: float = parameter(
        200.0, doc='rate of the targets, new or repeated', unit='Hz', low=20, high=1000,
        read_only=True)
    heartbeat_rate: float = parameter(
        5.0, doc='rate of heartbeats to the board', unit='Hz', low=1, high=50)
    timesync_rate: float = parameter(5.0, doc='rate of time requests', unit='Hz', low=0.1, high=50)
    clock_drift: float = parameter(
        100.0e-6, doc='bound of the relative drift of the clocks', unit='s/s', low=0, high=0.01)
    clock_uncertainty_limit: float = parameter(
        0.02, doc="error bound of the board's clock offset; a warning above", unit='s', low=1e-4,
        high=1)
    stamp_age_limit: float = parameter(
        0.1, doc='oldest stamp of a target that is sent', unit='s', low=0.01, high=1)
    silence: float = parameter(
        0.3, doc='time without a packet after which the board is silent', unit='s', low=0.05,
        high=5)
    reconnect_period: float = parameter(
        0.5, doc='time between attempts to open a lost port', unit='s', low=0.01, high=60)
    acknowledge_timeout: float = parameter(
        0.1, doc='time until an unacknowledged command is repeated', unit='s', low=0.01, high=5)
    acknowledge_attempts: int = parameter(
        5, doc='number of times that a command is sent', low=1, high=50)
    voltage_time_constant: float = parameter(
        0.05, doc='time constant of the voltage filter before the thrust map', unit='s', low=0,
        high=5)
    cell_voltage_low: float = parameter(
        2.5, doc='smallest plausible cell voltage', unit='V', low=0, high=5)
    cell_voltage_high: float = parameter(
        4.4, doc='largest plausible cell voltage', unit='V', low=0, high=6)
