"""Numbers of the gap finder; params/gap.yaml holds their values and where each comes from."""

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
    memory: float = _time('Time before the first sample from which rotors are simulated.', 0.1)

    guide_above: float = parameter(
        doc='Noise of encoders above which a servo model gives the quick part of tilts.',
        unit='rad', low=0, high=1)
    guide_edge: float = _edge('Edge below which guided tilts follow the encoders.')
    velocity_edge: float = _edge('Edge above which the IMU gives the velocity, with noisy MoCap.')

    body_edge: float = _edge('Low-pass edge of forces and torques.')
    body_every: int = _count('Of so many samples of forces and torques one is kept.', high=100)
    world_edge: float = _edge('Low-pass edge of MoCap accelerations.')
    world_every: int = _count('Of so many samples of MoCap accelerations one is kept.', high=100)
    rate_edge: float = _edge('Low-pass edge of MoCap rates.')
    rate_every: int = _count('Of so many samples of MoCap rates one is kept.', high=100)
    joint_edge: float = _edge('Low-pass edge of joint angles.')
    joint_every: int = _count('Of so many samples of joint angles one is kept.', high=100)
    body_order: int = _count('Order of the autoregression of forces and torques.', high=50)
    other_order: int = _count('Order of the autoregression of the other channels.', high=50)
    floors: np.ndarray = _several(
        'Least standard deviation of specific force [m/s^2], angular acceleration [rad/s^2], '
        'MoCap acceleration [m/s^2], MoCap rate [rad/s] and joint angle [rad].', 5, low=1e-9)

    noise_ceiling: float = _factor('Largest RMS of a residual over that of the sensors.')
    model_ceiling: np.ndarray = _several(
        'RMS that a sound model leaves in MoCap acceleration [m/s^2], MoCap rate [rad/s] and '
        'joint angle [rad].', 3)
    gust_ceiling: np.ndarray = _several(
        'RMS that gusts make in specific force [m/s^2] and angular acceleration [rad/s^2].', 2)

    tolerance_mass: float = _share('Prior deviation of the mass.')
    tolerance_inertia: float = _share('Prior deviation of each moment of inertia.')
    tolerance_thrust: float = _share('Prior deviation of thrust, of each rotor and of all.')
    tolerance_position: float = parameter(
        doc='Prior deviation of the place of a rotor, each axis.', unit='m', low=0, high=1)
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
        doc='Noise of MoCap above which latencies of sensors are no finding.', unit='m', low=0,
        high=1)
    coarse_latency: np.ndarray = _several(
        'Latency of IMU and encoders that noisy sensors may have.', 2, 's', 1)
    imu_averaging: float = _time('Latency of an IMU that averages.', 0, 0.1)
    command_delay: float = _time('Nominal delay from a stamp to the actuator.', 0, 0.1)
    command_delay_range: float = _time('Range of that delay which has no name.', 0, 0.1)
    bus_near: np.ndarray = _several(
        'Prior deviation of that delay within its range, with good and with noisy sensors.', 2,
        's', 1, 1e-6)
    tolerance_swing: float = _factor('Log ratio of the inertia that a servo may feel.', 10)
    modules_tolerance: float = _share('Prior deviation of the terms of the tilting modules.')

    most_effects: int = _count('Most effects that are named.', high=20)
    least_gain: float = _chi2('Least gain of an effect.')
    least_believed: float = _chi2('Least gain of an effect that brings tolerances back.')
    parameter_price: float = _chi2('Further gain for each parameter beyond the first.')
    least_share: float = _share('Least part of what is left that an effect explains.')
    weak_share: float = _share('The same, where blocks left out agree.')
    weak_agreement: float = _factor('Standard errors by which they agree, of a large gain.')
    weak_gain: float = _factor('A gain is large beyond so many times the least gain.')
    strong_agreement: float = _factor('Standard errors by which they agree, of a small gain.')
    sure_blocks: float = _share('Part of the blocks that must gain then.')
    held_out_errors: float = _factor('Standard errors of the gain on blocks left out, at least.')
    held_out_blocks: float = _share('Least part of the blocks left out that gain.')
    held_out_nearly_all: float = _share('Part of them that replaces the standard errors.')
    held_out_share: float = _share('Least gain on blocks left out, of the fitted gain.')
    elsewhere_share: float = _share('The same, without the block that gains most.')
    least_elsewhere: float = _chi2('Least gain outside the block that gains most.')
    least_uneven: float = _chi2('Gain from which blocks may gain unevenly.')
    part_share: float = _factor('Gain in slow or quick motion alone, over that in all motion.')
    part_free: float = _chi2('Further such gain for each parameter.')
    band_edges: np.ndarray = _several('Edges between the bands of motion.', 4, 'Hz', 50, 0.01)
    slow_below: float = parameter(
        doc='Edge of slow motion, one of `band_edges`.', unit='Hz', low=0.01, high=50)
    early_command: float = _time('Largest lead of a command on its stamp.', 0, 0.1)
    enough: float = _share('Least part of what known effects explain.')
    rival_share: float = _share('Difference of gains within which two effects are a set.')
    rival_gain: float = _chi2('The same, as a gain.')
    decidable: float = parameter(
        doc='Least standard deviations that a realistic effect shows.', unit='sigma', low=0,
        high=1e3)
    least_liveliness: float = _factor('Least acceleration over what nothing explains.')
    block: float = _time('Length of a block of cross-validation.', 1)
    least_blocks: int = _count('Least number of blocks of all flights.', 2)

    wide: float = _factor('Typical sizes within which any parameter is sought.')
    most_turns: int = _count('Most times that slopes are taken anew.', high=50)
    most_iterations: int = _count('Most iterations of a fit.', high=100)
    far: float = _factor('Typical sizes of a change that makes slopes useless.')
    beyond: float = _factor('Prior deviations that no robot has.')
    takeovers: int = _count('Most times that other parameters take over from those.', 0, 50)
    refined: int = _count('Candidates of a step that are fitted.', high=100)
    promising: float = _share('Linear gain of the best that a fitted candidate must promise.')
    promising_curved: float = _share('The same, of candidates that are far from linear.')
    looked_at: float = _share('Part of the least gain that a fitted candidate must promise.')

    form_part: float = _share('Relative error of the form of any effect.')
    form_share: float = _share('Error of that form, of the smallest size worth a name.')
    bus_seen: float = _time('Delay of commands, where detectability is judged.', 1e-5, 0.1)
    disagree: float = _factor('Scatter between parts of the data over noise that counts.')
    excitations: int = _count('Groups of samples by their excitation.', 2, 100)
    least_bands: int = _count('Least number of bands that a parameter comes from.', 2, 100)
    least_variance: float = _share('Least variance of whitened residuals in an interval.')

    contact_height: float = parameter(
        doc='Height of base_link below which feet may touch.', unit='m', low=0, high=10)
    limit_margin: float = _share('Part of the largest thrust up to which samples count.')
    settle: float = _time('Time after take-off that is not used.', 0)
    lifted: float = _share('Commanded thrust over weight that flies.')
    wrong_robot: float = _share(
        'Part by which commanded thrust may fall short of the specific force.')
    same_flight: float = _share('Part of IMU readings in common that makes two files one flight.')

    least_duration: float = _time('Least duration of a flight.', 1)
    longest_gap: float = _time('Longest silence of a sensor.', 0.01)
    most_lost: float = _share('Largest part of a flight in silences.')
    least_rotation: float = parameter(
        doc='Least RMS of the rate.', unit='rad/s', low=0, high=10)

    log_chance: float = parameter(
        doc='Probability that chance gains as much as an entry in a joint log.', unit='1',
        low=1e-9, high=0.5)
    log_effects: int = _count('Most entries that are named of a joint log.', high=50)
    log_offset: float = parameter(
        doc='Least zero that is named of a joint log.', unit='rad', low=0, high=1)
    log_friction: float = _factor('Least change of friction that is named, of the believed.')
    log_dead_band: float = parameter(
        doc='Least change of its dead band.', unit='rad', low=0, high=1)
    log_as_well: float = _factor(
        'Error over that of the freest fit up to which a joint log shows no gap.')
    log_changes_chance: float = _share('Chance that a row of two logs is called significant.')
    log_changes_factor: float = _factor('Deviation of frequency and damping about the median.')

    least_left: float = _chi2('What known effects could still explain, to say unknown.')
    least_remainder: float = _chi2('Gain of a generic regression, to say unknown.')
    least_channel: float = _chi2('The same, in one channel.')
    remainder_ridge: float = _factor('Ridge of that regression, in percent of its mean diagonal.')
    least_force: float = parameter(
        doc='Least RMS of what repeats in specific force.', unit='m/s^2', low=0, high=100)
    least_torque: float = parameter(
        doc='Least RMS of what repeats in angular acceleration.', unit='rad/s^2', low=0, high=100)
    least_joint: float = parameter(
        doc='Least RMS of what repeats in a joint angle.', unit='rad', low=0, high=1)
    remainder_share: float = _share('Gain of that regression over that of the named effects.')
    least_pattern: float = _chi2('Gain of one question beyond the catalogue.')
    pattern_agrees: np.ndarray = parameter(
        doc='Standard errors of the gain and part of the blocks that gain, of either of which one '
        'pair is enough.', shape=(2, 2), low=0, high=100)
    pattern_share: float = _share('The same, over the gain of the named effects.')
    pattern_force: float = parameter(
        doc='Likely size of a force of a question.', unit='N', low=1e-3, high=100)
    pattern_thrust: float = _share('Likely size of a change of thrust of a question.')
    warm_up: float = _time('Time constant of what warms up.', 0.1)
    place_spacing: float = parameter(
        doc='Distance of places at which a force is sought.', unit='m', low=0.05, high=10)
    place_width: float = parameter(
        doc='Width of such a place.', unit='m', low=0.05, high=10)
    swings: np.ndarray = _several('Frequencies of loose masses.', 5, 'Hz', 50, 0.01)
    swing_damping: float = _share('Damping ratio of loose masses.')
    swing_mass: float = _share('Likely part of the mass that is loose.')
    swinging_force: float = parameter(
        doc='Least RMS of the force of a loose mass.', unit='m/s^2', low=0, high=100)
    rhythms: np.ndarray = _several('Range in which a line is sought.', 2, 'Hz', 50)
    line_beside: float = parameter(
        doc='Width to each side with which a line is compared.', unit='Hz', low=0.01, high=50)
    least_line: float = _factor('Power of a line over the median beside it.')

    agreement: float = _factor('Noise floors up to which no gap can be said.')
    most_hidden: float = _share('Part of the catalogue out of sight, up to which it can.')
    crowd: int = _count('Members of a set that is no answer.', 2, 100)
    at_floor: float = _factor('Noise floors below which a gap cannot be closed.')
    run_every: float = _time('Time between starts of free runs.', 0.01)
    run_floors: np.ndarray = _several(
        'Least noise floor of position [m], velocity [m/s], orientation [rad], rate [rad/s] and '
        'joint angle [rad].', 5, low=1e-9)
    run_draws: int = _count('Draws of gusts for a noise floor.', 10, 100000)
    runs_a_block: int = _count('Free runs that share gusts.')
    clearly_worse: float = _factor('Standard errors by which held-out flights are worse.')
    regime_worse: float = _factor('Factor by which a regime may get worse.')
    far_off: float = _factor('Noise floors that named effects may leave.')
    least_closed: float = _share('Part of a gap that they close else.')

    def __post_init__(self):
        """Refuse an edge of slow motion between two bands."""
        if self.slow_below not in self.band_edges:
            raise ParameterError(f"key 'slow_below': {self.slow_below:g} Hz is none of "
                                 f"band_edges {self.band_edges.tolist()}")

    @classmethod
    def load(cls, path: str | Path | None = None, **changed) -> GapParameters:
        """
        Read the shipped file, a further one on top of it, and single changes.

        Raises:
            ParameterError: naming file and key; an unknown key, another type or range.

        """
        shipped = share_path('params/gap.yaml')
        values = schema.load_yaml(shipped) | (schema.load_yaml(path) if path else {}) | changed
        return schema.bind(cls, values, str(path or shipped))
