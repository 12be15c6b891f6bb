"""Parameters of the identification; params/identify.yaml has their values and sources."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from beetle_omni_ros.robot.schema import parameter, ParameterFile


@dataclass(frozen=True, eq=False, kw_only=True)
class JointLogLimits:
    """Requirements for a response log of the joints."""

    periods: np.ndarray = parameter(doc='Range of the time between samples.', unit='s',
                                    shape=(2,), low=1e-6, high=10)
    longest_gap: float = parameter(doc='Longest gap.', unit='s', low=0.001, high=10)
    least_duration: float = parameter(doc='Least duration.', unit='s', low=0.1, high=600)
    least_samples: int = parameter(doc='Least number of samples.', low=10, high=10**6)
    least_travel: float = parameter(doc='Least travel of command and joints.', unit='rad', low=0,
                                    high=10)
    largest_angle: float = parameter(doc='Largest angle.', unit='rad', low=1, high=1000)
    history: float = parameter(doc='Time before the log with an extrapolated command.',
                               unit='s', low=0, high=10)
    longest_bag: float = parameter(doc='Longest used part of a bag.', unit='s', low=2, high=3600)
    last_command: float = parameter(doc='Time for which the last command is followed.', unit='s',
                                    low=0.001, high=10)


@dataclass(frozen=True, eq=False, kw_only=True)
class ServoFitParameters:
    """Fit of a servo model to a response log."""

    fitted: float = parameter(doc='Fitted share of a log.', unit='1', low=0.1, high=0.9)
    settling: float = parameter(doc='Time at the beginning that is not fitted.', unit='s', low=0,
                                high=10)
    first_noise: float = parameter(doc='White noise of the first fit.', unit='rad', low=1e-6,
                                   high=1)
    between: float = parameter(doc='Relative difference of the gains between logs, for intervals.',
                               unit='1', low=0.001, high=1)
    beyond: float = parameter(doc='Least ratio of a command and a limit that it identifies.',
                              unit='1', low=1, high=10)
    blocks: int = parameter(doc='Number of blocks of the cross-validation.', low=2, high=100)
    as_well: float = parameter(doc='Largest ratio of the errors of a correction and of the best '
                                   'model.', unit='1', low=1, high=10)
    traded: float = parameter(doc='Least correlation of a pair that the log does not separate.',
                              unit='1', low=0, high=1)
    loose: float = parameter(doc='Least half width in scales of a member of such a pair.',
                             unit='1', low=0, high=100)
    sine_time: float = parameter(doc='Length of a proposed sine.', unit='s', low=2, high=600)
    sine_amplitude: float = parameter(doc='Amplitude of it.', unit='rad', low=0.01, high=3)
    sine_speed: float = parameter(doc='Speed of it.', unit='rad/s', low=0.1, high=100)


@dataclass(frozen=True, eq=False, kw_only=True)
class RotorLogParameters:
    """Logs of a rotor on a force-torque stand."""

    duty: np.ndarray = parameter(doc='Range of the duty.', unit='%', shape=(2,), low=0, high=200)
    largest_force: float = parameter(doc='Largest thrust.', unit='N', low=1, high=1e4)
    largest_torque: float = parameter(doc='Largest torque.', unit='N m', low=0.1, high=1e4)
    voltage: np.ndarray = parameter(doc='Range of the voltage.', unit='V', shape=(2,), low=0,
                                    high=1000)
    largest_speed: float = parameter(doc='Largest speed.', unit='rpm', low=100, high=1e6)
    temperature: np.ndarray = parameter(doc='Range of the temperature.', unit='deg C',
                                        shape=(2,), low=-273, high=1000)
    least_rows: int = parameter(doc='Least number of rows of a log.', low=5, high=10**6)
    least_sweep: float = parameter(doc='Least range of the duty from stop 0 to full 1.', unit='1',
                                   low=0.01, high=1)
    least_heating: float = parameter(doc='Least range of the temperature.', unit='K', low=0,
                                     high=100)
    settling: float = parameter(doc='Settling time after a change of command.', unit='s',
                                low=0.01, high=60)
    still: float = parameter(doc='Largest share of the command that its lagged value differs by.',
                             unit='1', low=0, high=1)
    blocks: int = parameter(doc='Largest number of blocks of a surface.', low=5, high=1000)
    least_packs: int = parameter(doc='Least number of packs that serve as blocks.', low=3,
                                 high=100)
    gain_window: float = parameter(doc='Time with one gain between thrust and command.',
                                   unit='s', low=0.05, high=60)
    gain_scatter: float = parameter(doc='Largest scatter of this gain.', unit='1', low=0, high=10)
    gain_share: float = parameter(doc='Largest ratio of the errors with own gains and without.',
                                  unit='1', low=0, high=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentifyParameters(ParameterFile, file='identify.yaml'):
    """See params/identify.yaml, which gives the source of each number."""

    log: JointLogLimits = parameter(doc='response logs')
    servo: ServoFitParameters = parameter(doc='servo models')
    rotor: RotorLogParameters = parameter(doc='rotor maps')


@cache
def shipped() -> IdentifyParameters:
    """Parameters of the package."""
    return IdentifyParameters.load()
