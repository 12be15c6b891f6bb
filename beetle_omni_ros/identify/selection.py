"""
Which terms a servo model needs: each must improve the prediction of data it was not fitted to.

The fitted part of a log is cut into blocks. A candidate joins the model only if the model fitted
without a block predicts that block better with the candidate than without it, summed over the
blocks and by more than its scatter over them, and if the term is large enough to matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.fitting import Fitter, Problems
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, NEVER, OFF, TERMS

BLOCKS = 5
LEAST_GAIN = 6.0        # of chi2 on unseen data for each number, all blocks together
LEAST_DELAY = 0.001     # [s]
LINEAR = ('natural_frequency', 'damping_ratio')   # always there
QUICK, THOROUGH = 6, 15  # iterations


@dataclass(frozen=True)
class Candidate:
    """
    What may join the model.

    Attributes:
        members: names of its numbers in a parameter set.
        starts: (log, joint index) -> values of the members to start from, several.
        needs: a candidate that must be there before.

    """

    members: tuple[str, ...]
    starts: Callable[[JointLog, int], list[tuple[float, ...]]]
    needs: str | None = None


def _speeds(log, joint):
    return [(0.97 * log.speed()[joint],), (0.8 * log.speed()[joint],)]


def _errors(log, joint):
    largest = np.abs(log.command[joint] - log.measured[joint]).max()
    return [(0.9 * largest,), (0.6 * largest,)]


CANDIDATES = {
    'delay': Candidate(('delay',), lambda log, joint: [(0.006,), (0.02,)]),
    'coulomb_friction': Candidate(('coulomb_friction',), lambda log, joint: [(0.01,), (0.04,)]),
    'backlash': Candidate(('backlash',), lambda log, joint: [(0.01,), (0.03,)]),
    'offset': Candidate(('offset',), lambda log, joint: [(
        float(np.mean(log.measured[joint] - log.command[joint])),)]),
    'stiction': Candidate(('stiction', 'stribeck_velocity'),
                          lambda log, joint: [(0.005, 0.1), (0.005, 1.0)], 'coulomb_friction'),
    'velocity_limit': Candidate(('velocity_limit',), _speeds),
    'torque_limit': Candidate(('torque_limit',), _errors),
    'load': Candidate(('load_sine', 'load_cosine'),
                      lambda log, joint: [(0.005, 0.005), (-0.005, -0.005)]),
}

# Offered in this order. A delay and friction or play are certain to be there in some size, and
# what comes later imitates them on slow logs: stiction, above all, can stand in for a delay.
TIERS = (('delay', 'coulomb_friction', 'backlash'), ('offset', 'stiction'),
         ('velocity_limit', 'torque_limit', 'load'))


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


def free_mask(kept: tuple[str, ...]) -> np.ndarray:
    """(n,) which numbers a model with these candidates fits."""
    names = set(LINEAR).union(*(CANDIDATES[name].members for name in kept))
    return np.array([name in names for name in NAMES])


def block_masks(count: int, end: int, blocks: int = BLOCKS) -> np.ndarray:
    """(blocks, count) 1 within each of the blocks of the first ``end`` samples."""
    edges = np.linspace(0, end, blocks + 1).astype(int)
    index = np.arange(count)
    return np.array([(index >= a) & (index < b)
                     for a, b in zip(edges[:-1], edges[1:], strict=True)], dtype=float)


class Selector:
    """
    Forward selection, all joints side by side.

    Args:
        fitter: log, noise and prior.
        end: samples from this one on are never looked at.
        allowed: names of candidates; default all.

    """

    def __init__(self, fitter: Fitter, end: int, allowed: tuple[str, ...] = tuple(CANDIDATES)):
        """Cut the blocks; see the class."""
        self.fitter, self.log, self.allowed = fitter, fitter.log, allowed
        self.blocks = block_masks(len(self.log.t), end)
        self.all = self.blocks.sum(axis=0)

    def run(self, start: np.ndarray) -> list[Choice]:
        """
        Select from the linear model on.

        Args:
            start: (n,) parameter set to begin with.

        """
        joints = range(len(self.log.joints))
        kept: dict[int, tuple] = dict.fromkeys(joints, ())
        values = {j: np.where(free_mask(()), start, OFF) for j in joints}
        tried: dict[int, dict] = {j: {} for j in joints}
        gains: dict[int, dict] = {j: {} for j in joints}
        for tier in TIERS:
            self._grow(tier, kept, values, tried, gains)
            if 'delay' in tier:
                self._share_delay(kept)
        self._prune(kept, values, tried, gains)
        return [Choice(kept[j], values[j], tried[j], gains[j]) for j in joints]

    def _grow(self, tier, kept, values, tried, gains):
        """Add candidates of one tier while any helps."""
        open_joints = list(kept)
        while open_joints:
            asked = [(j, name) for j in open_joints
                     for name in (None, *self._open(tier, kept[j]))]
            answers = self._judge(asked, kept, values)
            for j in list(open_joints):
                mine = {name: answers[j, name] for k, name in asked if k == j}
                values[j], without = mine.pop(None)
                best, best_gain = None, 0.0
                for name, (found, costs) in mine.items():
                    gain, accepted = _verdict(without - costs, len(CANDIDATES[name].members))
                    tried[j][name], gains[j][name] = found, gain
                    if accepted and gain > best_gain and self._matters(j, name, found):
                        best, best_gain = name, gain
                if best is None:
                    open_joints.remove(j)
                else:
                    kept[j], values[j] = (*kept[j], best), tried[j][best]

    @staticmethod
    def _share_delay(kept):
        """One bus serves all joints: a delay that half of them show is there for all."""
        if 2 * sum('delay' in names for names in kept.values()) >= len(kept) > 1:
            for j, names in kept.items():
                kept[j] = names if 'delay' in names else (*names, 'delay')

    def _open(self, tier, kept):
        return [name for name in self.allowed if name in tier and name not in kept
                and CANDIDATES[name].needs in (None, *kept)]

    def _prune(self, kept, values, tried, gains):
        """Drop what a later term has made superfluous, e.g. play once there is friction."""
        asked = [(j, drop) for j in kept for drop in (None, *kept[j])]
        reduced = {(j, drop): tuple(n for n in kept[j] if n != drop) for j, drop in asked}
        answers = self._judge(asked, kept, values, reduced)
        for j in kept:
            values[j], full = answers[j, None]
            for name in kept[j]:
                gain, accepted = _verdict(answers[j, name][1] - full,
                                          len(CANDIDATES[name].members))
                tried[j][name] = values[j]
                if name == 'delay':
                    continue
                gains[j][name] = gain
                if not accepted:
                    values[j] = answers[j, name][0]
                    kept[j] = reduced[j, name]
                    break

    def _judge(self, asked, kept, values, models=None):
        """(joint, name) -> fitted set and (blocks,) chi2 of each block left out."""
        parts, owner = [], []
        for key in asked:
            j, name = key
            model = models[key] if models else kept[j] + ((name,) if name else ())
            for start in self._starts(j, None if models else name, values[j]):
                start = np.where(free_mask(model), start, OFF)
                parts.append(Problems(np.array([j]), start[None], free_mask(model)[None],
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
        folds = Problems(problems.joint[rows], fits.sets[rows], problems.free[rows],
                         self.all - held)
        folds = Problems(folds.joint, self.fitter.solve(folds, QUICK).sets, folds.free, held)
        cost = self.fitter.cost(folds).reshape(len(asked), len(self.blocks))
        return {key: (fits.sets[best[key]], cost[k]) for k, key in enumerate(asked)}

    def _starts(self, joint, name, values):
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
            return sizes['delay'] >= LEAST_DELAY
        if name == 'velocity_limit':
            return sizes[name] <= 1.05 * self.log.speed()[joint]
        if name == 'torque_limit':
            return sizes[name] < 0.9 * NEVER
        return max(size for member, size in sizes.items()
                   if member != 'stribeck_velocity') >= self.log.quantum


def _verdict(gains, numbers):
    """Gain over all blocks, and whether it is real: above its scatter, in most blocks."""
    total = float(gains.sum())
    error = float(gains.std(ddof=1) * np.sqrt(len(gains)))
    real = total > max(LEAST_GAIN * numbers, error) and (gains > 0).sum() * 2 > len(gains)
    return total, bool(real)
