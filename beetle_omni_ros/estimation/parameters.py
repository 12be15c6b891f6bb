"""The estimator's parameters (params/ekf.yaml)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.parameters import RobotParameters
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import group, parameter


@dataclass(frozen=True, kw_only=True)
class ImuParameters:
    """The IMU: noise, mounting and what it can plausibly say."""

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
        [0.0, 0.0, 0.0], doc='of the IMU in base_link', unit='m', shape=(3,), low=-5, high=5)
    rotation: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc="rotation vector of the IMU's axes seen from base_link", unit='rad',
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
        30.0, doc='a larger change of the specific force between two samples is an impact, '
        'whose impulse is unknown', unit='m/s^2', low=1, high=2000)
    spike_change: float = parameter(
        3.0, doc='a lone reading whose angular rate changes by more, or whose specific force '
        'changes by more than an impact, is refused', unit='rad/s', low=0.1, high=200)
    frozen_samples: int = parameter(
        10, doc='samples that repeat the one before to the last digit while the MoCap moves, from '
        'which they are refused', low=2, high=10000)
    gap_limit: float = parameter(
        0.1, doc='longest time between two samples that is bridged', unit='s', low=0.001, high=1)
    resync_samples: int = parameter(
        20, doc='refused stamps in a row, consistent with each other, after which they are '
        'believed and the state is lost', low=2, high=10000)


@dataclass(frozen=True, kw_only=True)
class MocapParameters:
    """The MoCap: noise, the marker body's place on the robot, delay and gating."""

    position_noise: float = parameter(
        0.001, doc='standard deviation of a position, each axis', unit='m', low=1e-6, high=1)
    orientation_noise: float = parameter(
        0.0017453292519943296, doc='standard deviation of an orientation, each axis', unit='rad',
        low=1e-6, high=1)
    position: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc='of the marker body in base_link', unit='m', shape=(3,), low=-5,
        high=5)
    rotation: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc="rotation vector of the marker body's axes seen from base_link",
        unit='rad', shape=(3,), low=-3.2, high=3.2)
    time_offset: float = parameter(
        0.0, doc='added to its stamps to bring them to the clock of the IMU', unit='s', low=-1,
        high=1)
    delay_limit: float = parameter(
        0.2, doc='oldest capture that is still used, behind the newest IMU sample', unit='s',
        low=0.005, high=2)
    noise_scale_limit: float = parameter(
        20.0, doc='largest factor on both noises when the poses are seen to be noisier; 1 keeps '
        'them as given', low=1, high=1000)
    gate_probability: float = parameter(
        0.99999, doc='share of good poses that passes the chi-square gate', low=0.5,
        high=0.9999999999)
    quaternion_tolerance: float = parameter(
        0.01, doc='largest deviation of the norm of a quaternion from 1', low=1e-6, high=0.5)
    position_limit: float = parameter(
        100.0, doc='larger coordinates are refused', unit='m', low=0.1, high=1e5)
    frozen_poses: int = parameter(
        5, doc='poses that repeat the one before to the last digit while the IMU moves, from '
        'which they are refused', low=1, high=1000)


@dataclass(frozen=True, kw_only=True)
class InitialParameters:
    """How wrong the first state may be."""

    velocity_std: float = parameter(
        5.0, doc='standard deviation of the velocity', unit='m/s', low=0.01, high=100)
    accelerometer_bias_std: float = parameter(
        0.2, doc='standard deviation of the accelerometer bias', unit='m/s^2', low=1e-6, high=10)
    gyroscope_bias_std: float = parameter(
        0.05, doc='standard deviation of the gyroscope bias', unit='rad/s', low=1e-6, high=1)
    time_offset: float = parameter(
        0.0, doc='by how much the stamps of the IMU are later than those of the MoCap', unit='s',
        low=-0.2, high=0.2)
    time_offset_std: float = parameter(
        0.01, doc='standard deviation of the offset between the clocks; 0 if there is none',
        unit='s', low=0, high=0.1)


@dataclass(frozen=True, kw_only=True)
class TimeOffsetParameters:
    """What remains between the clocks of IMU and MoCap, estimated in flight."""

    limit: float = parameter(
        0.05, doc='largest offset that is estimated', unit='s', low=0, high=0.2)
    walk: float = parameter(
        0.00001, doc='random walk', unit='s/sqrt(s)', low=0, high=1)
    speed: float = parameter(
        0.1, doc='slower motion says nothing about it', unit='m/s', low=0.001, high=10)
    rate: float = parameter(
        0.2, doc='slower rotation says nothing about it', unit='rad/s', low=0.001, high=10)
    trend_samples: int = parameter(
        3, doc='readings through which the trend is laid that carries a late rate on; 1 holds it',
        low=1, high=100)


@dataclass(frozen=True, kw_only=True)
class StatusParameters:
    """When the estimate is good, and how a lost one comes back."""

    dead_reckoning_after: float = parameter(
        0.1, doc='time without an accepted pose', unit='s', low=0.01, high=10)
    lost_after: float = parameter(
        20.0, doc='time without an accepted pose', unit='s', low=0.02, high=600)
    lost_position_std: float = parameter(
        5.0, doc='standard deviation of the position, each axis', unit='m', low=0.001, high=100)
    start_poses: int = parameter(
        20, doc='consecutive poses that must agree with the IMU before the first fix and when '
        'lost', low=2, high=10000)
    jump_poses: int = parameter(
        100, doc='consecutive poses that must agree with the IMU and with each other before a '
        'persistent jump is believed', low=2, high=10000)
    jump_attitude: float = parameter(
        0.35, doc='a jump of the attitude beyond is not believed, for the gyroscope rules it out',
        unit='rad', low=0.01, high=4)


@dataclass(frozen=True, kw_only=True)
class DoubtParameters:
    """What becomes uncertain when the IMU contradicts poses that follow each other smoothly."""

    poses: int = parameter(
        3, doc='consecutive poses that must contradict', low=1, high=1000)
    time: float = parameter(
        1.0, doc='for which a single pose suffices after that', unit='s', low=0, high=100)
    distance: float = parameter(
        0.05, doc='a longer step from the last good pose is a jump of the MoCap', unit='m',
        low=0.001, high=10)
    angle: float = parameter(
        0.05, doc='likewise a larger turn', unit='rad', low=0.001, high=3)
    speed: float = parameter(
        2.0, doc='error of the velocity by which that step may be longer for each second',
        unit='m/s', low=0, high=100)
    rate: float = parameter(
        8.0, doc='error of the angular rate by which that turn may be larger for each second',
        unit='rad/s', low=0, high=100)
    position_std: float = parameter(
        0.05, doc='then added to the deviation of the position', unit='m', low=1e-4, high=10)
    velocity_std: float = parameter(
        0.5, doc='then added to the deviation of the velocity', unit='m/s', low=0.001, high=100)
    attitude_std: float = parameter(
        0.01, doc='then added to that of the attitude', unit='rad', low=0.001, high=3)
    accelerometer_bias_std: float = parameter(
        1.0, doc='then added to that of the accelerometer bias', unit='m/s^2', low=1e-6, high=100)
    gyroscope_bias_std: float = parameter(
        3.0, doc='then added to that of the gyroscope bias', unit='rad/s', low=1e-6, high=100)


@dataclass(frozen=True, kw_only=True)
class EkfParameters:
    """Everything that :class:`~beetle_omni_ros.estimation.ekf.ErrorStateEkf` can be told."""

    imu: ImuParameters = group(ImuParameters)
    mocap: MocapParameters = group(MocapParameters)
    initial: InitialParameters = group(InitialParameters)
    time_offset: TimeOffsetParameters = group(TimeOffsetParameters)
    doubt: DoubtParameters = group(DoubtParameters)
    status: StatusParameters = group(StatusParameters)

    def __post_init__(self):
        """Refuse times that contradict each other."""
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
        Parameters with what the robot file's effects say of IMU and MoCap.

        Mountings replace those given here; biases and delays add to them. A late MoCap is early
        by its stamps; a late IMU is carried on to now, as a latency that is found in flight.
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

    @classmethod
    def load(cls, path: str | Path | None = None) -> EkfParameters:
        """
        Read a parameter file; without a path, the shipped one.

        Raises:
            ParameterError: naming file, key and what was expected.

        """
        return schema.load(cls, path if path else share_path('params/ekf.yaml'))
