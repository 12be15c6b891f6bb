"""Identification of the tilt servos from the first part of a response log."""

from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_fit import (
    decode,
    encode,
    first_noise,
    fitted_samples,
    noise_around,
    prior_of,
    Problems,
    ServoFitter,
)
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, OFF, published_set, simulate
from beetle_omni_ros.identify.servo_terms import CANDIDATES, Choice, free_mask, Selector
from beetle_omni_ros.identify.uncertainty import (
    Experiment,
    inseparable_pairs,
    separating_experiments,
    uncertainties,
    Uncertainty,
)
from beetle_omni_ros.robot.parameters import JointParameters

MOST_PASSES = 3         # of selection, while the noise decreases
MOST_ROUNDS, RESTING = 10, 0.2    # of refits; they end at this change of the median, in scales
CERTAIN = ('delay', 'coulomb_friction')   # terms of the model that estimates the noise


@dataclass(frozen=True)
class JointModel:
    """
    Identified model of one servo.

    Attributes:
        joint: number of the joint, 1 to 4.
        kept: accepted candidates.
        values: (n,) parameter set for predictions; limits that the log did not reach as published.
        estimates: (n,) also estimates of rejected candidates.
        uncertainty: uncertainty of the estimates.
        inseparable: pairs that the log does not separate.
        experiment: experiment that would separate delay and bandwidth.
        gain: candidate -> gain in chi2 on held-out blocks.

    """

    joint: int
    kept: tuple[str, ...]
    values: np.ndarray
    estimates: np.ndarray
    uncertainty: Uncertainty
    inseparable: list[list[str]]
    experiment: Experiment
    gain: dict[str, float]


def identify_joints(log: JointLog, published: JointParameters) -> list[JointModel]:
    """Identify every joint of a log from its first part."""
    log = log.first(shipped().servo.fitted)
    start = published_set(published)
    weight = np.tile(fitted_samples(log), (len(log.joints), 1))
    noise = _first_noise(log, start, weight)
    prior = prior_of(encode(start), shipped().servo.published)
    for _ in range(MOST_PASSES):
        fitter = ServoFitter(log, noise, prior=prior)
        choices = Selector(fitter, weight[0]).run(_unlimited(start))
        problems = Problems.single_joints(
            np.arange(len(log.joints)), np.array([choice.values for choice in choices]),
            np.array([free_mask(choice.kept) for choice in choices]), weight)
        points = _best(fitter, problems)
        before, noise = noise, noise_around(log, decode(points), weight[0])
        if (noise.sigma > shipped().servo.nearly * before.sigma).all():
            break       # with less noise, further terms may become significant
    sets = decode(_with_common_prior(log, noise, problems, points))
    return _models(log, noise, choices, sets, weight, start)


def _best(fitter, problems):
    """Fit each joint from several starts, because chi2 may have several minima."""
    count, starts = len(problems.joints), [problems]
    for frequency, delay in shipped().servo.restarts:
        sets = decode(problems.points)
        sets[:, INDEX['natural_frequency']] = frequency
        sets[:, INDEX['delay']] = np.where(problems.free[:, INDEX['delay']], delay, 0.0)
        starts.append(replace(problems, points=encode(sets)))
    fits = fitter.solve(Problems.join(starts))
    choice = fits.chi2.reshape(-1, count).argmin(axis=0) * count + np.arange(count)
    return fits.points[choice]


def _with_common_prior(log, noise, problems, points):
    """
    Repeat the fit with a prior about the median of all joints, until the median converges.

    The prior matters only for joints whose log is not informative.
    """
    if len(points) < shipped().servo.least_common:
        return points
    for _ in range(MOST_ROUNDS):
        common = np.median(points, axis=0)
        points = ServoFitter(log, noise, prior=prior_of(common, shipped().servo.common)).solve(
            replace(problems, points=points), 8).points
        change = np.median(points, axis=0) - common
        if np.abs(change[[INDEX[name] for name in shipped().servo.common]]).max() < RESTING:
            break
    return points


def _unlimited(start):
    return np.where(free_mask(()), start, OFF)


def _first_noise(log, start, weight):
    """Noise around a model with the certain terms, and with a speed limit if one is possible."""
    joints = np.arange(len(log.joints))
    sets = np.tile(_unlimited(start), (len(joints), 1))
    sets[:, INDEX['delay']], sets[:, INDEX['coulomb_friction']] = 0.01, 0.01
    free = np.tile(free_mask((*CERTAIN, 'offset')), (len(joints), 1))
    beyond = log.command_speed() > shipped().servo.beyond * log.speed()
    limit = INDEX['velocity_limit']
    sets[beyond, limit], free[beyond, limit] = log.speed()[beyond], True
    fitter = ServoFitter(log, first_noise(log),
                         prior=prior_of(encode(start), shipped().servo.published))
    fits = fitter.solve(Problems.single_joints(joints, sets, free, weight))
    return noise_around(log, decode(fits.points), weight[0])


def _models(log, noise, choices: list[Choice], sets, weight, start):
    """Models with intervals: of accepted terms jointly, of each other term if it joined them."""
    rows, owner = [], []
    for j, choice in enumerate(choices):
        for name in (None, *(n for n in CANDIDATES if n not in choice.kept)):
            if name is not None and name not in choice.tried:
                continue
            kept = choice.kept if name is None else (*choice.kept, name)
            values = sets[j].copy()
            if name is not None:
                for member in CANDIDATES[name].members:
                    values[INDEX[member]] = choice.tried[name][INDEX[member]]
            rows.append(Problems.single_joints([j], values[None], free_mask(kept)[None],
                                               weight[j:j + 1]))
            owner.append((j, name))
    problems = Problems.join(rows)
    profiled = np.array([name in (None, 'delay') for _, name in owner])
    judged = dict(zip(owner, uncertainties(log, noise, problems, profiled), strict=True))
    plans = separating_experiments(
        sets, np.array([free_mask(choice.kept) for choice in choices]), noise,
        np.array([judged[j, None].scatter for j in range(len(choices))]))
    models = []
    for j, choice in enumerate(choices):
        main, estimates = judged[j, None], sets[j].copy()
        for name in CANDIDATES:
            if (j, name) in judged:
                for member in CANDIDATES[name].members:
                    index = INDEX[member]
                    estimates[index] = choice.tried[name][index]
                    main.intervals[index] = judged[j, name].intervals[index]
        values = _with_published_limits(log, j, choice, sets[j], start, estimates, main)
        names = [n for n in NAMES if free_mask(choice.kept)[INDEX[n]]]
        judge = judged.get((j, 'delay'), main)
        pairs = inseparable_pairs(judge, names if 'delay' in names else [*names, 'delay'])
        models.append(JointModel(
            log.joints[j], choice.kept, values, estimates, main, pairs, plans[j], choice.gain))
    return models


def _with_published_limits(log, j, choice: Choice, values, start, estimates, uncertainty):
    """Values with limits that the log did not reach as published, or above the reached value."""
    values = values.copy()
    seen = {'velocity_limit': log.speed()[j],
            'torque_limit': np.abs(log.command[j] - log.measured[j]).max()}
    for name, reached in seen.items():
        index = INDEX[name]
        if name in choice.kept:
            continue
        limit = max(start[index], 1.1 * reached)
        values[index] = estimates[index] = limit
        uncertainty.intervals[index] = reached, np.inf
    return values


def error_rms(log: JointLog, joint: int, values: np.ndarray, held: bool = True,
              part: slice = slice(None)) -> float:
    """RMS of prediction minus measurement [rad] of the joint with this index."""
    error = simulate(log, joint, values[None], held)[0] - log.measured[joint]
    return float(np.sqrt(np.mean(error[part]**2)))
