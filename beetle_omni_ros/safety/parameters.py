"""The supervisor's parameters; params/supervisor.yaml gives the reasons of their values."""

from dataclasses import dataclass

from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.schema import group, parameter, ParameterFile
from beetle_omni_ros.safety.levelling import LevellingParameters
from beetle_omni_ros.safety.turnover import TurnoverParameters
from beetle_omni_ros.safety.watch.parameters import Detection


@dataclass(frozen=True, kw_only=True)
class CommandLimits:
    """When a command is refused and when a controller is silent."""

    timeout: float = parameter(
        0.05, doc='time without a command of the active controller until fallback', unit='s',
        low=0.01, high=1)
    stale_after: float = parameter(
        0.05, doc='largest age of the stamp of an arriving command', unit='s', low=0.005, high=1)
    age_limit: float = parameter(
        0.1, doc='largest age of a command that is executed', unit='s', low=0.02, high=1)
    clock_tolerance: float = parameter(
        0.02, doc='largest lead of a stamp over the clock', unit='s', low=0, high=1)
    return_after: float = parameter(
        0.5, doc='time of valid commands before a controller gets control', unit='s', low=0.05,
        high=60)
    overstep: float = parameter(
        0.25, doc='largest excess over a limit, as a share of the range, that is clipped to the '
        'limit', low=0, high=1)
    overstep_time: float = parameter(
        0.5, doc='longest time of clipping without a command within the limits', unit='s', low=0,
        high=5)
    limit_tolerance: float = parameter(
        0.001, doc='excess over a limit that is treated as rounding', unit='rad or N', low=0,
        high=0.1)
    tilt_step: float = parameter(
        2.0, doc='a single larger jump of a tilt target is refused', unit='rad', low=0.1, high=100)
    thrust_step: float = parameter(
        15.0, doc='a single larger jump of a thrust target is refused', unit='N', low=0.1,
        high=200)


@dataclass(frozen=True, kw_only=True)
class HandoverParameters:
    """Largest rates of the command after a change of the controller."""

    time: float = parameter(
        0.3, doc='longest duration; ends early when the command is reached', unit='s', low=0,
        high=5)
    tilt_rate: float = parameter(
        9.0, doc='largest rate of tilt targets', unit='rad/s', low=0.1, high=1000)
    thrust_rate: float = parameter(
        300.0, doc='largest rate of thrust targets', unit='N/s', low=1, high=1e5)


@dataclass(frozen=True, kw_only=True)
class StateLimits:
    """Timeouts of state estimate, joints and raw sensors."""

    timeout: float = parameter(
        0.05, doc='time without an estimate until a controlled descent', unit='s', low=0.01,
        high=1)
    stale_after: float = parameter(
        0.05, doc='largest age of an arriving estimate', unit='s', low=0.005, high=1)
    jump_attitude: float = parameter(
        1.0, doc='a single larger jump of the attitude is refused', unit='rad', low=0.1, high=3.2)
    jump_position: float = parameter(
        1.0, doc='a single larger jump of the position is refused', unit='m', low=0.05, high=100)
    joint_timeout: float = parameter(
        0.2, doc='time without joint feedback until landing', unit='s', low=0.02, high=5)
    imu_timeout: float = parameter(
        0.05, doc='time after which the raw IMU is silent', unit='s', low=0.01, high=1)
    mocap_timeout: float = parameter(
        0.2, doc='time after which the raw MoCap is silent', unit='s', low=0.02, high=5)
    mocap_patience: float = parameter(
        1.5, doc='time without raw MoCap until landing', unit='s', low=0.1, high=60)
    blind_limit: float = parameter(
        0.3, doc='time without any sensor until the motors are switched off', unit='s', low=0.02,
        high=5)


@dataclass(frozen=True, kw_only=True)
class ArmingLimits:
    """Conditions for the start of the motors."""

    tilt: float = parameter(0.35, doc='largest inclination', unit='rad', low=0.01, high=3.15)
    speed: float = parameter(0.3, doc='largest speed', unit='m/s', low=0.01, high=10)
    rate: float = parameter(0.5, doc='largest angular rate', unit='rad/s', low=0.01, high=10)


@dataclass(frozen=True, kw_only=True)
class TakeoffParameters:
    """Climb to the height where the selected controller takes over."""

    height: float = parameter(1.0, doc='height of base_link in world', unit='m', low=0.1, high=20)
    clearance: float = parameter(
        0.3, doc='smallest climb, from a raised platform', unit='m', low=0.05, high=20)
    speed: float = parameter(0.5, doc='climb speed', unit='m/s', low=0.05, high=5)
    acceleration: float = parameter(
        0.5, doc='acceleration of the climb', unit='m/s^2', low=0.05, high=10)
    align_rate: float = parameter(2.0, doc='joint rate before the rotors start', unit='rad/s',
                                  low=0.1, high=10)
    align_tolerance: float = parameter(
        0.1, doc='largest joint error at the start of the rotors', unit='rad', low=0.01, high=1)
    align_patience: float = parameter(
        4.0, doc='longest time until the joints reach their hover angles', unit='s', low=0.1,
        high=60)
    position_tolerance: float = parameter(
        0.15, doc='largest distance from the takeoff pose at the handover', unit='m', low=0.01,
        high=2)
    speed_tolerance: float = parameter(
        0.2, doc='largest speed at the handover', unit='m/s', low=0.01, high=5)
    patience: float = parameter(
        4.0, doc='time after the climb until the takeoff has failed', unit='s', low=0.1, high=60)


@dataclass(frozen=True, kw_only=True)
class LandingParameters:
    """Levelling, descent and detection of the ground."""

    speed: float = parameter(0.3, doc='descent speed', unit='m/s', low=0.05, high=3)
    acceleration: float = parameter(
        0.5, doc='acceleration of the descent', unit='m/s^2', low=0.05, high=10)
    level: LevellingParameters = group(LevellingParameters)
    turnover: TurnoverParameters = group(TurnoverParameters, 'joints wound the wrong way')
    level_first: float = parameter(
        0.3, doc='a larger inclination is levelled before the descent', unit='rad', low=0,
        high=3.15)
    blind_level_rate: float = parameter(1.6, doc='angular rate of the levelling without MoCap',
                                        unit='rad/s', low=0.05, high=5)
    blind_speed: float = parameter(1.0, doc='descent speed without MoCap, until the flare',
                                   unit='m/s', low=0.05, high=3)
    blind_acceleration: float = parameter(
        2.0, doc='acceleration of the descent without MoCap', unit='m/s^2', low=0.05, high=10)
    flare_height: float = parameter(
        0.5, doc='height above the floor at which the descent slows down to speed', unit='m',
        low=0, high=10)
    leap_share: float = parameter(
        0.7, doc='share of the margin used for it', low=0, high=1)
    leap_time: float = parameter(
        0.8, doc='duration of the acceleration upwards before a turn with a weak pack', unit='s',
        low=0, high=3)
    time_limit: float = parameter(
        90.0, doc='longest landing, after which the motors are switched off', unit='s', low=1,
        high=600)
    overdue_acceleration: float = parameter(
        0.3, doc='without MoCap: acceleration of the descent after the expected touchdown',
        unit='m/s^2', low=0, high=2)
    overdue_limit: float = parameter(
        6.0, doc='without MoCap: time from the expected touchdown until the motors are switched '
        'off', unit='s', low=0.1, high=60)
    target_lead: float = parameter(
        0.5, doc='largest depth of the target below the robot', unit='m', low=0.05, high=5)
    ground_speed: float = parameter(
        0.12, doc='vertical speed below which the robot may stand on the ground', unit='m/s',
        low=0.01, high=1)
    ground_support: float = parameter(
        0.2, doc='share of the weight that the ground carries', low=0.05, high=0.9)
    ground_time: float = parameter(
        0.3, doc='duration of both conditions after which the robot stands', unit='s', low=0.02,
        high=5)
    platform_height: float = parameter(
        0.3, doc='height above the floor of the takeoff beyond which `platform_time` applies',
        unit='m', low=0.0, high=10)
    platform_time: float = parameter(
        1.0, doc='duration of both conditions after which the robot stands on a platform',
        unit='s', low=0.02, high=10)


@dataclass(frozen=True, kw_only=True)
class BackupParameters:
    """The backup estimator."""

    position_bandwidth: float = parameter(
        8.0, doc='bandwidth of MoCap corrections of position', unit='rad/s', low=0.5, high=50)
    attitude_bandwidth: float = parameter(
        5.0, doc='bandwidth of MoCap corrections of attitude', unit='rad/s', low=0.5, high=50)
    attitude_bandwidth_without_gyroscope: float = parameter(
        12.0, doc='the same without IMU', unit='rad/s', low=0.5, high=50)
    bias_time: float = parameter(
        2.0, doc='time constant with which the IMU biases follow those of the estimator', unit='s',
        low=0.1, high=100)
    velocity_leak_time: float = parameter(
        3.0, doc='time constant of the velocity towards the desired one without MoCap', unit='s',
        low=0.2, high=100)
    error_limit: float = parameter(
        0.2, doc='larger MoCap corrections are limited to this', unit='m or rad', low=0.01, high=5)


@dataclass(frozen=True, kw_only=True)
class BatteryLimits:
    """Voltage of a cell, under load."""

    arm: float = parameter(3.5, doc='smallest voltage for arming', unit='V', low=2.5, high=4.4)
    warn: float = parameter(
        3.4, doc='a lower voltage gives a warning', unit='V', low=2.5, high=4.4)
    land: float = parameter(
        3.2, doc='a lower voltage starts a landing', unit='V', low=2.0, high=4.4)
    time: float = parameter(
        2.0, doc='duration of a low voltage until the reaction', unit='s', low=0.1, high=60)


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """Flight envelope, without attitude, because any attitude is legal."""

    half_width: float = parameter(
        20.0, doc='largest |x| and |y| in world', unit='m', low=0.5, high=1000)
    height: float = parameter(20.0, doc='largest z in world', unit='m', low=0.5, high=1000)
    fence_reaction: str = parameter(
        'landing', doc='reaction outside the fence', choices=('none', 'landing', 'emergency_stop'))
    fence_margin: float = parameter(
        2.0, doc='distance outside the fence at which a landing switches the motors off', unit='m',
        low=0, high=100)
    recovery_time: float = parameter(
        1.0, doc='time in which a landing may recover a robot that tumbles or is outside the '
        'fence', unit='s', low=0, high=60)
    fallback_time: float = parameter(
        30.0, doc='longest fallback until landing', unit='s', low=1, high=3600)
    rate: float = parameter(
        15.0, doc='angular rate above which the robot tumbles', unit='rad/s', low=1, high=100)
    fall_speed: float = parameter(
        6.0, doc='downward speed above which the robot falls; in a landing any speed', unit='m/s',
        low=0.5, high=100)
    lost_time: float = parameter(
        0.3, doc='duration of tumbling or falling until the reaction', unit='s', low=0.02, high=10)
    lost_reaction: str = parameter(
        'fallback', doc='reaction to tumbling or falling',
        choices=( 'none', 'fallback', 'landing', 'emergency_stop'))


@dataclass(frozen=True, kw_only=True)
class SupervisorParameters(ParameterFile, file='supervisor.yaml'):
    """All parameters of the supervisor."""

    controller: str = parameter(registry.DEFAULT, doc='the active controller, also in flight')
    commands: CommandLimits = group(CommandLimits)
    handover: HandoverParameters = group(HandoverParameters)
    state: StateLimits = group(StateLimits)
    arming: ArmingLimits = group(ArmingLimits)
    takeoff: TakeoffParameters = group(TakeoffParameters)
    landing: LandingParameters = group(LandingParameters)
    backup: BackupParameters = group(BackupParameters)
    battery: BatteryLimits = group(BatteryLimits)
    envelope: Envelope = group(Envelope)
    detection: Detection = group(Detection)
    tick_limit: float = parameter(
        0.02, doc='a longer pause of the supervisor is treated as this', unit='s', low=0.005,
        high=0.5)
    stop_time: float = parameter(
        0.3, doc='time for which zero thrust is commanded before silence', unit='s', low=0, high=5)
    quiet_time: float = parameter(
        1.0, doc='time in which the same message is logged once', unit='s', low=0, high=60)
