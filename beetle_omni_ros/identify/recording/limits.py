"""Limits of a valid recording; params/recording.yaml has their values and sources."""

from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from beetle_omni_ros.model.schema import parameter, ParameterFile

limit = partial(parameter, low=0)
between = partial(parameter, shape=(2,))


@dataclass(frozen=True, eq=False)
class RecordingLimits(ParameterFile, file='recording.yaml'):
    """See params/recording.yaml, which gives source and kind of each number."""

    period: np.ndarray = between(unit='s', doc='Range of the time between readings of a sensor.')
    clock_offset: np.ndarray = between(
        unit='s', doc='Range of the age of messages relative to other topics.')
    sensor_lag: np.ndarray = between(unit='s', doc='Range of the lag of MoCap behind the IMU.')
    servo_lag: np.ndarray = between(unit='s', doc='Range of the lag of encoders behind commands.')
    clock_step: float = limit(unit='s', doc='Largest change of an age within a recording.')
    lag_step: float = limit(unit='s', doc='Largest change of a lag within a recording.')
    lag_reach: float = limit(unit='s', doc='Largest tried lag.')
    scatter: np.ndarray = parameter(shape=(5,), unit='',
        doc='Largest white noise of specific force [m/s^2], rate [rad/s], MoCap position [m] and '
        'orientation [rad], and encoders [rad].')
    risen: float = limit(unit='m', doc='Height above the ground from which the robot flies.')
    frozen_command: float = limit(
        unit='rad', doc='Motion by the command that an encoder must show within the lag.')
    gain: float = limit(unit='1', doc='Largest ratio of two measurements of one motion.')
    thrust_gain: float = limit(unit='1', doc='Largest ratio of thrusts and specific force.')
    edge: float = limit(unit='Hz', doc='Low-pass edge of comparisons of two sensors.')
    window: float = limit(unit='s', doc='Time over which two signals are compared.')
    bin: float = limit(unit='s', doc='Time over which ages are compared.')
    agreement: float = limit(
        unit='1', doc='Least share of the variance of one signal that another explains.')
    prior: float = limit(unit='nat', doc='Log odds against each mistake.')
    certain: float = limit(unit='1', doc='Least probability of a cause for a repair.')
    noise: float = limit(unit='1', doc='Largest noise of a difference in standard deviations.')
    outlier: float = limit(unit='1', doc='Least distance of an outlier in standard deviations.')
    few: float = limit(unit='1', doc='Largest share of faulty messages of a valid topic.')
    stale: float = limit(unit='1', doc='Largest share of readings equal to the previous one.')


@cache
def shipped() -> RecordingLimits:
    """Limits of the package."""
    return RecordingLimits.load()
