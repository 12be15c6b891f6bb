"""Parameters of both devices; read from params/servo_bus.yaml and params/motor_board.yaml."""

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.model.schema import parameter, ParameterError, ParameterFile

BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)  # of servos


@dataclass(frozen=True, kw_only=True)
class ServoBusParameters(ParameterFile, file='servo_bus.yaml'):
    """Four servos on one serial port, in the order of gimbal1 to gimbal4."""

    port: str = parameter(doc='serial port')
    baud_rate: int = parameter(1_000_000, doc='baud rate of the servos', unit='bit/s',
                               low=9600, high=4_000_000)
    ids: np.ndarray = parameter(doc='ID of each servo', shape=(4,), low=0, high=252)
    signs: np.ndarray = parameter(doc='+1 or -1: counts rise or fall with the tilt', shape=(4,),
                                  low=-1, high=1)
    zeros: np.ndarray = parameter(doc='reading at zero tilt', unit='counts', shape=(4,), low=0,
                                  high=4095)
    current_limit: float = parameter(0.91, doc='largest current', unit='A', low=0.02, high=0.91)
    position_p_gain: int = parameter(900, doc='Position P Gain(84)', low=0, high=16383)
    position_i_gain: int = parameter(0, doc='Position I Gain(82)', low=0, high=16383)
    position_d_gain: int = parameter(0, doc='Position D Gain(80)', low=0, high=16383)
    reply_time: float = parameter(
        0.003, doc='time limit of an answer, without its time on the wire', unit='s', low=0.0002,
        high=0.1)
    guard: bool = parameter(True, doc='a second process switches the torque off if the driver is '
                            'killed')

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
        if self.baud_rate not in BAUD_RATES:
            raise ParameterError(f"baud_rate {self.baud_rate} is none of the servos' "
                                 f'{", ".join(map(str, BAUD_RATES))}')


@dataclass(frozen=True, kw_only=True)
class MotorBoardParameters(ParameterFile, file='motor_board.yaml'):
    """Port of the motor board, and when it is silent."""

    port: str = parameter(doc='serial port')
    baud: int = parameter(
        921600, doc='baud rate of the port', unit='bit/s', low=9600, high=4000000)
    silence: float = parameter(
        0.3, doc='time without a packet after which the board is silent', unit='s', low=0.05,
        high=5)
