"""Parameters of the gap finder and limits of a valid recording; the files have their sources."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from beetle_omni_ros.model import schema
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.resources import share_path
from beetle_omni_ros.model.schema import parameter, ParameterFile

limit = partial(parameter, low=0)
between = partial(parameter, shape=(2,))


def _time(doc, low=1e-4, high=600.0):
    return parameter(doc=doc, unit='s', low=low, high=high)


def _edge(doc):
    return parameter(doc=doc, unit='Hz', low=0.1, high=100)


def _size(unit, doc, high=1):
    return parameter(doc=doc, unit=unit, low=0, high=high)


_share = partial(_size, '1')


@dataclass(frozen=True, eq=False, kw_only=True)
class GapParameters:
    """See params/gap.yaml, which gives the source of each number."""

    grid: float = _time('Period of the grid on which signals are compared.', 0.005, 0.05)
    servo_step: float = _time('Step of the simulated servo.', 1e-4, 0.01)
    servo_window: float = _time('Time for which a servo runs freely from measured states.', 0.1)
    servo_warm_up: float = _time('Time of a free run before its samples count.', 0.05)
    memory: float = _time('Simulated time of the rotors before the first sample.', 0.1)
    smooth_imu: float = _edge('Low-pass edge of IMU readings as inputs of the model.')
    smooth_joint: float = _edge('Low-pass edge of tilts as inputs of the model.')
    smooth_pose: float = _edge('Low-pass edge of MoCap velocities as inputs of the model.')
    smooth_reading: float = _edge('Low-pass edge of encoder readings that are compared.')
    guide_above: float = _size(
        'rad', 'Encoder noise above which a servo model gives the fast part of tilts.')
    guide_edge: float = _edge('Edge below which these tilts come from the encoders.')
    coarse_noise: float = _size(
        'm', 'MoCap noise above which the IMU gives the fast part of the velocity.')
    velocity_edge: float = _edge('Edge above which velocity comes from the IMU, with noisy MoCap.')
    tolerance_mass: float = _share('Prior deviation of the mass.')
    tolerance_inertia: float = _share('Prior deviation of each moment of inertia.')
    tolerance_thrust: float = _share('Prior deviation of thrust, of each rotor and of all.')
    tolerance_position: float = _size('m', 'Prior deviation of a rotor position, each axis.')
    tolerance_lag: float = _share('Prior deviation of lags and servo gains.')
    tolerance_speed: float = _share('Prior deviation of the speed limit of the servos.')
    tolerance_gradient: float = _share('Prior deviation of its change by a load.')
    tolerance_torque_ratio: float = _share('Prior deviation of torque over thrust.')
    tolerance_bias_accelerometer: float = _size(
        'm/s^2', 'Prior deviation of the bias of the accelerometer.', 10)
    tolerance_bias_gyroscope: float = _size(
        'rad/s', 'Prior deviation of the bias of the gyroscope.')
    tolerance_angle: float = _size('rad', 'Prior deviation of mountings and joint zeros.')
    tolerance_delay: float = _time('Prior deviation of delays of sensors.', 1e-6, 0.1)
    imu_averaging: float = _time('Latency of an IMU by averaging.', 0, 0.1)
    coarse_imu: float = _time('Possible latency of an IMU beside a noisy MoCap.', 1e-6, 1)
    coarse_encoders: float = _time('Possible latency of encoders beside it.', 1e-6, 1)
    tolerance_swing: float = _size(
        '1', 'Log ratio by which the apparent inertia of a servo may differ.', 10)
    modules_tolerance: float = _share('Prior deviation of the terms of the tilting modules.')
    command_delay: float = _time('Nominal delay from a stamp to the actuator.', 0, 0.1)
    bus_near: float = _time('Prior deviation of that delay, of each bus.', 1e-6, 1)
    bus_late: float = _time('Most by which a bus is late without a finding.', 1e-6, 1)
    contact_height: float = _size('m', 'Height of base_link below which feet may touch.', 10)
    limit_margin: float = _share('Share of the largest thrust up to which samples count.')
    settle: float = _time('Unused time after take-off.', 0)
    lifted: float = _share('Commanded thrust over weight from which the robot flies.')
    wrong_robot: float = _share(
        'Relative amount by which commanded thrust may be below the specific force.')
    same_flight: float = _share('Share of equal IMU readings from which two files are one flight.')
    least_duration: float = _time('Least duration of a flight.', 4)
    longest_gap: float = _time('Longest silence of a sensor.', 0.01)
    most_lost: float = _share('Largest share of a flight in silences.')
    without: schema.NAMES = parameter((), doc='Effects of body and rotors that are no candidates.')

    @classmethod
    def load(cls, path: str | Path | None = None, **changed) -> GapParameters:
        """
        Read the shipped file, then another file, then single values.

        Raises:
            ParameterError: with file and key; an unknown key, wrong type or value out of range.

        """
        shipped = share_path('params/gap.yaml')
        values = schema.load_yaml(shipped) | (schema.load_yaml(path) if path else {}) | changed
        loaded: GapParameters = schema.bind(cls, values, str(path or shipped))
        for name in loaded.without:
            if name not in CATALOGUE:
                raise schema.unknown(f"{path or shipped}: key 'without'", 'effect', name,
                                     sorted(CATALOGUE))
        return loaded


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
    mounting: float = limit(unit='rad', doc='Largest angle between IMU and MoCap.')
    bias: float = limit(unit='m/s^2', doc='Largest bias of the accelerometer.')
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
