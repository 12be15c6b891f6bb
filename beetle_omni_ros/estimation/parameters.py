"""The estimator's parameters (params/ekf.yaml)."""

from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import group, parameter, ParameterFile


@dataclass(frozen=True, kw_only=True)
class ImuParameters:
    """Noise and mounting of the IMU."""

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
    delay: float = parameter(
        0.0, doc='age of a reading at its stamp, at the start of its estimation', unit='s',
        low=-0.2, high=0.2)
    delay_std: float = parameter(
        0.01, doc='standard deviation of this age; 0: exact', unit='s', low=0, high=0.1)


@dataclass(frozen=True, kw_only=True)
class MocapParameters:
    """Noise, mounting and clock of the MoCap."""

    position_noise: float = parameter(
        0.001, doc='standard deviation of a position, each axis', unit='m', low=1e-6, high=1)
    orientation_noise: float = parameter(
        0.0017453292519943296, doc='standard deviation of an orientation, each axis', unit='rad',
        low=1e-6, high=1)
    position: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc='position of the marker body in base_link', unit='m', shape=(3,),
        low=-5, high=5)
    rotation: np.ndarray = parameter(
        [0.0, 0.0, 0.0], doc="rotation vector from the marker body's axes to base_link axes",
        unit='rad', shape=(3,), low=-3.2, high=3.2)
    time_offset: float = parameter(
        0.0, doc='added to the stamps to convert them to the clock of the IMU', unit='s', low=-1,
        high=1)

@dataclass(frozen=True, kw_only=True)
class EkfParameters(ParameterFile, file='ekf.yaml'):
    """Parameters of :class:`~beetle_omni_ros.estimation.ekf.ErrorStateEkf`."""

    imu: ImuParameters = group(ImuParameters)
    mocap: MocapParameters = group(MocapParameters)

    def of_robot(self, robot: RobotParameters):
        """
        Combine the parameters with the sensor effects of a robot file.

        Mountings of the effects replace those of the parameters; biases and delays are added. A
        delay of the MoCap is subtracted from its time offset. A delay of the IMU is extrapolated,
        as a latency that is estimated in flight.
        """
        e, imu, mocap = robot.sensors, self.imu, self.mocap
        return replace(
            self, imu=replace(
                imu, rotation=np.array(e.imu_rotation) if any(e.imu_rotation) else imu.rotation,
                position=np.array(e.imu_position) if any(e.imu_position) else imu.position,
                accelerometer_bias=imu.accelerometer_bias + np.array(e.accelerometer_bias),
                gyroscope_bias=imu.gyroscope_bias + np.array(e.gyroscope_bias),
                delay=imu.delay + e.imu_delay),
            mocap=replace(
                mocap, rotation=np.array(e.mocap_rotation) if any(e.mocap_rotation)
                else mocap.rotation, time_offset=mocap.time_offset - e.mocap_delay))
