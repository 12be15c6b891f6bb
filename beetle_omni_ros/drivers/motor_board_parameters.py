"""Parameters of the link to the motor board; read from params/motor_board.yaml."""

from dataclasses import dataclass

from beetle_omni_ros.robot.schema import parameter, ParameterFile


@dataclass(frozen=True, kw_only=True)
class MotorBoardParameters(ParameterFile, file='motor_board.yaml'):
    """Port, MAVLink IDs, rates and time limits of the driver of the motor board."""

    port: str = parameter(doc='serial port', read_only=True)
    baud: int = parameter(doc='baud rate of the port', unit='bit/s', low=9600,
                          high=4000000, read_only=True)
    board_system: int = parameter(doc="board's MAVLink system ID", low=1, high=255)
    board_component: int = parameter(doc="board's MAVLink component ID", low=1, high=255)
    host_system: int = parameter(doc='MAVLink system ID of this computer', low=1, high=255)
    host_component: int = parameter(doc='MAVLink component ID of this computer', low=1,
                                    high=255)
    target_rate: float = parameter(doc='rate of the targets, new or repeated', unit='Hz',
                                   low=20, high=1000, read_only=True)
    heartbeat_rate: float = parameter(doc='rate of heartbeats to the board', unit='Hz', low=1,
                                      high=50)
    timesync_rate: float = parameter(doc='rate of time requests', unit='Hz', low=0.1, high=50)
    clock_drift: float = parameter(doc='bound of the relative drift of the clocks', unit='s/s',
                                   low=0, high=0.01)
    clock_uncertainty_limit: float = parameter(
        doc="error bound of the board's clock offset; a warning above", unit='s', low=1e-4, high=1)
    stamp_age_limit: float = parameter(doc='oldest stamp of a target that is sent', unit='s',
                                       low=0.01, high=1)
    silence: float = parameter(doc='time without a packet after which the board is silent',
                               unit='s', low=0.05, high=5)
    reconnect_period: float = parameter(doc='time between attempts to open a lost port',
                                        unit='s', low=0.01, high=60)
    acknowledge_timeout: float = parameter(doc='time until an unacknowledged command is repeated',
                                           unit='s', low=0.01, high=5)
    acknowledge_attempts: int = parameter(doc='number of times that a command is sent', low=1,
                                          high=50)
    voltage_time_constant: float = parameter(
        doc='time constant of the voltage filter before the thrust map', unit='s', low=0, high=5)
    cell_voltage_low: float = parameter(doc='smallest plausible cell voltage', unit='V', low=0,
                                        high=5)
    cell_voltage_high: float = parameter(doc='largest plausible cell voltage', unit='V', low=0,
                                         high=6)
