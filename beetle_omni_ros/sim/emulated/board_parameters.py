"""Parameters of the emulated motor board; read from params/emulated_board.yaml."""

from dataclasses import dataclass

from beetle_omni_ros.robot.schema import parameter, ParameterFile


@dataclass(frozen=True, kw_only=True)
class EmulatedBoardParameters(ParameterFile, file='emulated_board.yaml'):
    """Parameters of the firmware contract and of the emulated sensors."""

    system: int = parameter(doc='MAVLink system ID', low=1, high=255)
    component: int = parameter(doc='MAVLink component ID', low=1, high=255)
    host_system: int = parameter(doc='system ID of the accepted sender', low=1, high=255)
    host_component: int = parameter(doc='component ID of the accepted sender', low=1,
                                    high=255)
    target_timeout: float = parameter(doc='time without a new target after which the rotors stop',
                                      unit='s', low=0.01, high=1)
    heartbeat_timeout: float = parameter(doc='time without a heartbeat after which it disarms',
                                         unit='s', low=0.1, high=10)
    idle_timeout: float = parameter(doc='time armed without a target after which it disarms',
                                    unit='s', low=0.1, high=60)
    throttle_low_time: float = parameter(doc='time without a nonzero target before arming',
                                         unit='s', low=0, high=10)
    target_age_limit: float = parameter(doc='largest age of a target', unit='s', low=0.01, high=10)
    target_future_limit: float = parameter(doc='largest lead of a stamp over the clock',
                                           unit='s', low=0, high=10)
    watchdog_time: float = parameter(doc='time from a hang to the reset', unit='s', low=0.001,
                                     high=1)
    boot_time: float = parameter(doc='time from a reset to the first heartbeat', unit='s', low=0,
                                 high=10)
    arm_cell_voltage: float = parameter(doc='smallest cell voltage for arming', unit='V', low=0,
                                        high=5)
    heartbeat_rate: float = parameter(doc='rate of HEARTBEAT', unit='Hz', low=1, high=50)
    battery_rate: float = parameter(doc='rate of BATTERY_STATUS', unit='Hz', low=1, high=200)
    rotor_rate: float = parameter(doc='rate of ESC_STATUS', unit='Hz', low=1, high=500)
    rotor_info_rate: float = parameter(doc='rate of ESC_INFO', unit='Hz', low=0.1, high=50)
    reception_rate: float = parameter(doc='rate of SYS_STATUS', unit='Hz', low=0.1, high=50)
    clock_start: float = parameter(doc='clock of the board at the start', unit='s', low=0,
                                   high=1e6)
    clock_drift: float = parameter(doc='drift of the clock of the board', unit='s/s', low=-0.01,
                                   high=0.01)
    rpm_at_1_newton: float = parameter(doc='speed of a rotor at 1 N', unit='1/min', low=1,
                                       high=1e5)
    idle_temperature: float = parameter(doc='temperature of the ESCs', unit='C', low=-40, high=150)
