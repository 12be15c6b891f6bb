"""
Selection of the catalogue entries that explain a response log of the servos.

Entries are added one by one to the servos of the robot file, the largest gain for its parameters
first. The fitted model has the parameters of a robot file, so the corrected file is the fitted
model, and the same log shows no gap with it. An entry is accepted if its gain is significant, if
held-out blocks of the log confirm it, and if it exceeds the differences between servos of one
type.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi_square

from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.inference.blocks import block_masks, HeldOut
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.joint_servos import GROUPS, Servos
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_fit import (
    first_noise,
    fitted_samples,
    noise_around,
    Problems,
    ServoFitter,
)
from beetle_omni_ros.identify.servo_model import simulate
from beetle_omni_ros.robot.effects import CATALOGUE
from beetle_omni_ros.robot.parameters import RobotParameters

QUICK = 5               # iterations that estimate a gain; accepted entries are fitted again
MOST_PASSES = 3
# The members are separable if both are known better than their smallest relevant change; else
# they are one set.
LATENCY = 'joint_command_latency'
PAIR = (LATENCY, CATALOGUE[LATENCY].log_rival)


@dataclass(frozen=True)
class Entry:
    """
    A catalogue entry as a candidate.

    Attributes:
        name: catalogue name.
        joint: index in the log of the only joint that it changes, or None for all.

    """

    name: str
    joint: int | None = None


@dataclass
class Trial:
    """
    Gain of an entry.

    Attributes:
        entry: the entry.
        gain: decrease of chi2 beside the other accepted entries, over the residuals' scatter.
        numbers: number of its parameters.
        samples: number of fitted samples.
        needed: required gain: significance and price of the parameters (BIC).
        held: gains on held-out blocks of the log.
        point: the fitted model with the entry.
        reason: reason of the rejection, or ''.

    """

    entry: Entry
    gain: float
    numbers: int
    samples: int
    needed: float
    held: HeldOut
    point: np.ndarray
    reason: str = ''

    @property
    def significant(self) -> bool:
        """Whether chance would hardly gain as much."""
        return self.gain > self.needed

    @property
    def confirmed(self) -> bool:
        """Whether held-out blocks gain, most of them and all together."""
        return self.held.total > 0 and self.held.positive > 0.5


@dataclass
class Found:
    """
    Result of a search.

    Attributes:
        p: parameters (params/gap.yaml).
        servos: layout of the points.
        file_point: (P,) servos of the robot file.
        point: (P,) corrected servos.
        accepted: trials of the accepted entries, largest gain first.
        sets: accepted entry -> trials that explain as much in its place, itself included.
        rejected: trials of all other entries beside the accepted ones.
        widths: (P,) half widths of 95 % intervals, 0 if not fitted.
        errors: 'file', 'corrected', 'free' -> (J,) RMS on the held-out part [rad]; free: with
            gains, delay, friction and zeros fitted, whether significant or not.
        tolerated: (J,) RMS that manufacturing tolerances cause on that part [rad].
        undetectable: names of entries that the log would not show at a typical size.

    """

    p: GapParameters
    servos: Servos
    file_point: np.ndarray
    point: np.ndarray
    accepted: list[Trial]
    sets: dict[Entry, list[Trial]]
    rejected: list[Trial]
    widths: np.ndarray
    errors: dict[str, np.ndarray]
    tolerated: np.ndarray
    undetectable: list[str]


class Search:
    """Forward selection from the servos of the file; only the first part of the log is fitted."""

    def __init__(self, log: JointLog, robot: RobotParameters, p: GapParameters | None = None):
        self.p = p or GapParameters.load()
        self.whole, self.log = log, log.first(shipped().servo.fitted)
        self.servos = Servos(robot, log.joints)
        self.weight = fitted_samples(self.log)
        self.blocks = block_masks(self.weight, shipped().servo.blocks)
        self.samples = int(self.weight.sum()) * len(log.joints)
        self.entries = self._entries()
        self._estimate_noise()

    def _entries(self):
        result = [Entry(name, j) for name in ('joint_offset', 'joint_friction')
                for j in range(len(self.log.joints))]
        result += [Entry(name) for name in GROUPS if name != 'joint_offset']
        # A speed limit shows only if the command asks for that speed.
        slow = (self.log.command_speed() < shipped().servo.beyond * 0.95 * self.log.speed()).all()
        return [e for e in result if not (e.name == 'joint_velocity_limit' and slow)]

    def _estimate_noise(self):
        """Noise around the best servos that a robot file can describe, from two starts."""
        usual = [e for e in self.entries if e.name == 'joint_offset' or (
            e.name in ('joint_friction', 'joint_velocity_limit', *PAIR) and e.joint is None)]
        starts = [self._start_point(self.servos.file_point, usual, k) for k in range(2)]
        noise = first_noise(self.log)
        for _ in range(2):
            self.fitter = self._fitter(noise)
            solved = self._solve(starts, [usual] * len(starts), 12)
            self.full = solved.points[solved.chi2.argmin()]
            starts, noise = [self.full], self._noise(self.full)
        self.noise = noise
        self.fitter = self._fitter(self.noise)
        self.scatter = self.fitter.covariances(self._problems([self.full], [usual]))[0][1]

    def _fitter(self, noise):
        return ServoFitter(self.log, noise, self.servos)

    def _noise(self, point):
        return noise_around(self.log, self.servos.sets(point[None])[0], self.weight)

    def _problems(self, points, models, weights=None):
        """Fits of points (M, P) with the entries of each model free."""
        count = len(points)
        return Problems(np.tile(np.arange(len(self.log.joints)), (count, 1)), np.array(points),
                        np.array([self._free(entries) for entries in models]),
                        np.tile(self.weight, (count, 1)) if weights is None else weights)

    def _free(self, entries):
        return np.any([self.servos.mask(e.name, e.joint) for e in entries], axis=0) \
            if entries else np.zeros(len(self.servos.numbers), dtype=bool)

    def _solve(self, points, models, iterations=8, weights=None):
        return self.fitter.solve(self._problems(points, models, weights), iterations)

    def _starts(self, entry):
        """Number of starts; a stiffness is tried with and without friction's torque."""
        return 1 if entry.name in ('joint_offset', 'joint_friction') else 2

    def _start_point(self, point, entries, k):
        """A point at which the entries have a slope and do not contradict the log."""
        point = point.copy()
        for entry in entries:
            if entry.name == 'joint_friction':
                mask = self.servos.mask(entry.name, entry.joint)
                point[mask] = np.maximum(point[mask], 2.0)
            elif entry.name == LATENCY:
                at = self.servos.index('delay')
                point[at] = max(point[at] + (4.0, -2.0)[k], 0.5)
            elif entry.name == 'joint_bandwidth':
                point[self.servos.index('dead_band_held')] = float(k)
                if len(entries) > 1:    # initial fit: as in the file, or as soft as slow servos
                    point[self.servos.index('kp')] += (0.0, -8.0)[k]
                    point[self.servos.index('kd')] += (0.0, -8.0)[k]
            elif entry.name == 'joint_backlash':
                at = self.servos.index('gap')
                point[at] = max(point[at], (3.0, 10.0)[k])
            elif entry.name == 'joint_velocity_limit':
                self._set(point, 'velocity_limit', (0.97, 0.8)[k] * self.log.speed().max())
            elif entry.name == 'joint_torque_limit':
                largest = np.abs(self.log.command - self.log.measured).max()
                kp = self.servos.values(point)[self.servos.index('kp')]
                self._set(point, 'effort_limit', (0.9, 0.6)[k] * kp * largest)
        return point

    def _set(self, point, name, value):
        at = self.servos.index(name)
        point[at] = np.log(value) / self.servos.scale[at]

    def run(self) -> Found:
        """Select entries, drop superfluous ones, find alternatives."""
        kept: list[Entry] = []
        point = self.servos.file_point.copy()
        for _ in range(MOST_PASSES):
            accepted, point = self._grow(kept, point)
            kept, point = self._prune(accepted, point)
            noise = self._noise(point)
            if (noise.sigma > shipped().servo.nearly * self.noise.sigma).all():
                break
            self.noise, self.full = noise, point
            self.fitter = self._fitter(noise)
        return self._found(kept, point, self._others if kept == accepted
                           else self._trials_with(kept, point))

    def _grow(self, accepted, point):
        """Add the best entry while one is acceptable."""
        while (best := self._best_entry(accepted, point)) is not None \
                and len(accepted) < self.p.log_effects:
            free, point = self._free([best.entry]), best.point
            outside = [e for e in accepted if (self._free([e]) & ~free).any()]
            accepted = [*outside, best.entry]
        return accepted, point

    def _prune(self, accepted, point):
        """Drop the weakest entry while one is superfluous."""
        while accepted and (weakest := self._weakest_entry(accepted, point)) is not None:
            accepted = [entry for entry in accepted if entry is not weakest]
            point = self._refitted(accepted, point)
        return accepted, point

    def _best_entry(self, accepted, point):
        self._others = self._trials_with(accepted, point)
        # The largest excess over the required gain, so that few parameters have an advantage.
        return max((t for t in self._others if t.significant and self._is_relevant(t)),
                   key=lambda t: t.gain - t.needed, default=None)

    def _trials_with(self, accepted, point):
        """A trial of each other entry beside the accepted ones."""
        free = self._free(accepted)
        tried = [(e, k) for e in self.entries if (self._free([e]) & ~free).any()
                 for k in range(self._starts(e))]
        points = [point, *(self._start_point(point, [e], k) for e, k in tried)]
        models = [accepted, *([*accepted, e] for e, _ in tried)]
        solved = self._solve(points, models, QUICK)
        no_gain = HeldOut(np.zeros(shipped().servo.blocks))
        best: dict = {}
        for (entry, _), p, chi2 in zip(tried, solved.points[1:], solved.chi2[1:], strict=True):
            gain = (solved.chi2[0] - chi2) / self.scatter
            if entry not in best or gain > best[entry].gain:
                best[entry] = self._trial(entry, gain, no_gain, p)
        return list(best.values())

    def _count(self, entry):
        return int(self._free([entry]).sum())

    def _is_relevant(self, trial):
        """Whether an entry exceeds the differences between servos of one type."""
        return self.is_large(trial.entry, self.servos.file_point, trial.point)

    def is_large(self, entry: Entry, before: np.ndarray, after: np.ndarray) -> bool:
        """Whether the entry's change between two points exceeds its smallest relevant size."""
        old, new = self.servos.values(before), self.servos.values(after)
        if entry.name == 'joint_friction':
            force = [self.servos.friction(p) for p in (before, after)]
            bands = [f / self.servos.values(p)[self.servos.index('kp')]
                     for f, p in zip(force, (before, after), strict=True)]
            return bool(np.any((np.abs(force[1] - force[0]) > self.p.log_friction * force[0])
                               & (np.abs(bands[1] - bands[0]) > self.p.log_dead_band)))
        if entry.name == 'joint_torque_limit':
            errors = np.abs(self.log.command - self.log.measured)
            limit = new[self.servos.index('effort_limit')] / new[self.servos.index('kp')]
            if shipped().servo.beyond * limit > np.quantile(errors[:, self.weight > 0], 0.99):
                return False
        mask = self.servos.mask(entry.name, entry.joint)
        for k in np.flatnonzero(mask):
            number = self.servos.numbers[k]
            least = self.p.log_offset if number.name == 'offset' else \
                CATALOGUE[entry.name].parameters[number.name].smallest
            change = abs(np.log(new[k] / old[k])) if number.logarithmic else abs(new[k] - old[k])
            if change > least:
                return True
        return False

    def _weakest_entry(self, accepted, point):
        """The weakest superfluous or unconfirmed entry, or None."""
        weak = [t for t in self._trials_without(accepted, point)
                if not (t.significant and t.confirmed and self._is_relevant(t))]
        return min(weak, key=lambda t: t.gain).entry if weak else None

    def _refitted(self, accepted, point):
        """The model with these entries only, all else as in the file."""
        start = self._restricted(accepted, point)
        return self._solve([start], [accepted]).points[0] if accepted else start

    def _restricted(self, accepted, point):
        free = self._free(accepted)
        free[self.servos.index('dead_band_held')] = Entry('joint_bandwidth') in accepted
        return np.where(free, point, self.servos.file_point)

    def _trials_without(self, accepted, point, each=None):
        """Trials of accepted entries (``each``): loss without it, fitted and held out."""
        each = accepted if each is None else each
        models = [accepted, *([o for o in accepted if o != e] for e in each)]
        points = [point, *(self._restricted(m, point) for m in models[1:])]
        solved = self._solve(points, models)
        held_out = self._held_out_costs(solved.points, models)
        return [self._trial(e, (chi2 - solved.chi2[0]) / self.scatter,
                            HeldOut((cost - held_out[0]) / self.scatter), solved.points[0])
                for e, chi2, cost in zip(each, solved.chi2[1:], held_out[1:], strict=True)]

    def _held_out_costs(self, points, models):
        """(M, blocks) chi2 of each block, predicted by models fitted without it."""
        every = self.blocks.sum(axis=0)
        rows = np.repeat(np.arange(len(models)), shipped().servo.blocks)
        left = np.tile(self.blocks, (len(models), 1))
        fitted = self._solve(points[rows], [models[r] for r in rows], 4, every - left).points
        cost = self.fitter.cost(self._problems(fitted, [models[r] for r in rows], left))
        return cost.reshape(len(models), shipped().servo.blocks)

    def _found(self, accepted, point, others):
        trials = self._trials_without(accepted, point) if accepted else []
        if trials:
            point = trials[0].point
        widths = self._widths(accepted, point)
        sets = self._sets(accepted, point, trials, widths)
        members = {t.entry for group in sets.values() for t in group}
        rejected = [t for t in others if t.entry not in members]
        for trial in rejected:
            trial.reason = self._reason(trial)
        strongest = sorted(trials, key=lambda t: -t.gain)
        return Found(self.p, self.servos, self.servos.file_point, point, strongest, sets, rejected,
                     widths, self._errors(point), self._tolerated(), self._undetectable(point))

    def _undetectable(self, point):
        """Entries whose typical size would change the log by less than the required gain."""
        servos, kp = self.servos, self.servos.values(point)[self.servos.index('kp')]
        points = [point]
        for name in GROUPS:
            moved = point.copy()
            for k in np.flatnonzero(servos.mask(name)):
                number = servos.numbers[k]
                size = CATALOGUE[name].parameters[number.name].typical
                if number.logarithmic:      # softer, or a lower limit
                    size = np.log(1 - size)
                elif number.name == 'coulomb':
                    size /= kp
                moved[k] += size / servos.scale[k]
            points.append(np.clip(moved, servos.coordinates.low, servos.coordinates.high))
        problems = self._problems(points, [[]] * len(points))
        r = self.fitter.residuals(problems.points, problems.joints, problems.weight)
        changes = ((r[1:] - r[0])**2).sum(axis=1) / self.scatter
        return [name for name, change in zip(GROUPS, changes, strict=True)
                if change < self._needed(Entry(name))]

    def _trial(self, entry, gain, held, point):
        return Trial(entry, float(gain), self._count(entry), self.samples, self._needed(entry),
                     held, point)

    def _needed(self, entry):
        numbers = self._count(entry)
        return max(chi_square.isf(self.p.log_chance, numbers), numbers * np.log(self.samples))

    def _reason(self, trial):
        if not trial.significant:
            return 'gain is not significant'
        if not self._is_relevant(trial):
            return 'smaller than the differences between servos of one type'
        return 'held-out blocks do not confirm it'

    def _widths(self, accepted, point):
        free = self._free(accepted)
        if not free.any():
            return np.zeros(len(free))
        own, _ = self.fitter.covariances(self._problems([point], [accepted]))[0]
        return 1.96 * np.sqrt(self.scatter * np.diag(own))

    def _sets(self, accepted, point, trials, widths):
        """Accepted entry -> alternatives; a pair that is not separable is one set."""
        sets: dict[Entry, list[Trial]] = {t.entry: [t] for t in trials}
        pair = [Entry(name) for name in PAIR]
        if all(e in accepted for e in pair) and not self._separable(widths):
            alone = self._gains_alone(accepted, point, pair)
            first, second = sorted(alone, key=lambda t: -t.gain)
            # A member that explains nothing alone is no alternative; both are needed.
            if second.significant:
                sets[first.entry] = [first, second]
                del sets[second.entry]
            return sets
        for entry in accepted:
            rival = Entry(CATALOGUE[entry.name].log_rival)
            if rival in self.entries and rival not in accepted:
                own, other = self._gains_alone(accepted, point, [entry, rival])
                near = own.gain - other.gain < chi_square.isf(self.p.log_chance, 1)
                if near and other.significant and other.confirmed and self._is_relevant(other):
                    sets[entry] = [own, other]
        return sets

    def _separable(self, widths):
        """Whether delay, stiffness and damping are known better than their relevant changes."""
        least = {name: CATALOGUE[group].parameters[name].smallest
                 for group in PAIR for name in GROUPS[group]}
        return all(widths[self.servos.index(name)] * self.servos.scale[self.servos.index(name)]
                   < size for name, size in least.items())

    def _gains_alone(self, accepted, point, members):
        """Gain of each member beside the other entries, without the other members."""
        others = [e for e in accepted if e not in members]
        found = []
        for member in members:
            starts = [self._restricted([*others, member], point) if member in accepted and not k
                      else self._start_point(self._restricted(others, point), [member], k)
                      for k in range(self._starts(member))]
            best = min((self._solve([start], [[*others, member]]) for start in starts),
                       key=lambda solved: solved.chi2[0])
            found.append(self._trials_without([*others, member], best.points[0], [member])[0])
        return found

    def _errors(self, point):
        """(J,) RMS on the held-out part with the servos of the file, corrected, most flexible."""
        return {name: held_out_rms(self.whole, self.servos, p) for name, p in (
            ('file', self.servos.file_point), ('corrected', point), ('free', self.full))}

    def _tolerated(self):
        """(J,) RMS on the held-out part of all changes just too small to be named."""
        changes = {'kp': 0.05, 'kd': 0.05, 'delay': 0.001}
        total = np.zeros(len(self.log.joints))
        for name, size in changes.items():
            point, at = self.servos.file_point.copy(), self.servos.index(name)
            point[at] += size / self.servos.scale[at]
            total += self._moved(point)**2
        point = self.servos.file_point.copy()
        for j in range(len(self.log.joints)):
            point[self.servos.index('coulomb', j)] *= 1 + self.p.log_friction
            point[self.servos.index('offset', j)] += 0.5
        return np.sqrt(total + self._moved(point)**2)

    def _moved(self, point):
        joints = np.arange(len(self.log.joints))
        a, b = (simulate(self.whole, joints, self.servos.sets(p[None])[0])
                for p in (point, self.servos.file_point))
        return np.sqrt(np.mean((a - b)[:, self.whole.end_of(shipped().servo.fitted):]**2, axis=1))


def held_out_rms(log: JointLog, servos: Servos, point: np.ndarray) -> np.ndarray:
    """(J,) RMS of simulation minus log over the held-out part [rad]."""
    sets = servos.sets(point[None])[0]
    error = simulate(log, np.arange(len(sets)), sets) - log.measured
    return np.sqrt(np.mean(error[:, log.end_of(shipped().servo.fitted):]**2, axis=1))

