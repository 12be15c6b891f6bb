"""
The next flight: random poses whose measurements answer what the flights left open.

The hypotheses are sets of catalogue entries. Under hypothesis i, the keys theta have the posterior
N(m_i, P_i) of the flights so far. A flight with the information M of all keys measures
z = L' theta + e, where M = L L' and e is white, so that z is N(L' m_i, L' P_i L + 1). Whatever
another hypothesis, a tolerance, the flight or the discrepancy explains as well, it does not count.
Of some sequences of random poses, the one with the largest probability of a right answer is
written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from beetle_omni_ros.identify.flights.apply import effects_with, robot_with
from beetle_omni_ros.identify.flights.bag_flight import BagFlight
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.evidence import log_prior, Normal, normal, Solution
from beetle_omni_ros.identify.flights.results import member_of, Weighed
from beetle_omni_ros.identify.flights.spectrum import pooled
from beetle_omni_ros.identify.flights.table_flight import TableFlight
from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.identify.inference.noise import few_blocks, positive
from beetle_omni_ros.identify.recording.bag import recording_of
from beetle_omni_ros.identify.recording.flight import prepare, UnusableFlight
from beetle_omni_ros.identify.recording.parameters import GapParameters
from beetle_omni_ros.identify.recording.series import turning
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError

OPEN = 'named_set', 'not_decidable'     # verdicts
MOST = 5                # hypotheses that are compared
SIMULATED = 2           # of these, the most probable ones are plants of the check of the task
SAMPLES = 4000          # of measurements of each hypothesis
FAINT = 1e-4            # information in units of the priors that does not count
TASKS = 3               # sequences of random poses of which the best is written


@dataclass(frozen=True, eq=False)
class Explanation:
    """
    A set of entries that may be the truth.

    Attributes:
        label: of the entry that distinguishes it.
        chosen: indices of all its entries.
        odds: ln of its probability, but for a constant.
        mean, covariance: (K,) and (K, K) of all keys by the flights so far.

    """

    label: str
    chosen: tuple[int, ...]
    odds: float
    mean: np.ndarray
    covariance: np.ndarray


def hypotheses_of(weighed: Weighed) -> list[Explanation]:
    """The most probable members of the first open set, each with the other named entries."""
    engine, solution, best = weighed.engine, weighed.solution, weighed.solution.best
    unclear = [own for own in weighed.named(engine.alpha) if len(own[1]) > 1]
    if not unclear:
        return []
    equations = normal(solution.spectra, engine.names, engine.flight)
    k, members = unclear[0]
    found = []
    for j in members[:MOST]:
        own = tuple(sorted({*best, j} - ({k} - {j})))
        found.append(Explanation(
            solution.entries[j].label, own, engine.gain(solution.judge, own, best),
            *posterior_of(engine, solution, equations, own)))
    return found


def posterior_of(engine: Engine, solution: Solution, equations: Normal,
                 chosen: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """
    Mean (K,) and covariance (K, K) of all keys, with the priors that the engine has for a set.

    The factor of a limit that acts is one in a set that has it, not zero.
    """
    prior = engine.narrow.copy()
    free = engine.indices((*chosen, *solution.banned))
    prior[free] = np.hypot(prior[free], engine.typical[free])
    c, _, _, _, slab = solution.judge._profile(tuple(sorted(engine.indices(chosen))))
    own = np.isin(c, free)
    prior[c] = np.where(own, slab, prior[c])
    right = equations.right.copy()
    right[c] += own * solution.judge.acting[c] * slab**-2
    covariance = prior[:, None] * np.linalg.inv(
        prior[:, None] * equations.info * prior + np.eye(len(prior))) * prior
    return covariance @ right, covariance


def information(engine: Engine, solution: Solution, grams: Sequence[np.ndarray] | np.ndarray
                ) -> np.ndarray:
    """(K, K) information of blocks of one more flight, without what differs between flights."""
    total, own = np.sum(grams, axis=0), np.flatnonzero(engine.flight > 0)
    inner = np.linalg.inv(total[np.ix_(own, own)] + np.diag(engine.flight[own]**-2))
    total = total - total[:, own] @ inner @ total[own]
    blocks = sum(len(each.residual) for each in solution.spectra) + len(grams)
    return total / few_blocks(engine.alpha / len(engine.entries), blocks)


class Outlook:
    """What a flight is expected to decide between hypotheses."""

    def __init__(self, engine: Engine, solution: Solution, hypotheses: Sequence[Explanation]):
        self._engine, self._solution = engine, solution
        self._hypotheses, self._scale = list(hypotheses), np.hypot(engine.narrow, engine.typical)
        odds = np.array([each.odds for each in hypotheses])
        self.odds, self.weights = odds, np.exp(odds - np.logaddexp.reduce(odds))
        self.question = 'decides between ' + ' and '.join(each.label for each in hypotheses)
        self.labels = [each.label for each in hypotheses]

    def chances(self, grams: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """(H, 2) probability that each hypothesis, if true, is decided, and another one is."""
        s, rng = self._scale, np.random.default_rng(0)
        values, vectors = np.linalg.eigh(
            s[:, None] * information(self._engine, self._solution, grams) * s)
        keep = values > FAINT
        root = np.sqrt(values[keep]) * vectors[:, keep] / s[:, None]
        # mean (r,) and covariance (r, r) of the measurements under each hypothesis
        moments = [(root.T @ each.mean, root.T @ each.covariance @ root + np.eye(keep.sum()))
                   for each in self._hypotheses]
        least, found = log(1 / self._engine.alpha), []
        for k, (mean, covariance) in enumerate(moments):
            z = rng.multivariate_normal(mean, covariance, SAMPLES, method='cholesky')
            odds = self.odds + np.stack([log_density(z, *own) for own in moments], axis=1)
            order = np.sort(odds, axis=1)
            sure = order[:, -1] - order[:, -2] > least
            right = odds.argmax(axis=1) == k
            found.append([(sure & right).mean(), (sure & ~right).mean()])
        return np.array(found)


class Sight:
    """What a flight is expected to show of single effects of typical size, if one is there."""

    def __init__(self, engine: Engine, solution: Solution, names: Sequence[str]):
        self._engine, self._solution = engine, solution
        self._info = normal(solution.spectra, engine.names, engine.flight).info
        count = len(engine.entries)
        self._least = log(1 / engine.alpha) + log_prior(0, count) - log_prior(1, count)
        keys = {name: [engine.indices((k,)) for k, entry in enumerate(engine.entries)
                       if entry.name == name and not entry.varying] for name in names}
        # the balance of torques has entries of its own
        self._keys = {name: own for name, own in keys.items() if own}
        self.labels = list(self._keys)
        self.weights = np.full(len(self.labels), 1 / max(len(self.labels), 1))
        self.question = f'names one of {len(self.labels)} effects of typical size that are ' \
                        'hidden now,'

    def chances(self, grams: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """(H, 2) probability that each effect is named if it is there, and 0."""
        narrow = self._engine.narrow
        info = self._info + information(self._engine, self._solution, grams)
        covariance = narrow[:, None] * np.linalg.inv(
            narrow[:, None] * info * narrow + np.eye(len(narrow))) * narrow
        # of an effect with several entries, that of the clearest one
        return np.array([[max(self._chance(covariance, c) for c in entries), 0.0]
                         for entries in self._keys.values()])

    def _chance(self, covariance, c):
        """Probability that the evidence for a deviation of the keys ``c`` suffices."""
        own = self._engine.narrow[c]
        _, less, _ = positive(np.linalg.inv(covariance[np.ix_(c, c)]) - np.diag(own**-2), own)
        null = less.T @ less + np.diag(own**2)
        wide = null + np.diag(self._engine.typical[c]**2)
        none = np.zeros(len(c))
        z = np.random.default_rng(0).multivariate_normal(none, wide, SAMPLES)
        return (log_density(z, none, wide) - log_density(z, none, null) > self._least).mean()


def log_density(z: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(N,) ln of the normal density at z (N, r), but for a constant; it may be very narrow."""
    lower = np.linalg.cholesky(covariance)
    white = solve_triangular(lower, (z - mean).T, lower=True)
    return -0.5 * (white**2).sum(axis=0) - np.log(np.diag(lower)).sum()


def grams_of(engine: Engine, solution: Solution, flight: Any) -> np.ndarray:
    """(B, K, K) information of the blocks of a flight, linearised at the fitted values."""
    theta = np.zeros(len(engine.names))
    theta[:engine.known] = solution.theta[:engine.known]
    flight.settle(dict(zip(engine.names, theta[:engine.real], strict=False)))
    [found], _ = engine.others([flight], theta)
    found.noise = pooled(solution.spectra)
    return found.grams()[0].sum(axis=1)


@dataclass(frozen=True, eq=False)
class Planner:
    """
    Plans the next flight after an analysis.

    Args:
        robot: robot file.
        p: parameters of the gap finder.
        experiments: random poses, :class:`~beetle_omni_ros.flight.experiment.Experiments`.
        path: task to write.

    """

    robot: RobotParameters
    p: GapParameters
    experiments: Any
    path: Path

    def __call__(self, weighed: Weighed, result: dict, judges: Sequence = ()) -> dict[str, Any]:
        """
        Plan a flight, check it, and write it as a task.

        Args:
            weighed: what the flights so far say.
            result: of the analysis.
            judges: flights that judge, not used.

        Returns:
            ``next_flight``: ``task`` (None: none is written), ``sentence``, and of a written one
            ``poses``, ``probability`` that it decides rightly and ``wrong`` that it decides
            wrongly, and both of each of the ``hypotheses``.

        """
        if result['verdict'] not in OPEN:
            return _without(f"{result['verdict']}: there is nothing to decide")
        engine, solution, level = weighed.engine, weighed.solution, weighed.starts is None
        own, hypotheses = self.experiments, hypotheses_of(weighed)
        outlook = Outlook(engine, solution, hypotheses) if hypotheses else Sight(
            engine, solution, result['hidden'] or [r['name'] for r in result['candidates'][:MOST]])
        if not outlook.labels:
            return _without('the effects that are hidden show only in means of torques')
        plants = [None] if level else [plant_of(weighed, each, self.robot)
                                       for each in hypotheses[:SIMULATED]] or [weak(self.robot)]
        found = []
        # other poses after each flight
        for seed in range(TASKS * len(engine.flights), TASKS * (len(engine.flights) + 1)):
            poses = own.poses(seed, level=level)
            flight = self._flown(engine, poses, plants[0])
            if flight is not None and flight.usable:
                chances = outlook.chances(grams_of(engine, solution, flight))
                found.append((float(outlook.weights @ chances[:, 0]), seed, poses, chances))
        for _, _, poses, chances in sorted(found, reverse=True):
            if all(own.flown(poses, plant) is not None for plant in plants[1:]):
                return {'next_flight': self._written(outlook, chances, poses, level)}
        return _without('no random poses keep their margins with all candidates')

    def _flown(self, engine, poses, plant):
        """A flight of poses with a plant, exact without one; None if it cannot be used."""
        own, like = self.experiments, engine.flights[0]
        if plant is None:
            level = flat_flight(like, *own.level_motion(poses, like.period))
            return level if own.is_gentle(level._thrust({})[0]) else None
        log_ = own.flown(poses, plant)
        try:
            recording = log_ and prepare(recording_of(log_, 'next flight'), self.robot, self.p)
        except UnusableFlight:
            return None
        if not recording:
            return None
        flight = BagFlight(recording, self.robot, like._body, like.keys, self.p)
        flight.modules, flight.starts, flight.tangents = like.modules, like.starts, like.tangents
        return flight

    def _written(self, outlook, chances, poses, level):
        """Write a task; what it is expected to decide."""
        own, path = self.experiments, self.path
        right, wrong = outlook.weights @ chances
        question = outlook.question.replace('_', ' ')
        sentence = f'{path}: {own.duration:.0f} s, {question} with a probability of {right:.2f}'
        sentence += f', and wrongly with {wrong:.2f}' if wrong >= 0.005 else ''
        own.write(path, poses, level, f'Written by beetle_omni gap --next.\n{sentence}.')
        return {'task': str(path), 'sentence': sentence, 'poses': poses.tolist(),
                'probability': float(right), 'wrong': float(wrong), 'hypotheses': [
                    {'name': label, 'weight': float(weight), 'probability': float(chance[0]),
                     'wrong': float(chance[1])} for label, weight, chance in zip(
                        outlook.labels, outlook.weights, chances, strict=True)]}


def _without(reason):
    return {'next_flight': {'task': None, 'sentence': f'{reason}, and no task is written'}}


def weak(robot: RobotParameters) -> RobotParameters:
    """The robot, heavier and with less thrust by their typical deviations."""
    mass, thrust = (TREATMENTS[name].sizes[key].typical for name, key in (
        ('mass', 'mass'), ('thrust_coefficient', 'scale')))
    return robot_with(robot, {**robot.effects, 'mass': {'mass': robot.mass * (1 + mass)},
                              'thrust_coefficient': {'scale': 1 - thrust}})


def plant_of(weighed: Weighed, hypothesis: Explanation, robot: RobotParameters
             ) -> RobotParameters:
    """The robot file with the fitted values of a hypothesis, as far as they are possible."""
    entries = weighed.solution.entries
    named = [{'names': [entries[k].name], **member_of(entries[k]),
              'parameters': weighed.sizes(k, hypothesis.chosen)}
             for k in hypothesis.chosen if not entries[k].varying]
    try:
        return robot_with(robot, effects_with(robot, named))
    except ParameterError:
        return robot


def flat_flight(like: TableFlight, position: np.ndarray, yaw: np.ndarray) -> TableFlight:
    """
    A flight of level rotors without noise, which follows a motion exactly, without a simulator.

    Position and yaw determine its attitude, thrusts and measurements (differential flatness,
    Mellinger and Kumar 2011).

    Args:
        like: a flight, whose signals the new one has.
        position: (N, 3) in world at the period of ``like`` [m].
        yaw: (N,) [rad].

    """
    robot, h, n = like.robot, like.period, len(yaw)
    velocity = np.gradient(position, h, axis=0)
    acceleration = np.gradient(velocity, h, axis=0)
    felt = acceleration + [0.0, 0.0, robot.gravity]
    up = felt / np.linalg.norm(felt, axis=1, keepdims=True)
    side = np.cross(up, np.stack([np.cos(yaw), np.sin(yaw), np.zeros(n)], axis=1))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = Rotation.from_matrix(np.stack([np.cross(side, up), side, up], axis=2))
    rate = turning(axes.as_quat(), h)
    force = np.stack([np.zeros(n), np.zeros(n), np.linalg.norm(felt, axis=1)], axis=1)
    torque = robot.inertia * np.gradient(rate, h, axis=0) + np.cross(rate, robot.inertia * rate)
    # thrust and torques of level rotors, for each newton
    x, y, _ = robot.rotors.positions.T
    mixer = np.stack([np.ones(4), y, -x, -robot.rotors.spin
                      * robot.rotors.torque_to_thrust_ratio])
    thrust = np.column_stack([robot.mass * force[:, 2], torque]) @ np.linalg.inv(mixer).T
    thrust += robot.rotors.time_constant * np.gradient(thrust, h, axis=0)   # before the lag
    known = {'position': position, 'quaternion': axes.as_quat(), 'velocity': velocity,
             'acceleration': acceleration, 'specific_force': force, 'angular_velocity': rate,
             'thrust': thrust, 'tilt': np.zeros((n, 4)), 'attitude': axes.as_euler('xyz')}
    values = {name: known[name] for name in like.table.values if name in known}
    if 'velocity' in values and like.table.format.signals['velocity'].frame == 'body':
        values['velocity'] = axes.inv().apply(velocity)
    if (motor := robot.rotors.motor) is not None and 'duty' in like.table.values:
        volts = np.linspace(0.0, motor.nominal_voltage, 200)
        curve = np.maximum.accumulate(np.polynomial.polynomial.polyval(volts, motor.coefficients))
        values['duty'] = np.interp(thrust, curve, volts) / motor.nominal_voltage
        if 'voltage' in like.table.values:
            values['voltage'] = np.full((n, 1), motor.nominal_voltage)
    flight = TableFlight(replace(like.table, name='next flight', values=values), robot, like.body,
                         like.keys)
    lost = {name.split('_')[0] for name in flight.channels} - {
        name.split('_')[0] for name in like.channels}
    flight.without(tuple(lost), 'not in the flights before')
    return flight
