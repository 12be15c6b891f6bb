"""
Selection of the terms of a servo model by cross-validation.

The fitted part of a log is divided into blocks. A candidate is accepted if the models fitted
without a block predict this block better with the candidate. The sum over the blocks must exceed
its scatter, and the term must have a relevant size.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.inference.blocks import block_masks, HeldOut
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_fit import decode, Problems, ServoFitter
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, OFF, TERMS

LINEAR = ('natural_frequency', 'damping_ratio')   # always in the model
MOST_PASSES = 3
QUICK, THOROUGH = 6, 15  # iterations


@dataclass(frozen=True)
class Candidate:
    """
    A term that may join the model.

    Attributes:
        members: names of its parameters in a parameter set.
        starts: (log, joint index) -> start values of the members.
        needs: candidate that must be in the model before.
        rival: candidate with a similar effect.
        tier: order of the selection.

    """

    members: tuple[str, ...]
    starts: Callable[[JointLog, int], list[tuple[float, ...]]]
    needs: str | None = None
    rival: str | None = None
    tier: int = 0


def _speeds(log, joint):
    return [(0.97 * log.speed()[joint],), (0.8 * log.speed()[joint],)]


def _errors(log, joint):
    largest = np.abs(log.command[joint] - log.measured[joint]).max()
    return [(0.9 * largest,), (0.6 * largest,)]


# Candidates are tried tier by tier. Delay, friction or play, and limits that were reached come
# first, because on slow logs later terms can imitate them: stiction can replace a delay.
CANDIDATES = {
    'delay': Candidate(('delay',), lambda log, joint: [(0.006,), (0.02,)]),
    'coulomb_friction': Candidate(('coulomb_friction',), lambda log, joint: [(0.01,), (0.04,)],
                                  rival='backlash'),
    'backlash': Candidate(('backlash',), lambda log, joint: [(0.01,), (0.03,)],
                          rival='coulomb_friction'),
    'offset': Candidate(('offset',), lambda log, joint: [(
        float(np.mean(log.measured[joint] - log.command[joint])),)]),
    'stiction': Candidate(('stiction', 'stribeck_velocity'),
                          lambda log, joint: [(0.005, 0.1), (0.005, 1.0)], 'coulomb_friction',
                          tier=1),
    'velocity_limit': Candidate(('velocity_limit',), _speeds, rival='torque_limit'),
    'torque_limit': Candidate(('torque_limit',), _errors, rival='velocity_limit'),
    'load': Candidate(('load_sine', 'load_cosine'),
                      lambda log, joint: [(0.005, 0.005), (-0.005, -0.005)], tier=2),
}
TIERS = tuple(tuple(name for name, each in CANDIDATES.items() if each.tier == tier)
              for tier in range(3))


def free_mask(kept: tuple[str, ...]) -> np.ndarray:
    """(n,) parameters that a model with these candidates fits."""
    names = set(LINEAR).union(*(CANDIDATES[name].members for name in kept))
    return np.array([name in names for name in NAMES])


@dataclass(frozen=True)
class Choice:
    """
    Selected model of one joint.

    Attributes:
        kept: accepted candidates.
        values: (n,) parameter set, fitted to the whole fitted part.
        tried: candidate -> parameter set with it in the model, also of accepted ones.
        gain: candidate -> last gain in chi2 on held-out blocks.

    """

    kept: tuple[str, ...]
    values: np.ndarray
    tried: dict[str, np.ndarray]
    gain: dict[str, float]


# (joint, label) -> candidates of the model, and the new one among them; see _cross_validated.
Requests = dict[tuple[int, str | None], tuple[tuple[str, ...], str | None]]


class Selector:
    """Forward selection for all joints together; samples of weight (N,) 0 are not used."""

    def __init__(self, fitter: ServoFitter, weight: np.ndarray,
                 allowed: tuple[str, ...] = tuple(CANDIDATES)):
        self.fitter, self.log, self.allowed = fitter, fitter.log, allowed
        self.blocks = block_masks(weight, shipped().servo.blocks)
        self.all = self.blocks.sum(axis=0)

    def run(self, start: np.ndarray) -> list[Choice]:
        """Select terms, from the linear model on; ``start`` (n,) is the initial parameter set."""
        count = len(self.log.joints)
        self.kept: list[tuple[str, ...]] = [()] * count
        self.values = [np.where(free_mask(()), start, OFF)] * count
        self.tried: list[dict] = [{} for _ in range(count)]
        self.gains: list[dict] = [{} for _ in range(count)]
        for _ in range(MOST_PASSES):
            self._grow(TIERS[0])
            self._share_delay()
            early = list(self.kept)
            for tier in TIERS[1:]:
                self._grow(tier)
            # A late term such as a limit may have hidden an early one.
            if not self._swap() and self.kept == early:
                break
        self._prune()
        return [Choice(*each) for each in zip(self.kept, self.values, self.tried, self.gains,
                                              strict=True)]

    def _grow(self, tier):
        """Add candidates of one tier while one is accepted."""
        growing = list(range(len(self.kept)))
        while growing:
            requests: Requests = {(j, None): (self.kept[j], None) for j in growing}
            requests |= {(j, name): ((*self.kept[j], name), name) for j in growing
                         for name in self._available(tier, j)}
            answers = self._cross_validated(requests)
            for j in list(growing):
                self.values[j], without = answers[j, None]
                best, best_gain = None, 0.0
                for name in self._available(tier, j):
                    found, costs = answers[j, name]
                    gain, real = _gain(without - costs, _weight(name, self.kept[j]))
                    self.tried[j][name], self.gains[j][name] = found, gain
                    if real and gain > best_gain and self._is_relevant(j, name, found):
                        best, best_gain = name, gain
                if best is None:
                    growing.remove(j)
                else:
                    self.kept[j] = (*self.kept[j], best)
                    self.values[j] = self.tried[j][best]

    def _share_delay(self):
        """Add a delay to all joints if one joint has one, because they share the bus."""
        if not any('delay' in names for names in self.kept):
            return
        for j, names in enumerate(self.kept):
            if 'delay' not in names:
                self.kept[j], self.values[j] = (*names, 'delay'), self.tried[j]['delay']

    def _available(self, tier, joint):
        """Candidates of a tier that can still join the model of a joint."""
        kept = self.kept[joint]
        reached = 0.95 * self.log.speed()[joint]
        slow = self.log.command_speed()[joint] < shipped().servo.beyond * reached
        return [name for name in self.allowed if name in tier and name not in kept
                and CANDIDATES[name].needs in (None, *kept)
                and not (name == 'velocity_limit' and slow)]

    def _swap(self):
        """Replace terms by rivals that predict better; return whether any was replaced."""
        requests: Requests = {(j, None): (names, None) for j, names in enumerate(self.kept)}
        for j, names in enumerate(self.kept):
            for name in names:
                rival = CANDIDATES[name].rival
                if rival in self.allowed and rival not in names:
                    requests[j, name] = (tuple(rival if n == name else n for n in names
                                               if CANDIDATES[n].needs != name), rival)
        answers, swapped = self._cross_validated(requests), False
        for (j, label), (_, rival) in requests.items():
            if rival is None:
                continue
            found, costs = answers[j, label]
            gain = float((answers[j, None][1] - costs).sum())
            if gain > shipped().servo.least_gain and self._is_relevant(j, rival, found):
                self.kept[j], self.values[j], swapped = requests[j, label][0], found, True
                self.tried[j][rival] = found
        return swapped

    def _prune(self):
        """Drop superfluous terms, the smallest gain first."""
        open_joints = list(range(len(self.kept)))
        while open_joints:
            requests: Requests = {(j, drop): (tuple(n for n in self.kept[j] if n != drop), None)
                                  for j in open_joints for drop in (None, *self.kept[j])}
            answers = self._cross_validated(requests)
            for j in list(open_joints):
                self.values[j], full = answers[j, None]
                least: dict[str, float] = {}
                for name in self.kept[j]:
                    self.tried[j][name] = self.values[j]
                    if name == 'delay':     # shared with other joints
                        continue
                    self.gains[j][name], real = _gain(answers[j, name][1] - full,
                                                      _weight(name, self.kept[j]))
                    if not real and not any(CANDIDATES[n].needs == name for n in self.kept[j]):
                        least[name] = self.gains[j][name]
                if not least:
                    open_joints.remove(j)
                    continue
                name = min(least, key=lambda one: least[one])
                self.values[j], self.kept[j] = answers[j, name][0], requests[j, name][0]

    def _cross_validated(self, requests: Requests):
        """
        Fit models and predict the held-out blocks.

        Args:
            requests: (joint, label) -> candidates of the model, and the new one among them, which
                needs start values, or None.

        Returns:
            (joint, label) -> fitted set, and (blocks,) chi2 of each held-out block.

        """
        parts, owner = [], []
        for key, (model, new) in requests.items():
            for start in self._starts(key[0], new, self.values[key[0]]):
                start = np.where(free_mask(model), start, OFF)
                parts.append(Problems.single_joints([key[0]], start[None], free_mask(model)[None],
                                                    self.all[None]))
                owner.append(key)
        problems = Problems.join(parts)
        fits = self.fitter.solve(problems, THOROUGH)
        best: dict = {}
        for k, key in enumerate(owner):
            if key not in best or fits.chi2[k] < fits.chi2[best[key]]:
                best[key] = k
        rows = np.repeat([best[key] for key in requests], len(self.blocks))
        held = np.tile(self.blocks, (len(requests), 1))
        folds = Problems(problems.joints[rows], fits.points[rows], problems.free[rows],
                         self.all - held)
        folds = replace(folds, points=self.fitter.solve(folds, QUICK).points, weight=held)
        cost = self.fitter.cost(folds).reshape(len(requests), len(self.blocks))
        return {key: (decode(fits.points[best[key]]), cost[k]) for k, key in enumerate(requests)}

    def _starts(self, joint, name, values):
        """Parameter sets to start from with a new candidate."""
        if name is None:
            return [values]
        found = []
        for start in CANDIDATES[name].starts(self.log, joint):
            changed = values.copy()
            for member, value in zip(CANDIDATES[name].members, start, strict=True):
                term = TERMS[member]
                changed[INDEX[member]] = np.clip(value, term.low, term.high)
            if name == 'delay':     # keep the total lag of servo and delay
                lag = 2 * values[INDEX['damping_ratio']] / values[INDEX['natural_frequency']]
                changed[INDEX['natural_frequency']] *= lag / max(lag - start[0], 0.2 * lag)
            found.append(changed)
        return found

    def _is_relevant(self, joint, name, values):
        """Whether a term exceeds the encoder's step, and a limit is reached."""
        sizes = {member: abs(values[INDEX[member]]) for member in CANDIDATES[name].members}
        if name == 'delay':
            return sizes['delay'] >= shipped().servo.least_delay
        if name == 'velocity_limit':
            return shipped().servo.beyond * sizes[name] <= self.log.command_speed()[joint]
        if name == 'torque_limit':
            sent = self.log.t - values[INDEX['delay']] - self.log.period / 2
            errors = np.abs(self.log.command_at(joint, sent) - self.log.measured[joint])
            return shipped().servo.beyond * sizes[name] <= np.quantile(errors[self.all > 0], 0.99)
        return max(size for member, size in sizes.items()
                   if member != 'stribeck_velocity') >= self.log.quantum


def _weight(name, kept):
    """Factor of the least gain; twice as large if the rival is in the model."""
    return len(CANDIDATES[name].members) * (2 if CANDIDATES[name].rival in kept else 1)


def _gain(gains, weight):
    """Gain over all blocks, and whether it exceeds its scatter in most blocks."""
    held = HeldOut(gains)
    least = max(shipped().servo.least_gain * weight, held.error)
    return held.total, held.total > least and held.positive > 0.5
