"""
One servo model for all joints and logs, and the terms that the logs need.

Each joint of each log is a unit of :mod:`beetle_omni_ros.identify.inference.hierarchy`. Servos of
one type share their values, and each has its own deviation. Two logs differ in their delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.stats import chi2

from beetle_omni_ros.identify.inference.hierarchy import design, Fit, solve
from beetle_omni_ros.identify.inference.noise import Drifting, drifting, HUBER, scale_of
from beetle_omni_ros.identify.servo.log import JointLog
from beetle_omni_ros.identify.servo.model import (
    ENTRIES,
    INDEX,
    LIMITS,
    NAMES,
    READING_ERRORS,
    simulate,
    TERMS,
)
from beetle_omni_ros.model.effects import CATALOGUE

LOGARITHMIC = np.array([term.logarithmic for term in TERMS.values()])
# Of the derivatives: over the kinks of friction and of held commands.
STEP = np.where(LOGARITHMIC, 0.03, 6e-4)
SETTLING = 0.25     # [s] at the start that are not fitted: the first velocity is not measured
FIRST_NOISE = 0.002     # [rad] white noise of the first fit
BEYOND = 1.15       # ratio of the speed of a command and of the joint from which limits are fitted
KINDS = 8           # of motion in a log, each left out in turn
LATE = 0.03         # [s] of a reading behind its command, about
MOMENTS = np.linspace(-0.4, 0.0, 9)     # [s] of commands that determine the kind of motion
# Starts of terms whose chi2 has several minima, or no slope at zero.
STARTS = ({'natural_frequency': 45.0, 'damping_ratio': 0.65, 'delay': 0.012,
           'coulomb_friction': 0.012, 'backlash': 0.002},
          {'natural_frequency': 75.0, 'damping_ratio': 0.75, 'delay': 0.026,
           'coulomb_friction': 0.006, 'backlash': 0.01})


def encoded(values: np.ndarray) -> np.ndarray:
    """Coordinates of parameter sets (..., P): logarithms where the term is logarithmic."""
    return np.where(LOGARITHMIC, np.log(np.where(LOGARITHMIC, values, 1.0)), values)


def decoded(theta: np.ndarray) -> np.ndarray:
    """Inverse of :func:`encoded`."""
    return np.where(LOGARITHMIC, np.exp(np.where(LOGARITHMIC, theta, 0.0)), theta)


LOW, HIGH = (encoded(np.array([getattr(term, side) for term in TERMS.values()]))
             for side in ('low', 'high'))


def mask(entries: Sequence[str]) -> np.ndarray:
    """(P,) terms of catalogue entries."""
    names = {name for entry in entries for name in ENTRIES[entry]}
    return np.array([name in names for name in NAMES])


def kinds_of_motion(parts: Sequence[tuple], count: int) -> list[np.ndarray]:
    """
    Kind (n,) of the commanded motion at the rows of each (log, joint, rows).

    Kinds are clusters of angle, rate, change of rate, and mean rate before, which tells a turn
    from a rest. Blocks of time would repeat: a term that is wrong elsewhere predicts the next
    period of a sine, but not the way down from the way up.
    """
    features = []
    for log, joint, rows in parts:
        angle = log.command_at(joint, log.read_t[rows][:, None] - LATE + MOMENTS)
        rate = np.diff(angle)
        features.append(np.stack([angle[:, -1], rate[:, -1], rate[:, -1] - rate[:, -2],
                                  np.sqrt((rate**2).mean(axis=1))], axis=1))
    every = np.concatenate(features)
    label = kmeans2(every / (every.std(axis=0) + 1e-9), count, minit='++', seed=0)[1]
    return np.split(label, np.cumsum([len(rows) for *_, rows in parts])[:-1])


@dataclass(frozen=True)
class ServoModel:
    """A model: the entries that may differ from the base, except at some units, and their fit."""

    entries: tuple[str, ...]
    fit: Fit
    still: np.ndarray       # (U, P) terms of these entries that stay at the base


class Servos:
    """
    The fitted parts of some logs, their noise, and fits of chosen entries.

    Args:
        logs: response logs.
        base: (J, P) parameter sets of gimbal1 to gimbal4 from which the fits deviate.
        one_delay: whether all joints have the same delay, as in a robot file.

    """

    def __init__(self, logs: Sequence[JointLog], base: np.ndarray, one_delay: bool = False):
        self.logs = list(logs)
        self.units = [(k, j, number) for k, log in enumerate(logs)
                      for j, number in enumerate(log.joints)]
        self.base = encoded(np.array([base[number - 1] for _, _, number in self.units]))
        self.spreads = [term.spread for term in TERMS.values()]
        if one_delay:
            delay = self.spreads[INDEX['delay']]
            self.spreads[INDEX['delay']] = replace(delay, groups={'log': delay.groups['log']})
        self.labels: dict[str, Sequence] = {'joint': [number for *_, number in self.units],
                       'log': [k for k, *_ in self.units], 'unit': self.units}
        self.of_log = [np.flatnonzero([own == k for own, *_ in self.units])
                       for k in range(len(self.logs))]
        self._parts = [log.first() for log in self.logs]
        self.rows = [np.flatnonzero((log.fresh & (log.t >= log.t[0] + SETTLING))[:log.end])
                     for log in self.logs]
        self.low = LOW.copy()
        self.sigma = np.full(len(self.units), FIRST_NOISE)
        self.noise = [Drifting(len(rows)) for rows in self.rows]
        kinds = kinds_of_motion([(self.logs[k], j, self.rows[k]) for k, j, _ in self.units],
                                KINDS)
        self.blocks = [kind + KINDS * k for kind, (k, *_) in zip(kinds, self.units, strict=True)]
        # Each log is predicted from the others, or each kind of motion of one or two logs. A log
        # need not show every kind.
        self.folds = np.arange(1 + max(block.max() for block in self.blocks)) // (
            KINDS if len(logs) > 2 else 1)

    # ---- model of the core
    def __call__(self, theta: np.ndarray, active: np.ndarray):
        """Whitened residuals and their derivatives; see :func:`hierarchy.solve`."""
        residuals, slopes = [], []
        for k, mine in enumerate(self.of_log):
            error, change = self.errors(k, theta, active)
            both = np.concatenate([error[None], change]) / self.sigma[mine, None]
            white = self.noise[k].whitened(both.transpose(2, 1, 0))
            residuals += list(white[:, :, 0].T)
            slopes += list(white[:, :, 1:].transpose(1, 2, 0))
        return residuals, slopes

    def errors(self, k: int, theta: np.ndarray, active: np.ndarray):
        """Predictions minus readings (J, n) of a log's fitted rows, and derivatives (P, J, n)."""
        log, rows, theta = self.logs[k], self.rows[k], theta[self.of_log[k]]
        count = len(theta)
        moved = [p for p in np.flatnonzero(active) if NAMES[p] not in READING_ERRORS]
        # Inward at an upper bound, and from a limit without effect.
        steps = {p: np.where(theta[:, p] + STEP[p] > HIGH[p], -STEP[p], STEP[p]) for p in moved}
        sets = [theta]
        for p in moved:
            sets.append(theta.copy())
            sets[-1][:, p] += steps[p]
        read = simulate(log, np.tile(np.arange(count), len(sets)), decoded(np.concatenate(sets)))
        read = read.reshape(len(sets), count, -1)[:, :, rows]
        change = np.zeros((len(NAMES), count, len(rows)))
        for p, shown in zip(moved, read[1:], strict=True):
            change[p] = (shown - read[0]) / steps[p][:, None]
        for name, shape in READING_ERRORS.items():
            if active[INDEX[name]]:
                change[INDEX[name]] = shape(read[0])
        return read[0] - log.measured[:, rows], change

    # ---- fits
    def estimate_noise(self, entries: Sequence[str], start=()) -> ServoModel:
        """
        Measure the noise around a model; call it before :meth:`fit`.

        The errors are those of the free simulation, so they include what no term describes. It
        depends on the motion, so that it does not average out over more periods. The noise is
        therefore inflated by the scatter of the scores between kinds of motion.
        """
        trial, active = self.fit(entries, start), mask(entries)
        for _ in range(2):
            for k, log in enumerate(self.logs):
                mine = self.of_log[k]
                errors, change = self.errors(k, trial.fit.theta, active)
                signals = [slopes.T @ part for slopes, part in zip(
                    change.transpose(1, 0, 2), trial.fit.s[mine], strict=True)]
                clipped = [np.clip(e, -HUBER * scale_of(e), HUBER * scale_of(e)) for e in errors]
                self.noise[k], sigma = drifting([e - a @ trial.fit.x for e, a in zip(
                    clipped, signals, strict=True)], signals, self._slowest(k))
                self.sigma[mine] = np.maximum(sigma, log.quantum / np.sqrt(12))
            trial = self.fit(entries, starts=(trial,))
        self.sigma *= np.sqrt(trial.fit.inflation)
        return self.fit(entries, starts=(trial,))

    def fit(self, entries: Sequence[str], starts: Sequence = (),
            still: np.ndarray | None = None) -> ServoModel:
        """
        Fit the terms of some entries; the others have their base values.

        Args:
            entries: names in ``ENTRIES``.
            starts: dictionaries of values, or trials of other entries to start from.
            still: (U, P) terms of units that stay at the base; none by default.

        """
        active = mask(entries)
        still = np.zeros(self.base.shape, dtype=bool) if still is None else still
        s = design(self.spreads, self.labels, active)
        s[still] = 0.0
        s = s[:, :, s.any(axis=(0, 1))]
        fits = []
        for start in starts or STARTS:
            target = self.base.copy()
            if isinstance(start, ServoModel):
                target[:, active] = start.fit.theta[:, active]
            else:
                limits = [log.reached() for log in self._parts]
                start = start | {name: max(one[name] for one in limits) for name in limits[0]}
                for name, value in start.items():
                    p = INDEX[name]
                    if active[p]:
                        target[:, p] = np.log(value) if LOGARITHMIC[p] else value
            x = self._nearest(s, target)
            fits.append(solve(self, self.base, s, x, self.blocks, self.low, HIGH, self.folds))
        best = min(fits, key=lambda fit: fit.chi2 + fit.x @ fit.x)
        return ServoModel(tuple(entries), best, still)

    def visible(self, one: ServoModel, other: ServoModel) -> np.ndarray:
        """
        (U,) whether two fits differ in the readings of a unit by an encoder count (RMS).

        An entry whose effect the other entries take up, as a zero that of a harmonic of the
        encoder at small angles, makes no difference.
        """
        none = np.zeros(len(NAMES), dtype=bool)
        reads = [self(trial.fit.theta, none)[0] for trial in (one, other)]
        return np.array([np.sqrt(np.mean((a - b)**2)) * sigma > self.logs[k].quantum
                         for a, b, sigma, (k, *_) in zip(*reads, self.sigma, self.units,
                                                         strict=True)])

    def changed(self, trial: ServoModel, entry: str) -> np.ndarray:
        """(U,) whether a unit differs from the base by an entry, by a Wald test at 5 %."""
        terms = mask([entry])
        off = (trial.fit.theta - self.base)[:, terms]
        spread = trial.fit.spread()[:, terms][:, :, terms]
        size = np.array([o @ np.linalg.pinv(c, rcond=1e-8, hermitian=True) @ o
                         for o, c in zip(off, spread, strict=True)])
        return size > chi2.isf(0.05 / len(off), terms.sum())

    def determined(self, trial: ServoModel, entry: str) -> bool:
        """Whether the logs halve the variance of every combination of an entry's terms."""
        s, terms = trial.fit.s, mask([entry])
        prior, left = (each[:, terms][:, :, terms]
                       for each in (s @ s.transpose(0, 2, 1), trial.fit.spread()))
        return bool(np.linalg.eigvals(np.linalg.solve(prior, left)).real.max() < 0.5)

    def _slowest(self, k):
        """Number of cosines over the fitted part of a log with a quarter of its motion's rate."""
        command = self.logs[k].command[:, self.rows[k]]
        turns = np.diff(command > command.mean(axis=1, keepdims=True), axis=1).sum(axis=1)
        return int(turns.min()) // 4

    def _nearest(self, s, target):
        """Standardised values x with base + S x near a target, of least norm."""
        if not s.shape[2]:
            return np.zeros(0)
        flat = s.reshape(-1, s.shape[2])
        off = (target - self.base).ravel()
        return np.linalg.solve(flat.T @ flat + 1e-6 * np.trace(flat.T @ flat) / len(flat.T)
                               * np.eye(len(flat.T)), flat.T @ off)

    def candidates(self) -> list[str]:
        """Entries that these logs can show: a limit only if the commands exceed it."""
        beyond = any((log.command_speed() > BEYOND * log.speed()).any() for log in self._parts)
        return [name for name in ENTRIES if beyond or name not in LIMITS]


@dataclass(frozen=True)
class Search:
    """
    Result of the search for the terms that some logs need.

    Attributes:
        servos: the logs with their noise.
        full: fit of all candidates.
        chosen: the selected model.
        trials: entry -> the selected model with it, if it is rejected, or without it.
        gains: entry -> gain of evidence [nat] by it in the selected model.

    """

    servos: Servos
    full: ServoModel
    chosen: ServoModel
    trials: dict[str, ServoModel]
    gains: dict[str, float]

    def values(self, trial: ServoModel | None = None) -> np.ndarray:
        """(U, P) parameter sets of the units."""
        return decoded((trial or self.chosen).fit.theta)


def select(servos: Servos, always: Sequence[str], allowed: Sequence[str], least: float = 0.0,
           named: bool = False) -> Search:
    """
    Add the entries that raise the evidence, largest gain first, and remove those that do not.

    An entry must also improve the prediction of left-out kinds of motion in total. In a model for
    other motions (``named`` is False) the logs must determine each of its terms.

    Args:
        servos: logs and base values.
        always: entries of every model, whose errors are the noise; without, that of all entries.
        allowed: further entries.
        least: least gain of evidence [nat] of an entry.
        named: whether an entry must also change some joint's fit by an encoder count (RMS). An
            entry of each joint stays at the base where it does not change the fit.

    """
    candidates = [name for name in servos.candidates() if name in {*always, *allowed}]
    full = servos.estimate_noise(candidates)
    chosen = servos.estimate_noise(always, (full, *STARTS)) if always else servos.fit((), (full,))

    def worth(more, fewer):
        return (gain(more) >= gain(fewer) + least
                and more.fit.held.sum() > fewer.fit.held.sum()
                and (named or all(servos.determined(more, name) for name in more.entries
                                  if name not in fewer.entries)))

    def gain(trial):
        return trial.fit.evidence

    while better := [trial for trial in (
            servos.fit([*chosen.entries, name], starts=(chosen, full))
            for name in candidates if name not in chosen.entries) if worth(trial, chosen)]:
        chosen = max(better, key=gain)
    while True:
        without = {name: servos.fit([other for other in chosen.entries if other != name],
                                    starts=(chosen, full), still=chosen.still)
                   for name in chosen.entries if name not in always}
        useless = [name for name, fewer in without.items() if not worth(chosen, fewer)
                   or named and not servos.visible(chosen, fewer).any()]
        if useless:
            fewer = without[max(useless, key=lambda name: gain(without[name]))]
            # The terms that stay were chosen beside the dropped entry.
            chosen = servos.fit(fewer.entries, (fewer,)) if fewer.still.any() else fewer
            continue
        # An entry of each joint is dropped where the others take up its effect, and the others are
        # fitted again. One entry at a time, because two entries may take up each other's effect.
        stills = [chosen.still | ~servos.visible(chosen, fewer)[:, None] & mask([name])
                  for name, fewer in without.items() if named and CATALOGUE[name].each == 'joint']
        rests = [servos.fit(chosen.entries, (chosen, full), still) for still in stills
                 if (still != chosen.still).any()]
        if not rests:
            break
        chosen = max(rests, key=gain)
    rejected = [name for name in candidates if name not in chosen.entries]
    trials = without | {name: servos.fit([*chosen.entries, name], (chosen, full), chosen.still)
                        for name in rejected}
    gains = {name: (gain(chosen) - gain(trial)) * (1 if name in chosen.entries else -1)
             for name, trial in trials.items()}
    return Search(servos, full, chosen, trials, gains)


def error_rms(log: JointLog, joint: int, predicted: np.ndarray, part: slice = slice(None)
              ) -> float:
    """RMS [rad] of a prediction (N,) minus the fresh readings of the joint with this index."""
    return rms((predicted - log.measured[joint])[part][log.fresh[part]])


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))
