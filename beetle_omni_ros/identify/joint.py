"""Identification of the tilt servos from one response log, judged on what was not fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.selection import CANDIDATES, Choice, free_mask, LINEAR, Selector
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
from beetle_omni_ros.identify.uncertainty import (
    Experiment,
    separating_experiments,
    traded,
    uncertainties,
    Uncertainty,
)
from beetle_omni_ros.robot.parameters import JointParameters

MOST_PASSES = 3         # of selection, while the noise falls
P = shipped().servo
MOST_ROUNDS, RESTING = 10, 0.2    # of refits; change of the median, in scales, that ends them
CERTAIN = ('delay', 'coulomb_friction')   # in the model that estimates the noise


@dataclass(frozen=True)
class JointModel:
    """
    What one servo turned out to be.

    Attributes:
        joint: number, 1 to 4.
        kept: candidates in the model.
        values: (n,) parameter set that predicts; where the log says nothing, as published.
        estimates: (n,) also of numbers that are not in the model.
        uncertainty: of the estimates.
        traded: pairs that the log cannot separate.
        experiment: that would separate delay and bandwidth.
        gain: candidate -> chi2 gained on unseen blocks.

    """

    joint: int
    kept: tuple[str, ...]
    values: np.ndarray
    estimates: np.ndarray
    uncertainty: Uncertainty
    traded: list[list[str]]
    experiment: Experiment
    gain: dict[str, float]


def identify_joints(log: JointLog, published: JointParameters,
                    fitted: float = P.fitted) -> list[JointModel]:
    """
    Identify every joint of a log from its first part.

    Args:
        log: commands and positions.
        published: the servo as the robot file has it.
        fitted: part of the log that may be looked at.

    """
    log = log.first(fitted)
    start = published_set(published)
    weight = np.tile(fitted_samples(log), (len(log.joints), 1))
    noise = _first_noise(log, start, weight)
    prior = prior_of(encode(start), P.published)
    for _ in range(MOST_PASSES):
        fitter = ServoFitter(log, noise, prior=prior)
        choices = Selector(fitter, weight[0]).run(_unlimited(start))
        problems = Problems.apart(
            np.arange(len(log.joints)), np.array([choice.values for choice in choices]),
            np.array([free_mask(choice.kept) for choice in choices]), weight)
        points = _best(fitter, problems)
        before, noise = noise, noise_around(log, decode(points), weight[0])
        if (noise.sigma > P.nearly * before.sigma).all():
            break       # else the terms found let see more than the first model did
    sets = decode(_alike(log, noise, problems, points))
    return _models(log, noise, choices, sets, weight, start)


def _best(fitter, problems):
    """Fit each joint from several starts, for chi2 may have more than one valley."""
    count, starts = len(problems.joints), [problems]
    for frequency, delay in P.restarts:
        sets = decode(problems.points)
        sets[:, INDEX['natural_frequency']] = frequency
        sets[:, INDEX['delay']] = np.where(problems.free[:, INDEX['delay']], delay, 0.0)
        starts.append(replace(problems, points=encode(sets)))
    fits = fitter.solve(Problems.join(starts))
    choice = fits.chi2.reshape(-1, count).argmin(axis=0) * count + np.arange(count)
    return fits.points[choice]


def _alike(log, noise, problems, points):
    """
    Fit again, each joint with the median of all as a prior, until the median rests.

    A joint whose log decides stays where it is; one whose log does not, follows.
    """
    if len(points) < P.least_common:
        return points
    for _ in range(MOST_ROUNDS):
        common = np.median(points, axis=0)
        points = ServoFitter(log, noise, prior=prior_of(common, P.common)).solve(
            replace(problems, points=points), 8).points
        change = np.median(points, axis=0) - common
        if np.abs(change[[INDEX[name] for name in P.common]]).max() < RESTING:
            break
    return points


def _unlimited(start):
    return np.where(free_mask(()), start, OFF)


def _first_noise(log, start, weight):
    """Noise around the model whose terms are certain, and a speed limit where one may be."""
    joints = np.arange(len(log.joints))
    sets = np.tile(_unlimited(start), (len(joints), 1))
    sets[:, INDEX['delay']], sets[:, INDEX['coulomb_friction']] = 0.01, 0.01
    free = np.tile(free_mask((*CERTAIN, 'offset')), (len(joints), 1))
    beyond = log.asked_speed() > P.beyond * log.speed()
    limit = INDEX['velocity_limit']
    sets[beyond, limit], free[beyond, limit] = log.speed()[beyond], True
    fitter = ServoFitter(log, first_noise(log),
                         prior=prior_of(encode(start), P.published))
    fits = fitter.solve(Problems.apart(joints, sets, free, weight))
    return noise_around(log, decode(fits.points), weight[0])


def _models(log, noise, choices: list[Choice], sets, weight, start):
    """Intervals of the kept numbers together, and of each other one if it joined them."""
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
            rows.append(Problems.apart([j], values[None], free_mask(kept)[None],
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
        pairs = traded(judge, names if 'delay' in names else [*names, 'delay'])
        models.append(JointModel(
            log.joints[j], choice.kept, values, estimates, main, pairs, plans[j], choice.gain))
    return models


def _with_published_limits(log, j, choice: Choice, values, start, estimates, uncertainty):
    """Limits that the log never reaches stay as published, unless the log went beyond them."""
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


__all__ = ['error_rms', 'identify_joints', 'JointModel', 'LINEAR']
