"""The supervisor's parameters; params/supervisor.yaml gives the reasons of their values."""

from __future__ import annotations

from dataclasses import dataclass

from beetle_omni_ros.control import registry
from beetle_omni_ros.robot.schema import group, parameter, ParameterFile
from beetle_omni_ros.safety.levelling import LevellingParameters
from beetle_omni_ros.safety.turnover import TurnoverParameters
from beetle_omni_ros.safety.watch.parameters import Detection


@dataclass(frozen=True, kw_only=True)
class CommandLimits:
    """When a command is refused and when a controller is silent."""

    timeout: float = parameter(0.05, doc='silence of the active controller: fallback', unit='s',
                               low=0.01, high=1)
    stale_after: float = parameter(0.05, doc='older stamps are refused on arrival', unit='s',
                                   low=0.005, high=1)
    age_limit: float = parameter(0.1, doc='no command is executed beyond this age', unit='s',
                                 low=0.02, high=1)
    clock_tolerance: float = parameter(0.02, doc='stamps farther ahead are refused', unit='s',
                                       low=0, high=1)
    return_after: float = parameter(0.5, doc='good time before a controller gets control',
                                    unit='s', low=0.05, high=60)
    overstep: float = parameter(
        0.25, doc='overstep of a limit, as a share of the range, that is executed at the limit',
        low=0, high=1)
    overstep_time: float = parameter(0.5, doc='for at most this long without a good command',
                                     unit='s', low=0, high=5)
    limit_tolerance: float = parameter(0.001, doc='overstep of a limit that is cut off instead',
                                       unit='rad or N', low=0, high=0.1)
    tilt_step: float = parameter(2.0, doc='a lone larger jump of a tilt target is refused',
                                 unit='rad', low=0.1, high=100)
    thrust_step: float = parameter(15.0, doc='a lone larger jump of a thrust target is refused',
                                   unit='N', low=0.1, high=200)


@dataclass(frozen=True, kw_only=True)
class HandoverParameters:
    """Largest rates of the command after a change of the controller."""

    time: float = parameter(0.3, doc='longest; ends when the command has caught up', unit='s',
                            low=0, high=5)
    tilt_rate: float = parameter(9.0, doc='of tilt targets', unit='rad/s', low=0.1, high=1000)
    thrust_rate: float = parameter(300.0, doc='of thrust targets', unit='N/s', low=1, high=1e5)


@dataclass(frozen=True, kw_only=True)
class StateLimits:
    """Timeouts of state estimate, joints and raw sensors."""

    timeout: float = parameter(0.05, doc='silence of the estimator: controlled descent', unit='s',
                               low=0.01, high=1)
    stale_after: float = parameter(0.05, doc='older estimates are refused', unit='s', low=0.005,
                                   high=1)
    jump_attitude: float = parameter(1.0, doc='a lone larger jump of the attitude is refused',
                                     unit='rad', low=0.1, high=3.2)
    jump_position: float = parameter(1.0, doc='a lone larger jump of the position is refused',
                                     unit='m', low=0.05, high=100)
    joint_timeout: float = parameter(0.2, doc='silence of the joint feedback: landing', unit='s',
                                     low=0.02, high=5)
    imu_timeout: float = parameter(0.05, doc='silence of the raw IMU', unit='s', low=0.01, high=1)
    mocap_timeout: float = parameter(0.2, doc='silence of the raw MoCap', unit='s', low=0.02,
                                     high=5)
    mocap_patience: float = parameter(1.5, doc='silence of the raw MoCap: landing', unit='s',
                                      low=0.1, high=60)
    blind_limit: float = parameter(0.3, doc='time without any sensor before motors off', unit='s',
                                   low=0.02, high=5)


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
    clearance: float = parameter(0.3, doc='least climb, from a raised platform', unit='m',
                                 low=0.05, high=20)
    speed: float = parameter(0.5, doc='climb speed', unit='m/s', low=0.05, high=5)
    acceleration: float = parameter(0.5, doc='of the climb', unit='m/s^2', low=0.05, high=10)
    align_rate: float = parameter(2.0, doc='joint rate before the rotors start', unit='rad/s',
                                  low=0.1, high=10)
    align_tolerance: float = parameter(0.1, doc='joint error allowed before start', unit='rad',
                                       low=0.01, high=1)
    align_patience: float = parameter(4.0, doc='time for the joints to get there', unit='s',
                                      low=0.1, high=60)
    position_tolerance: float = parameter(0.15, doc='hand over within this distance', unit='m',
                                          low=0.01, high=2)
    speed_tolerance: float = parameter(0.2, doc='hand over below this speed', unit='m/s', low=0.01,
                                       high=5)
    patience: float = parameter(4.0, doc='time after the climb before it counts as failed',
                                unit='s', low=0.1, high=60)


@dataclass(frozen=True, kw_only=True)
class LandingParameters:
    """Levelling, descent and detection of the ground."""

    speed: float = parameter(0.3, doc='descent speed', unit='m/s', low=0.05, high=3)
    acceleration: float = parameter(0.5, doc='of the descent', unit='m/s^2', low=0.05, high=10)
    level: LevellingParameters = group(LevellingParameters)
    turnover: TurnoverParameters = group(TurnoverParameters, 'joints wound the wrong way')
    level_first: float = parameter(0.3, doc='more inclination is levelled before the descent',
                                   unit='rad', low=0, high=3.15)
    blind_level_rate: float = parameter(1.6, doc='angular rate of the levelling without MoCap',
                                        unit='rad/s', low=0.05, high=5)
    blind_speed: float = parameter(1.0, doc='descent speed without MoCap, until the flare',
                                   unit='m/s', low=0.05, high=3)
    blind_acceleration: float = parameter(2.0, doc='the same', unit='m/s^2', low=0.05, high=10)
    flare_height: float = parameter(0.5, doc='above the floor, where it slows down to speed',
                                    unit='m', low=0, high=10)
    time_limit: float = parameter(90.0, doc='longest landing, then motors off', unit='s', low=1,
                                  high=600)
    overdue_acceleration: float = parameter(
        0.6, doc='without MoCap, growth of the descent speed once the ground is overdue',
        unit='m/s^2', low=0, high=2)
    overdue_limit: float = parameter(6.0, doc='without MoCap, motors off this long after the '
                                     'ground was due', unit='s', low=0.1, high=60)
    target_lead: float = parameter(0.5, doc='the target sinks at most this far below the robot',
                                   unit='m', low=0.05, high=5)
    ground_speed: float = parameter(0.12, doc='vertical speed below which it may stand',
                                    unit='m/s', low=0.01, high=1)
    ground_support: float = parameter(0.2, doc='share of the weight that the rotors do not carry',
                                      low=0.05, high=0.9)
    ground_time: float = parameter(0.3, doc='for this long, then the robot stands', unit='s',
                                   low=0.02, high=5)


@dataclass(frozen=True, kw_only=True)
class BackupParameters:
    """The backup estimator."""

    position_bandwidth: float = parameter(8.0, doc='of MoCap corrections of position',
                                          unit='rad/s', low=0.5, high=50)
    attitude_bandwidth: float = parameter(5.0, doc='of MoCap corrections of attitude',
                                          unit='rad/s', low=0.5, high=50)
    attitude_bandwidth_without_gyroscope: float = parameter(
        12.0, doc='the same when the IMU is gone too', unit='rad/s', low=0.5, high=50)
    bias_time: float = parameter(2.0, doc='over which IMU biases are learnt from the estimator',
                                 unit='s', low=0.1, high=100)
    velocity_leak_time: float = parameter(
        3.0, doc='time constant of the velocity towards the desired one without MoCap', unit='s',
        low=0.2, high=100)
    error_limit: float = parameter(0.2, doc='larger MoCap corrections are shortened',
                                   unit='m or rad', low=0.01, high=5)


@dataclass(frozen=True, kw_only=True)
class BatteryLimits:
    """Voltage of a cell, under load."""

    arm: float = parameter(3.5, doc='arming needs at least this', unit='V', low=2.5, high=4.4)
    warn: float = parameter(3.4, doc='warning below', unit='V', low=2.5, high=4.4)
    land: float = parameter(3.2, doc='landing below', unit='V', low=2.0, high=4.4)
    time: float = parameter(2.0, doc='for this long', unit='s', low=0.1, high=60)


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """Flight envelope, without attitude, because any attitude is legal."""

    half_width: float = parameter(20.0, doc='|x| and |y| in world', unit='m', low=0.5, high=1000)
    height: float = parameter(20.0, doc='z in world', unit='m', low=0.5, high=1000)
    fence_reaction: str = parameter('landing', doc='on leaving it',
                                    choices=('none', 'landing', 'emergency_stop'))
    fence_margin: float = parameter(2.0, doc='outside the fence by so much while landing: motors '
                                    'off', unit='m', low=0, high=100)
    recovery_time: float = parameter(1.0, doc='in which a landing may bring a robot that tumbles '
                                     'or has left the fence back', unit='s', low=0, high=60)
    fallback_time: float = parameter(30.0, doc='longest fallback, then landing', unit='s', low=1,
                                     high=3600)
    rate: float = parameter(15.0, doc='tumbling above this angular rate', unit='rad/s', low=1,
                            high=100)
    fall_speed: float = parameter(6.0, doc='falling above this speed downwards', unit='m/s',
                                  low=0.5, high=100)
    lost_time: float = parameter(0.3, doc='for this long', unit='s', low=0.02, high=10)
    lost_reaction: str = parameter('fallback', doc='on tumbling or falling', choices=(
        'none', 'fallback', 'landing', 'emergency_stop'))


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
    tick_limit: float = parameter(0.02, doc='longer pauses of the supervisor itself count as this',
                                  unit='s', low=0.005, high=0.5)
    stop_time: float = parameter(0.3, doc='zero thrust is commanded this long, then nothing',
                                 unit='s', low=0, high=5)
    quiet_time: float = parameter(1.0, doc='a repeated complaint is said once in this time',
                                  unit='s', low=0, high=60)
