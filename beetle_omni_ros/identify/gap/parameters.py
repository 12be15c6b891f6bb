"""Parameters of the gap finder; params/gap.yaml has their values and sources."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beetle_omni_ros.robot import schema
from beetle_omni_ros.robot.resources import share_path
from beetle_omni_ros.robot.schema import parameter, ParameterError


def _time(doc, low=1e-4, high=600.0):
    return parameter(doc=doc, unit='s', low=low, high=high)


def _edge(doc):
    return parameter(doc=doc, unit='Hz', low=0.1, high=100)


def _count(doc, low=1, high=1000):
    return parameter(doc=doc, low=low, high=high)


def _chi2(doc, high=1e5):
    return parameter(doc=doc, unit='chi2', low=0, high=high)


def _share(doc):
    return parameter(doc=doc, unit='1', low=0, high=1)


def _factor(doc, high=1e3):
    return parameter(doc=doc, unit='1', low=0, high=high)


def _several(doc, shape, unit='', high=1e3, low=0.0):
    return parameter(doc=doc, unit=unit, shape=(shape,), low=low, high=high)


@dataclass(frozen=True, eq=False, kw_only=True)
class GapParameters:
    """See params/gap.yaml, which gives the source of each number."""

    grid: float = _time('Period of the grid on which signals are compared.', 0.005, 0.05)
    servo_step: float = _time('Step of the simulated servo.', 1e-4, 0.01)
    servo_window: float = _time('Time for which a servo runs freely from measured states.', 0.1)
    servo_warm_up: float = _time('Time of a free run before its samples count.', 0.05)
    smooth_imu: float = _edge('Low-pass edge of IMU readings as inputs of the model.')
    smooth_joint: float = _edge('Low-pass edge of tilts as inputs of the model.')
    smooth_pose: float = _edge('Low-pass edge of MoCap velocities as inputs of the model.')
    smooth_reading: float = _edge('Low-pass edge of encoder readings that are compared.')
    memory: float = _time('Simulated time of the rotors before the first sample.', 0.1)

    guide_above: float = parameter(
        doc='Encoder noise above which a servo model gives the fast part of tilts.',
        unit='rad', low=0, high=1)
    guide_edge: float = _edge('Edge below which these tilts come from the encoders.')
    velocity_edge: float = _edge('Edge above which velocity comes from the IMU, with noisy MoCap.')

    body_edge: float = _edge('Low-pass edge of forces and torques.')
    body_every: int = _count('Decimation of forces and torques.', high=100)
    world_edge: float = _edge('Low-pass edge of MoCap accelerations.')
    world_every: int = _count('Decimation of MoCap accelerations.', high=100)
    rate_edge: float = _edge('Low-pass edge of MoCap rates.')
    rate_every: int = _count('Decimation of MoCap rates.', high=100)
    joint_edge: float = _edge('Low-pass edge of joint angles.')
    joint_every: int = _count('Decimation of joint angles.', high=100)
    body_order: int = _count('Order of the autoregression of forces and torques.', high=50)
    other_order: int = _count('Order of the autoregression of the other channels.', high=50)
    floors: np.ndarray = _several(
        'Least standard deviation of specific force [m/s^2], angular acceleration [rad/s^2], '
        'MoCap acceleration [m/s^2], MoCap rate [rad/s] and joint angle [rad].', 5, low=1e-9)

    noise_ceiling: float = _factor('Largest RMS of a residual over that of the sensor noise.')
    model_ceiling: np.ndarray = _several(
        'Largest residual RMS of a valid model in MoCap acceleration [m/s^2], MoCap rate [rad/s] '
        'and joint angle [rad].', 3)
    gust_ceiling: np.ndarray = _several(
        'Largest RMS by gusts in specific force [m/s^2] and angular acceleration [rad/s^2].', 2)

    tolerance_mass: float = _share('Prior deviation of the mass.')
    tolerance_inertia: float = _share('Prior deviation of each moment of inertia.')
    tolerance_thrust: float = _share('Prior deviation of thrust, of each rotor and of all.')
    tolerance_position: float = parameter(
        doc='Prior deviation of a rotor position, each axis.', unit='m', low=0, high=1)
    tolerance_lag: float = _share('Prior deviation of lags and servo gains.')
    tolerance_torque_ratio: float = _share('Prior deviation of torque over thrust.')
    tolerance_bias_accelerometer: float = parameter(
        doc='Prior deviation of the bias of the accelerometer.', unit='m/s^2', low=0, high=10)
    tolerance_bias_gyroscope: float = parameter(
        doc='Prior deviation of the bias of the gyroscope.', unit='rad/s', low=0, high=1)
    tolerance_angle: float = parameter(
        doc='Prior deviation of mountings and joint zeros.', unit='rad', low=0, high=1)
    tolerance_delay: float = _time('Prior deviation of delays of sensors.', 1e-6, 0.1)
    coarse_noise: float = parameter(
        doc='MoCap noise above which sensors count as noisy, so that latencies are not named.',
        unit='m', low=0, high=1)
    coarse_latency: np.ndarray = _several(
        'Accepted latency of noisy IMU and encoders.', 2, 's', 1)
    imu_averaging: float = _time('Latency of an IMU by averaging.', 0, 0.1)
    command_delay: float = _time('Nominal delay from a stamp to the actuator.', 0, 0.1)
    command_delay_range: float = _time('Range of that delay that is not named.', 0, 0.1)
    bus_near: np.ndarray = _several(
        'Prior deviation of that delay within its range, with good and with noisy sensors.', 2,
        's', 1, 1e-6)
    tolerance_swing: float = _factor(
        'Log ratio by which the apparent inertia of a servo may differ.', 10)
    modules_tolerance: float = _share('Prior deviation of the terms of the tilting modules.')

    most_effects: int = _count('Largest number of named effects.', high=20)
    least_gain: float = _chi2('Least gain of an effect.')
    least_believed: float = _chi2('Least gain of an effect in the priors of tolerances alone.')
    parameter_price: float = _chi2('Further gain for each parameter beyond the first.')
    least_share: float = _share('Least share of the unexplained chi2 that an effect explains.')
    weak_share: float = _share('The same, if held-out blocks agree.')
    weak_agreement: float = _factor('Standard errors of the held-out gain then, of a large gain.')
    weak_gain: float = _factor('Ratio to the least gain from which a gain is large.')
    strong_agreement: float = _factor('Standard errors of the held-out gain, of a small gain.')
    sure_blocks: float = _share('Least share of held-out blocks that gain then.')
    held_out_errors: float = _factor('Least standard errors of the gain on held-out blocks.')
    held_out_blocks: float = _share('Least share of held-out blocks that gain.')
    held_out_nearly_all: float = _share(
        'Share of held-out blocks with a gain that replaces the standard errors.')
    held_out_share: float = _share('Least gain on held-out blocks over the fitted gain.')
    elsewhere_share: float = _share('The same, without the block of the largest gain.')
    least_elsewhere: float = _chi2('Least gain outside the block of the largest gain.')
    least_uneven: float = _chi2('Gain from which blocks may gain unevenly.')
    part_share: float = _factor(
        'Gain in slow or fast motion alone over that in all motion, above which an effect may be '
        'closed-loop bias.')
    part_free: float = _chi2('Further such gain for each parameter.')
    band_edges: np.ndarray = _several('Edges between the bands of motion.', 4, 'Hz', 50, 0.01)
    slow_below: float = parameter(
        doc='Edge of slow motion, one of `band_edges`.', unit='Hz', low=0.01, high=50)
    early_command: float = _time('Largest lead of a command on its stamp.', 0, 0.1)
    enough: float = _share(
        'Least gain of the named effects over that of all known effects.')
    rival_share: float = _share('Relative difference of gains within which effects form a set.')
    rival_gain: float = _chi2('The same, as a gain.')
    decidable: float = parameter(
        doc='Standard deviations of an effect of typical size from which it is detectable.',
        unit='sigma', low=0, high=1e3)
    least_liveliness: float = _factor(
        'Least excitation: ratio of accelerations and unexplained residual.')
    block: float = _time('Length of a block of cross-validation.', 1)
    least_blocks: int = _count('Least number of blocks of all flights.', 2)

    wide: float = _factor('Search range of any parameter in typical sizes.')
    most_turns: int = _count('Largest number of linearisations.', high=50)
    most_iterations: int = _count('Largest number of iterations of a fit.', high=100)
    far: float = _factor('Change in typical sizes that needs a new linearisation.')
    beyond: float = _factor('Largest plausible deviation of a tolerance in prior deviations.')
    takeovers: int = _count(
        'Largest number of fits while further tolerances exceed that deviation.', 0, 50)
    refined: int = _count('Number of fitted candidates of a step.', high=100)
    promising: float = _share('Least linear gain of a fitted candidate over the best one.')
    promising_curved: float = _share('The same, of nonlinear candidates.')
    looked_at: float = _share('Least linear gain of a fitted candidate over the least gain.')

    form_part: float = _share('Relative error of an effect by its form.')
    form_share: float = _share('Further such error over the smallest relevant size.')
    bus_seen: float = _time('Prior deviation of command delays for detectability.', 1e-5, 0.1)
    disagree: float = _factor('Least relevant scatter between parts of the data over noise.')
    excitations: int = _count('Number of groups of samples by excitation.', 2, 100)
    least_bands: int = _count('Least effective number of bands of a parameter.', 2, 100)
    least_variance: float = _share('Least variance of whitened residuals in an interval.')

    contact_height: float = parameter(
        doc='Height of base_link below which feet may touch.', unit='m', low=0, high=10)
    limit_margin: float = _share('Share of the largest thrust up to which samples count.')
    settle: float = _time('Unused time after take-off.', 0)
    lifted: float = _share('Commanded thrust over weight from which the robot flies.')
    wrong_robot: float = _share(
        'Relative amount by which commanded thrust may be below the specific force.')
    same_flight: float = _share('Share of equal IMU readings from which two files are one flight.')

    least_duration: float = _time('Least duration of a flight.', 1)
    longest_gap: float = _time('Longest silence of a sensor.', 0.01)
    most_lost: float = _share('Largest share of a flight in silences.')

    least_left: float = _chi2(
        'Remaining gain of known effects from which the verdict is unknown.')
    least_remainder: float = _chi2(
        'Gain of a generic regression from which the verdict is unknown.')
    least_channel: float = _chi2('The same, in one channel.')
    remainder_ridge: float = _factor('Ridge of that regression, in percent of its mean diagonal.')
    least_force: float = parameter(
        doc='Least repeatable RMS in specific force.', unit='m/s^2', low=0, high=100)
    least_torque: float = parameter(
        doc='Least repeatable RMS in angular acceleration.', unit='rad/s^2', low=0, high=100)
    least_joint: float = parameter(
        doc='Least repeatable RMS in a joint angle.', unit='rad', low=0, high=1)
    remainder_share: float = _share('Gain of that regression over that of the named effects.')
    least_pattern: float = _chi2('Least gain of a pattern outside the catalogue.')
    pattern_agrees: np.ndarray = parameter(
        doc='Pairs of least standard errors of the gain and least share of blocks that gain; one '
        'pair is sufficient.', shape=(2, 2), low=0, high=100)
    pattern_share: float = _share('Least gain of a pattern over that of the named effects.')
    pattern_force: float = parameter(
        doc='Typical force of a pattern.', unit='N', low=1e-3, high=100)
    pattern_thrust: float = _share('Typical relative change of thrust of a pattern.')
    warm_up: float = _time('Time constant of a drift after take-off.', 0.1)
    place_spacing: float = parameter(
        doc='Spacing of the grid of places for a force.', unit='m', low=0.05, high=10)
    place_width: float = parameter(
        doc='Width of such a place.', unit='m', low=0.05, high=10)
    swings: np.ndarray = _several('Frequencies of swinging masses.', 5, 'Hz', 50, 0.01)
    swing_damping: float = _share('Damping ratio of swinging masses.')
    swing_mass: float = _share('Typical share of a swinging mass in the total mass.')
    swinging_force: float = parameter(
        doc='Least RMS of the force of a swinging mass.', unit='m/s^2', low=0, high=100)
    rhythms: np.ndarray = _several('Frequency range of a periodic force.', 2, 'Hz', 50)
    line_beside: float = parameter(
        doc='Width of the neighbourhood of a spectral line, to each side.', unit='Hz', low=0.01,
        high=50)
    least_line: float = _factor('Power of a line over the median of its neighbourhood.')

    agreement: float = _factor('Largest error over noise floor for the verdict no gap.')
    most_hidden: float = _share('Largest undetectable share of the catalogue for that verdict.')
    crowd: int = _count('Number of members from which a set is not decidable.', 2, 100)
    at_floor: float = _factor('Error over noise floor below which no gap remains.')
    run_every: float = _time('Time between starts of free runs.', 0.01)
    run_floors: np.ndarray = _several(
        'Least noise floor of position [m], velocity [m/s], orientation [rad], rate [rad/s] and '
        'joint angle [rad].', 5, low=1e-9)
    run_draws: int = _count('Draws of gusts for a noise floor.', 10, 100000)
    runs_a_block: int = _count('Number of free runs in a block with common gusts.')
    clearly_worse: float = _factor(
        'Standard errors from which held-out flights count as worse.')
    regime_worse: float = _factor('Factor by which a regime may get worse.')
    far_off: float = _factor('Largest error over noise floor with named effects.')
    least_closed: float = _share('Least closed share of a gap if the error is larger.')

    def __post_init__(self):
        """Check that the edge of slow motion is a band edge."""
        if self.slow_below not in self.band_edges:
            raise ParameterError(f"key 'slow_below': {self.slow_below:g} Hz is none of "
                                 f"band_edges {self.band_edges.tolist()}")

    @classmethod
    def load(cls, path: str | Path | None = None, **changed) -> GapParameters:
        """
        Read the shipped file, then another file, then single values.

        Raises:
            ParameterError: with file and key; an unknown key, wrong type or value out of range.

        """
        shipped = share_path('params/gap.yaml')
        values = schema.load_yaml(shipped) | (schema.load_yaml(path) if path else {}) | changed
        return schema.bind(cls, values, str(path or shipped))
