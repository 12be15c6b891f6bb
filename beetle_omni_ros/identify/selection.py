"""
Which terms a servo model needs: each must improve the prediction of data it was not fitted to.

The fitted part of a log is cut into blocks. A candidate joins the model only if the model fitted
without a block predicts that block better with the candidate than without it, summed over the
blocks and by more than its scatter over them, and if the term is large enough to matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from beetle_omni_ros.identify.inference.blocks import block_masks, HeldOut
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_fit import decode, Problems, ServoFitter
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, OFF, TERMS

LINEAR = ('natural_frequency', 'damping_ratio')   # always there
P = shipped().servo
MOST_PASSES = 3
QUICK, THOROUGH = 6, 15  # iterations


@dataclass(frozen=True)
class Candidate:
    """
    What may join the model.

    Attributes:
        members: names of its numbers in a parameter set.
        starts: (log, joint index) -> values of the members to start from, several.
        needs: a candidate that must be there before.
        rival: the candidate that looks much alike.
        tier: when it is offered.

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


# Offered tier by tier. A delay and friction or play are certain to be there in some size, a limit
# that was met spoils all else, and what comes later imitates them on slow logs: stiction, above
# all, can stand in for a delay. A dead band is a rival of play, a limit of speed of one of torque.
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
    """(n,) which numbers a model with these candidates fits."""
    names = set(LINEAR).union(*(CANDIDATES[name].members for name in kept))
    return np.array([name in names for name in NAMES])


@dataclass(frozen=True)
class Choice:
    """
    The model of one joint.

    Attributes:
        kept: names of candidates in it.
        values: (n,) parameter set, fitted to the whole fitted part.
        tried: candidate -> parameter set with it in the model, those kept too.
        gain: candidate -> chi2 gained on unseen blocks when it was last judged.

    """

    kept: tuple[str, ...]
    values: np.ndarray
    tried: dict[str, np.ndarray]
    gain: dict[str, float]


# (joint, any label) -> candidates in the model, and the one that is new, see _judge.
Asked = dict[tuple[int, str | None], tuple[tuple[str, ...], str | None]]


class Selector:
    """
    Forward selection, all joints side by side.

    Args:
        fitter: log, noise and prior.
        weight: (N,) 0 for samples that are never looked at.
        allowed: names of candidates; default all.

    """

    def __init__(self, fitter: ServoFitter, weight: np.ndarray,
                 allowed: tuple[str, ...] = tuple(CANDIDATES)):
        self.fitter, self.log, self.allowed = fitter, fitter.log, allowed
        self.blocks = block_masks(weight, P.blocks)
        self.all = self.blocks.sum(axis=0)

    def run(self, start: np.ndarray) -> list[Choice]:
        """
        Select from the linear model on.

        Args:
            start: (n,) parameter set to begin with.

        """
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
            # What comes late, a limit say, can have hidden what was offered early.
            if not self._swap() and self.kept == early:
                break
        self._prune()
        return [Choice(*each) for each in zip(self.kept, self.values, self.tried, self.gains,
                                              strict=True)]

    def _grow(self, tier):
        """Add candidates of one tier while any helps."""
        growing = list(range(len(self.kept)))
        while growing:
            asked: Asked = {(j, None): (self.kept[j], None) for j in growing}
            asked |= {(j, name): ((*self.kept[j], name), name) for j in growing
                      for name in self._open(tier, j)}
            answers = self._judge(asked)
            for j in list(growing):
                self.values[j], without = answers[j, None]
                best, best_gain = None, 0.0
                for name in self._open(tier, j):
                    found, costs = answers[j, name]
                    gain, real = _verdict(without - costs, _weight(name, self.kept[j]))
                    self.tried[j][name], self.gains[j][name] = found, gain
                    if real and gain > best_gain and self._matters(j, name, found):
                        best, best_gain = name, gain
                if best is None:
                    growing.remove(j)
                else:
                    self.kept[j] = (*self.kept[j], best)
                    self.values[j] = self.tried[j][best]

    def _share_delay(self):
        """One bus serves all joints: a delay that one of them proves is there for all."""
        if not any('delay' in names for names in self.kept):
            return
        for j, names in enumerate(self.kept):
            if 'delay' not in names:
                self.kept[j], self.values[j] = (*names, 'delay'), self.tried[j]['delay']

    def _open(self, tier, joint):
        """Candidates of a tier that the joint can have and has not."""
        kept = self.kept[joint]
        slow = self.log.asked_speed()[joint] < P.beyond * 0.95 * self.log.speed()[joint]
        return [name for name in self.allowed if name in tier and name not in kept
                and CANDIDATES[name].needs in (None, *kept)
                and not (name == 'velocity_limit' and slow)]

    def _swap(self):
        """Exchange a term for its rival where that predicts better; tell whether any was."""
        asked: Asked = {(j, None): (names, None) for j, names in enumerate(self.kept)}
        for j, names in enumerate(self.kept):
            for name in names:
                rival = CANDIDATES[name].rival
                if rival in self.allowed and rival not in names:
                    asked[j, name] = (tuple(rival if n == name else n for n in names
                                            if CANDIDATES[n].needs != name), rival)
        answers, swapped = self._judge(asked), False
        for (j, label), (_, rival) in asked.items():
            if rival is None:
                continue
            found, costs = answers[j, label]
            gain = float((answers[j, None][1] - costs).sum())
            if gain > P.least_gain and self._matters(j, rival, found):
                self.kept[j], self.values[j], swapped = asked[j, label][0], found, True
                self.tried[j][rival] = found
        return swapped

    def _prune(self):
        """Drop what a later term has made superfluous, the least useful first."""
        open_joints = list(range(len(self.kept)))
        while open_joints:
            asked: Asked = {(j, drop): (tuple(n for n in self.kept[j] if n != drop), None)
                            for j in open_joints for drop in (None, *self.kept[j])}
            answers = self._judge(asked)
            for j in list(open_joints):
                self.values[j], full = answers[j, None]
                least: dict[str, float] = {}
                for name in self.kept[j]:
                    self.tried[j][name] = self.values[j]
                    if name == 'delay':     # shared: the other joints vouch for it
                        continue
                    self.gains[j][name], real = _verdict(answers[j, name][1] - full,
                                                         _weight(name, self.kept[j]))
                    if not real and not any(CANDIDATES[n].needs == name for n in self.kept[j]):
                        least[name] = self.gains[j][name]
                if not least:
                    open_joints.remove(j)
                    continue
                name = min(least, key=lambda one: least[one])
                self.values[j], self.kept[j] = answers[j, name][0], asked[j, name][0]

    def _judge(self, asked: Asked):
        """
        Fit models and predict the blocks left out.

        Args:
            asked: (joint, any label) -> candidates in the model, and the one among them that is
                new and needs start values, or None.

        Returns:
            (joint, label) -> fitted set, and (blocks,) chi2 of each block left out.

        """
        parts, owner = [], []
        for key, (model, new) in asked.items():
            for start in self._starts(key[0], new, self.values[key[0]]):
                start = np.where(free_mask(model), start, OFF)
                parts.append(Problems.apart([key[0]], start[None], free_mask(model)[None],
                                            self.all[None]))
                owner.append(key)
        problems = Problems.join(parts)
        fits = self.fitter.solve(problems, THOROUGH)
        best: dict = {}
        for k, key in enumerate(owner):
            if key not in best or fits.chi2[k] < fits.chi2[best[key]]:
                best[key] = k
        rows = np.repeat([best[key] for key in asked], len(self.blocks))
        held = np.tile(self.blocks, (len(asked), 1))
        folds = Problems(problems.joints[rows], fits.points[rows], problems.free[rows],
                         self.all - held)
        folds = replace(folds, points=self.fitter.solve(folds, QUICK).points, weight=held)
        cost = self.fitter.cost(folds).reshape(len(asked), len(self.blocks))
        return {key: (decode(fits.points[best[key]]), cost[k]) for k, key in enumerate(asked)}

    def _starts(self, joint, name, values):
        """Parameter sets to start from when a candidate is new."""
        if name is None:
            return [values]
        found = []
        for start in CANDIDATES[name].starts(self.log, joint):
            changed = values.copy()
            for member, value in zip(CANDIDATES[name].members, start, strict=True):
                term = TERMS[member]
                changed[INDEX[member]] = np.clip(value, term.low, term.high)
            if name == 'delay':     # what the delay takes over, the servo need not lag
                lag = 2 * values[INDEX['damping_ratio']] / values[INDEX['natural_frequency']]
                changed[INDEX['natural_frequency']] *= lag / max(lag - start[0], 0.2 * lag)
            found.append(changed)
        return found

    def _matters(self, joint, name, values):
        """A term below the encoder's step, or a limit that is never met, is no finding."""
        sizes = {member: abs(values[INDEX[member]]) for member in CANDIDATES[name].members}
        if name == 'delay':
            return sizes['delay'] >= P.least_delay
        if name == 'velocity_limit':
            return P.beyond * sizes[name] <= self.log.asked_speed()[joint]
        if name == 'torque_limit':
            sent = self.log.t - values[INDEX['delay']] - self.log.period / 2
            errors = np.abs(self.log.command_at(joint, sent) - self.log.measured[joint])
            return P.beyond * sizes[name] <= np.quantile(errors[self.all > 0], 0.99)
        return max(size for member, size in sizes.items()
                   if member != 'stribeck_velocity') >= self.log.quantum


def _weight(name, kept):
    """By how much a candidate must beat the least gain; twice where its rival is there too."""
    return len(CANDIDATES[name].members) * (2 if CANDIDATES[name].rival in kept else 1)


def _verdict(gains, weight):
    """Gain over all blocks, and whether it is real: above its scatter, in most blocks."""
    held = HeldOut(gains)
    return held.total, held.total > max(P.least_gain * weight, held.error) and held.positive > 0.5
