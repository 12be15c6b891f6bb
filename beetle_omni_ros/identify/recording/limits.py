"""Limits of a valid recording; params/recording.yaml has their values and sources."""

from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from beetle_omni_ros.robot.schema import parameter, ParameterFile

limit = partial(parameter, low=0)


@dataclass(frozen=True, eq=False)
class RecordingLimits(ParameterFile, file='recording.yaml'):
    """See params/recording.yaml, which gives the source of each number."""

    shortest_period: float = limit(unit='s', doc='Least time between messages of a sensor.')
    longest_period: float = limit(unit='s', doc='Longest usual time between messages of a sensor.')
    repeated_stamps: float = limit(unit='1', doc='Largest share of repeated stamps of a topic.')
    disordered: float = limit(unit='1', doc='Largest share of messages of a topic out of order.')
    clock_offset: float = limit(unit='s', doc='Largest difference of ages between topics.')
    clock_step: float = limit(unit='s', doc='Largest change of an age within a recording.')
    clock_noise: float = limit(unit='1', doc='The same in standard deviations.')
    clock_bin: float = limit(unit='s', doc='Time over which ages are compared.')
    lag_window: float = limit(unit='s', doc='Time over which two motions are compared.')
    lag_reach: float = limit(unit='s', doc='Largest tried shift.')
    lag_likeness: float = limit(unit='1', doc='Least correlation of an accepted shift.')
    sensor_lag: np.ndarray = parameter(shape=(2,), unit='s',
        doc='Range of the lag of MoCap behind the IMU.')
    servo_lag: np.ndarray = parameter(shape=(2,), unit='s',
        doc='Range of the lag of encoders behind commands.')
    lag_step: float = limit(unit='s', doc='Largest change of a lag within a recording.')
    lag_noise: float = limit(unit='1', doc='The same in standard deviations.')
    full_scale: np.ndarray = parameter(shape=(2,), unit='',
        doc='Largest specific force [m/s^2] and rate [rad/s].')
    contact: float = limit(unit='m', doc='Height below which spikes may be impacts.')
    room: float = limit(unit='m', doc='Largest position.')
    frozen: float = limit(unit='s', doc='Longest time of equal readings.')
    frozen_axis: float = limit(unit='s', doc='Longest time of equal readings of one axis.')
    frozen_command: float = limit(
        unit='rad', doc='Motion by the command that an encoder must show within the lag.')
    stale: float = limit(unit='1', doc='Largest share of readings equal to the previous one.')
    clipped: float = limit(
        unit='1', doc='Largest share of readings at the largest value of an axis.')
    outlier_window: int = limit(unit='1', doc='Readings of the median filter.')
    outlier_noise: float = limit(
        unit='1', doc='Least distance of an outlier from the median in sigma.')
    outlier_position: float = limit(unit='m', doc='Least distance of an outlier.')
    outlier_angle: float = limit(unit='rad', doc='Least angle of an outlier.')
    outlier_force: float = limit(unit='m/s^2', doc='Least specific force of an outlier.')
    outlier_rate: float = limit(unit='rad/s', doc='Least rate of an outlier.')
    outlier_joint: float = limit(unit='rad', doc='Least angle of an outlier of an encoder.')
    alternating: float = limit(
        unit='1', doc='Share of outliers from which two sources are interleaved.')
    jump_angle: float = limit(
        unit='rad', doc='Rotation between two MoCap readings that the gyroscope must show.')
    jump_position: float = limit(unit='m', doc='Largest distance between two MoCap readings.')
    unit_length: float = limit(unit='1', doc='Largest deviation of a quaternion norm from 1.')
    scatter: np.ndarray = parameter(shape=(5,), unit='',
        doc='Largest white noise of specific force [m/s^2], rate [rad/s], MoCap position [m] and '
        'orientation [rad], and encoders [rad].')
    edge: float = limit(unit='Hz', doc='Low-pass edge of comparisons of two sensors.')
    least_motion: np.ndarray = parameter(shape=(3,), unit='',
        doc='Least RMS of rate, acceleration and tilt rate for the check of a convention.')
    least_agreement: float = limit(
        unit='1', doc='Least share of the variance of one sensor that another explains.')
    unit_factor: float = limit(unit='1', doc='Least factor of a wrong unit.')
    blocks: int = limit(unit='1', doc='Number of separately checked parts of a flight.')
    permuted: float = limit(
        unit='1', doc='Largest ratio of squared errors for another order of the thrusts.')


@cache
def shipped() -> RecordingLimits:
    """Limits of the package."""
    return RecordingLimits.load()
