"""The estimator's parameters (params/ekf.yaml)."""

from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.schema import group, parameter, ParameterFile


@dataclass(frozen=True, kw_only=True)
class ImuParameters:
    """Noise, mounting and plausible range of the IMU."""

    rate: float = parameter(
        200.0, doc='nominal sample rate', unit='Hz', low=20, high=4000)
    accelerometer_noise: float = parameter(
        0.05, doc='standard deviation of one specific-force sample, each axis', unit='m/s^2',
        low=1e-5, high=10)
    gyroscope_noise: float = parameter(
        0.005, doc='standard deviation of one angular-rate sample, each axis', unit='rad/s',
        low=1e-6, high=1)
    accelerometer_bias_walk: float = parameter(
        0.003, doc='random walk of the accelerometer bias', unit='m/s^2/sqrt(s)', low=0, high=1)
    gyroscope_bias_walk: float = parameter(
        0.0001, doc='random walk of the gyroscope bias', unit='rad/s/sqrt(s)', low=0, high=1)
    position: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc='position in base_link', unit='m', shape=(3,), low=-5, high=5)
    rotation: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc='rotation vector from IMU axes to base_link axes', unit='rad',
        shape=(3,), low=-3.2, high=3.2)
    accelerometer_bias: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc='known part of the bias, in the axes of the IMU', unit='m/s^2',
        shape=(3,), low=-10, high=10)
    gyroscope_bias: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc='known part of the bias, in the axes of the IMU', unit='rad/s',
        shape=(3,), low=-1, high=1)
    specific_force_limit: float = parameter(
        160.0, doc='larger readings are refused', unit='m/s^2', low=10, high=2000)
    angular_velocity_limit: float = parameter(
        40.0, doc='larger readings are refused', unit='rad/s', low=1, high=200)
    impact_change: float = parameter(
        30.0, doc='change of the specific force between two samples that counts as an impact of '
        'unknown impulse', unit='m/s^2', low=1, high=2000)
    spike_change: float = parameter(
        3.0, doc='change of the angular rate above which a single reading is refused; that of the '
        'specific force is impact_change', unit='rad/s', low=0.1, high=200)
    frozen_samples: int = parameter(
        10, doc='number of equal samples from which they are refused while the MoCap moves',
        low=2, high=10000)
    gap_limit: float = parameter(
        0.1, doc='longest bridged time between two samples', unit='s', low=0.001, high=1)
    resync_samples: int = parameter(
        20, doc='number of refused consistent stamps in a row after which they are accepted and '
        'the state is lost', low=2, high=10000)


@dataclass(frozen=True, kw_only=True)
class MocapParameters:
    """Noise, mounting, delay and gating of the MoCap."""

    position_noise: float = parameter(
        0.001, doc='standard deviation of a position, each axis', unit='m', low=1e-6, high=1)
    orientation_noise: float = parameter(
        0.0017453292519943296, doc='standard deviation of an orientation, each axis', unit='rad',
        low=1e-6, high=1)
    position: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc='position of the marker body in base_link', unit='m', shape=(3,),
        low=-5,
        high=5)
    rotation: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc="rotation vector from the marker body's axes to base_link axes",
        unit='rad', shape=(3,), low=-3.2, high=3.2)
    time_offset: float = parameter(
        0.0, doc='added to the stamps to convert them to the clock of the IMU', unit='s', low=-1,
        high=1)
    delay_limit: float = parameter(
        0.2, doc='largest age of a pose against the newest IMU sample', unit='s',
        low=0.005, high=2)
    noise_scale_limit: float = parameter(
        20.0, doc='largest factor on both noises from their measurement; 1 switches it off',
        low=1, high=1000)
    gate_probability: float = parameter(
        0.99999, doc='fraction of good poses that passes the chi-square gate', low=0.5,
        high=0.9999999999)
    quaternion_tolerance: float = parameter(
        0.01, doc='largest deviation of the norm of a quaternion from 1', low=1e-6, high=0.5)
    position_limit: float = parameter(
        100.0, doc='larger coordinates are refused', unit='m', low=0.1, high=1e5)
    frozen_poses: int = parameter(
        5, doc='number of equal poses from which they are refused while the IMU moves', low=1,
        high=1000)


@dataclass(frozen=True, kw_only=True)
class InitialParameters:
    """Uncertainty of the first state."""

    velocity_std: float = parameter(
        5.0, doc='standard deviation of the velocity', unit='m/s', low=0.01, high=100)
    accelerometer_bias_std: float = parameter(
        0.2, doc='standard deviation of the accelerometer bias', unit='m/s^2', low=1e-6, high=10)
    gyroscope_bias_std: float = parameter(
        0.05, doc='standard deviation of the gyroscope bias', unit='rad/s', low=1e-6, high=1)
    time_offset: float = parameter(
        0.0, doc='stamps of the IMU minus stamps of the MoCap at one instant', unit='s',
        low=-0.2, high=0.2)
    time_offset_std: float = parameter(
        0.01, doc='standard deviation of the offset between the clocks; 0: no offset',
        unit='s', low=0, high=0.1)


@dataclass(frozen=True, kw_only=True)
class TimeOffsetParameters:
    """Offset between the clocks of IMU and MoCap, estimated in flight."""

    limit: float = parameter(
        0.05, doc='largest estimated offset', unit='s', low=0, high=0.2)
    walk: float = parameter(
        0.00001, doc='random walk', unit='s/sqrt(s)', low=0, high=1)
    speed: float = parameter(
        0.1, doc='speed below which it is not estimated', unit='m/s', low=0.001, high=10)
    rate: float = parameter(
        0.2, doc='rotation below which it is not estimated', unit='rad/s', low=0.001, high=10)
    trend_samples: int = parameter(
        3, doc='number of readings in the trend that extrapolates a delayed rate; 1: constant',
        low=1, high=100)


@dataclass(frozen=True, kw_only=True)
class StatusParameters:
    """Limits of the status, and recovery of a lost state."""

    dead_reckoning_after: float = parameter(
        0.1, doc='time without an accepted pose until dead_reckoning', unit='s', low=0.01,
        high=10)
    lost_after: float = parameter(
        20.0, doc='time without an accepted pose until lost', unit='s', low=0.02, high=600)
    lost_position_std: float = parameter(
        5.0, doc='standard deviation of the position, each axis, above which the state is lost',
        unit='m', low=0.001, high=100)
    start_poses: int = parameter(
        20, doc='consecutive poses that must agree with the IMU before the first fix and when '
        'lost', low=2, high=10000)
    jump_poses: int = parameter(
        100, doc='consecutive poses that must agree with the IMU and with each other before a '
        'persistent jump is accepted', low=2, high=10000)
    jump_attitude: float = parameter(
        0.35, doc='largest accepted jump of the attitude; the gyroscope rules out larger ones',
        unit='rad', low=0.01, high=4)


@dataclass(frozen=True, kw_only=True)
class DoubtParameters:
    """Uncertainty that is added if the IMU contradicts poses that are smooth in themselves."""

    poses: int = parameter(
        3, doc='consecutive poses that must contradict', low=1, high=1000)
    time: float = parameter(
        1.0, doc='duration after that in which a single pose suffices', unit='s', low=0, high=100)
    distance: float = parameter(
        0.05, doc='step from the last good pose above which the MoCap has jumped', unit='m',
        low=0.001, high=10)
    angle: float = parameter(
        0.05, doc='rotation from the last good pose above which the MoCap has jumped', unit='rad',
        low=0.001, high=3)
    speed: float = parameter(
        2.0, doc='increase of distance for each second since the last good pose',
        unit='m/s', low=0, high=100)
    rate: float = parameter(
        8.0, doc='increase of angle for each second since the last good pose',
        unit='rad/s', low=0, high=100)
    position_std: float = parameter(
        0.05, doc='added standard deviation of the position', unit='m', low=1e-4, high=10)
    velocity_std: float = parameter(
        0.5, doc='added standard deviation of the velocity', unit='m/s', low=0.001, high=100)
    attitude_std: float = parameter(
        0.01, doc='added standard deviation of the attitude', unit='rad', low=0.001, high=3)
    accelerometer_bias_std: float = parameter(
        1.0, doc='added standard deviation of the accelerometer bias', unit='m/s^2', low=1e-6,
        high=100)
    gyroscope_bias_std: float = parameter(
        3.0, doc='added standard deviation of the gyroscope bias', unit='rad/s', low=1e-6,
        high=100)


@dataclass(frozen=True, kw_only=True)
class DeadReckoningParameters:
    """Separation of accelerometer bias and attitude error of the markers, for dead reckoning."""

    accelerometer_bias_std: float = parameter(
        0.03, doc='standard deviation of the true bias, each axis', unit='m/s^2', low=1e-6,
        high=10)
    marker_attitude_std: float = parameter(
        0.006, doc="standard deviation of the markers' attitude error, each axis; 0: none",
        unit='rad', low=0, high=0.3)
    velocity_walk: float = parameter(
        0.01, doc='random walk of the integrated acceleration', unit='m/s/sqrt(s)', low=1e-6,
        high=10)
    velocity_walk_by_rate: float = parameter(
        0.1, doc='the same in proportion to the body rate', unit='m/sqrt(s)/rad', low=0, high=10)


@dataclass(frozen=True, kw_only=True)
class EkfParameters(ParameterFile, file='ekf.yaml'):
    """Parameters of :class:`~beetle_omni_ros.estimation.ekf.ErrorStateEkf`."""

    imu: ImuParameters = group(ImuParameters)
    mocap: MocapParameters = group(MocapParameters)
    initial: InitialParameters = group(InitialParameters)
    time_offset: TimeOffsetParameters = group(TimeOffsetParameters)
    doubt: DoubtParameters = group(DoubtParameters)
    status: StatusParameters = group(StatusParameters)
    dead_reckoning: DeadReckoningParameters = group(DeadReckoningParameters)

    def __post_init__(self):
        """Check the times against each other."""
        if self.status.lost_after <= self.status.dead_reckoning_after:
            raise schema.ParameterError(
                f'status.lost_after ({self.status.lost_after:g} s) must be above '
                f'status.dead_reckoning_after ({self.status.dead_reckoning_after:g} s)')
        if self.imu.gap_limit * self.imu.rate < 1:
            raise schema.ParameterError(
                f'imu.gap_limit ({self.imu.gap_limit:g} s) is shorter than one sample at imu.rate '
                f'({self.imu.rate:g} Hz)')

    def of_robot(self, robot: RobotParameters):
        """
        Combine the parameters with the sensor effects of a robot file.

        Mountings of the effects replace those of the parameters; biases and delays are added. A
        delay of the MoCap is subtracted from its time offset. A delay of the IMU is extrapolated,
        as a latency that is estimated in flight.
        """
        e, imu, mocap = robot.sensors, self.imu, self.mocap

        def mounted(own, effect):
            return np.array(effect) if any(effect) else own

        return replace(
            self, imu=replace(
                imu, rotation=mounted(imu.rotation, e.imu_rotation),
                position=mounted(imu.position, e.imu_position),
                accelerometer_bias=imu.accelerometer_bias + np.array(e.accelerometer_bias),
                gyroscope_bias=imu.gyroscope_bias + np.array(e.gyroscope_bias)),
            mocap=replace(mocap, rotation=mounted(mocap.rotation, e.mocap_rotation),
                          time_offset=mocap.time_offset - e.mocap_delay),
            initial=replace(self.initial, time_offset=self.initial.time_offset + e.imu_delay))
