"""Numbers of the identification; params/identify.yaml holds their values and their sources."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter


@dataclass(frozen=True, eq=False, kw_only=True)
class JointLogLimits:
    """What a response log of the joints must be."""

    periods: np.ndarray = parameter(doc='Range of the time between samples.', unit='s',
                                    shape=(2,), low=1e-6, high=10)
    longest_gap: float = parameter(doc='Longest gap.', unit='s', low=0.001, high=10)
    least_duration: float = parameter(doc='Least duration.', unit='s', low=0.1, high=600)
    least_samples: int = parameter(doc='Least samples.', low=10, high=10**6)
    least_travel: float = parameter(doc='Least travel of command and joints.', unit='rad', low=0,
                                    high=10)
    largest_angle: float = parameter(doc='Largest angle.', unit='rad', low=1, high=1000)
    history: float = parameter(doc='Time for which the command goes on before the log.',
                               unit='s', low=0, high=10)
    longest_bag: float = parameter(doc='Longest stretch of a bag.', unit='s', low=2, high=3600)
    last_command: float = parameter(doc='Time for which a last command is followed.', unit='s',
                                    low=0.001, high=10)


@dataclass(frozen=True, eq=False, kw_only=True)
class ServoFitParameters:
    """The fit of a servo model to such a log."""

    fitted: float = parameter(doc='Part of a log that is fitted.', unit='1', low=0.1, high=0.9)
    settling: float = parameter(doc='Time at the begin that is not fitted.', unit='s', low=0,
                                high=10)
    first_noise: float = parameter(doc='White noise of the first fit.', unit='rad', low=1e-6,
                                   high=1)
    nearly: float = parameter(doc='Part of the noise that ends the passes.', unit='1', low=0,
                              high=1)
    memory: float = parameter(doc='Memory of the whitening filter.', unit='s', low=0.01, high=10)
    beyond: float = parameter(doc='Factor by which a command must exceed a limit that counts.',
                              unit='1', low=1, high=10)
    blocks: int = parameter(doc='Blocks that are left out in turn.', low=2, high=100)
    least_gain: float = parameter(doc='Least gain on blocks left out, for each number.',
                                  unit='chi2', low=0, high=1e4)
    least_delay: float = parameter(doc='Least delay.', unit='s', low=0, high=1)
    published_deviation: float = parameter(
        doc='Prior of published frequency and damping, of the logarithm.', unit='1', low=0.01,
        high=10)
    common_gains: float = parameter(
        doc='Prior of frequency and damping about the median of all joints, of the logarithm.',
        unit='1', low=0.001, high=10)
    common_delay: float = parameter(doc='Prior of a delay about the median of all joints.',
                                    unit='s', low=1e-5, high=1)
    least_common: int = parameter(doc='Joints that have a median.', low=2, high=4)
    restarts: np.ndarray = parameter(doc='Frequency [rad/s] and delay [s] of further starts.',
                                     shape=(3, 2), low=0, high=1000)
    traded: float = parameter(doc='Part of an interval that another drags it through.', unit='1',
                              low=0, high=1)
    loose: float = parameter(doc='Half width in scales below which nothing is traded.', unit='1',
                             low=0, high=100)
    sines: np.ndarray = parameter(doc='Frequencies of sines that are weighed.', unit='Hz',
                                  shape=(8,), low=0.01, high=100)
    sine_time: float = parameter(doc='Length of a sine.', unit='s', low=2, high=600)
    sine_amplitude: float = parameter(doc='Largest amplitude of a sine.', unit='rad', low=0.01,
                                      high=3)
    sine_speed: float = parameter(doc='Largest speed of a sine.', unit='rad/s', low=0.1, high=100)

    @property
    def published(self) -> dict[str, float]:
        """Deviations about the published servo."""
        return dict.fromkeys(('natural_frequency', 'damping_ratio'), self.published_deviation)

    @property
    def common(self) -> dict[str, float]:
        """Deviations about the median of all joints."""
        return {'natural_frequency': self.common_gains, 'damping_ratio': self.common_gains,
                'delay': self.common_delay}


@dataclass(frozen=True, eq=False, kw_only=True)
class RotorLogParameters:
    """A bench log of a rotor and its map."""

    duty: np.ndarray = parameter(doc='Range of the duty.', unit='%', shape=(2,), low=0, high=200)
    largest_force: float = parameter(doc='Largest thrust.', unit='N', low=1, high=1e4)
    largest_torque: float = parameter(doc='Largest torque.', unit='N m', low=0.1, high=1e4)
    voltage: np.ndarray = parameter(doc='Range of the voltage.', unit='V', shape=(2,), low=0,
                                    high=1000)
    least_rows: int = parameter(doc='Least rows of a plateau.', low=5, high=10**6)
    settling: float = parameter(doc='Time after a change of PWM that is left out.', unit='s',
                                low=0, high=60)
    plateau_width: float = parameter(doc='Deviation by which voltages are smoothed.', unit='V',
                                     low=0.001, high=10)
    valley: float = parameter(doc='Depth of a dip that parts two plateaus.', unit='1', low=0,
                              high=1)
    stop_duty: float = parameter(doc='Duty up to which the rotor stands.', unit='%', low=0,
                                 high=100)
    least_slope: float = parameter(doc='Least slope of the map, for 10 N.', unit='%', low=0.01,
                                   high=100)


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentifyParameters:
    """See params/identify.yaml, which gives the source of each number."""

    log: JointLogLimits = parameter(doc='response logs')
    servo: ServoFitParameters = parameter(doc='servo models')
    rotor: RotorLogParameters = parameter(doc='rotor maps')

    @classmethod
    def load(cls, path: str | Path | None = None) -> IdentifyParameters:
        """
        Read a file; default the shipped one.

        Raises:
            ParameterError: naming file and key.

        """
        return schema.load(cls, path or share_path('params/identify.yaml'))


@cache
def shipped() -> IdentifyParameters:
    """Return the numbers of the package."""
    return IdentifyParameters.load()
