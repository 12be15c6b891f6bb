"""One step's trials: every candidate estimated from slopes, the promising ones fitted."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.gap.candidates import Candidate, LIMITS
from beetle_omni_ros.identify.gap.fit import CURVED, Problem, State
from beetle_omni_ros.identify.gap.forks import forked
from beetle_omni_ros.identify.gap.gauge import handed_over
from beetle_omni_ros.identify.gap.trial import Trial


class Proposals:
    """
    Every candidate tried beside what is fitted, on all cores.

    Args:
        problem: flights, beliefs, noise.
        candidates: to be tried.
        state: the fit so far, with slopes of everything.
        cost: objective there.
        involved: keys that are fitted in any case.
        free: of which nothing is believed.

    Attributes:
        trials: one for each candidate, most gain first.
        points: label -> the point at which the trial was judged.

    """

    def __init__(self, problem: Problem, candidates: list[Candidate], state: State, cost: float,
                 involved: list[str], free: frozenset[str]):
        """Estimate all of them from slopes."""
        self.problem, self.state, self.cost = problem, state, cost
        self.involved, self.free = involved, free
        h, g = state.slopes.T @ state.slopes, state.slopes.T @ state.r
        chi2 = float(state.r @ state.r)

        def estimated(c):
            names, released = self._with(c)
            if c.starts or c.fixed:
                trial, point = _elsewhere(problem, state, cost, c, names, released)
                return trial, point.beside(state)
            index = [state.index[name] for name in names]
            theta = handed_over(state.theta, c)
            step, reached, _ = problem.solve(theta, names, released, h[np.ix_(index, index)],
                                             g[index], chi2)
            trial = Trial(c, cost - reached, problem.moved(theta, names, step))
            return trial, None if theta is state.theta else State(
                theta, problem.residual(theta), state.slopes, state.names).beside(state)

        self.trials: list[Trial] = []
        self.points: dict[str, State] = {}
        for c, (trial, difference) in zip(candidates, forked(estimated, candidates), strict=True):
            self.trials.append(trial)
            self.points[c.label] = state.with_difference(difference) if difference else state
        self.trials.sort(key=lambda t: -t.gain)

    def _with(self, c):
        return list(dict.fromkeys([*self.involved, *c.keys])), self.free | set(c.keys)

    def fit_best(self) -> list[Trial]:
        """Fit the most promising ones; all trials, most gain first."""
        self._fit(_promising(self.problem, self.trials))
        return self.trials

    def fit_more(self) -> list[Trial]:
        """
        Fit the next that gain, whatever stood before them; these, most gain first.

        What leads may be too small to matter, or hold in one block only: then it must not hide
        what explains less and is there.
        """
        p = self.problem.p
        least = p.looked_at * p.least_gain
        chosen = [k for k, trial in enumerate(self.trials)
                  if not trial.refined and trial.gain >= least][:p.refined]
        labels = {self.trials[k].candidate.label for k in chosen}
        self._fit(chosen)
        return [trial for trial in self.trials if trial.candidate.label in labels]

    def _fit(self, chosen):
        problem, state, trials, points = self.problem, self.state, self.trials, self.points

        def refined(k):
            c = trials[k].candidate
            new, reached = problem.refine(points[c.label], *self._with(c), 4)
            return new.beside(state), reached

        for k, (difference, reached) in zip(chosen, forked(refined, chosen), strict=True):
            c = trials[k].candidate
            points[c.label] = state.with_difference(difference)
            theta = dict(points[c.label].theta)
            believed = problem.prior(state.theta, self.free) - problem.prior(
                theta, self._with(c)[1])
            trials[k] = Trial(c, self.cost - reached, theta, True, believed)
        trials.sort(key=lambda t: -t.gain)


def _promising(problem, trials):
    """Indices of the trials, best first, that are worth a fit of their own."""
    best = max(trials[0].gain, 1.0) if trials else 1.0
    chosen, p = [], problem.p
    for k, trial in enumerate(trials):
        curved = any(problem.keys[n].parameter in CURVED for n in trial.candidate.keys)
        if trial.gain < (p.promising_curved if curved else p.promising) * best \
                or trial.gain < p.looked_at * p.least_gain \
                or len(chosen) >= p.refined + 3:
            continue
        if len(chosen) < p.refined or curved:
            chosen.append(k)
    return chosen


def _elsewhere(problem, state, cost, c, names, released):
    """A candidate whose slopes must be taken somewhere else than at zero."""
    best = None
    for start in c.starts or ((0.0,) * len(c.keys),):
        theta = {**state.theta, **c.fixed, **dict(zip(c.keys, start, strict=True))}
        r = problem.residual(theta) if any(start) else state.r
        slopes = state.slopes.copy()
        slopes[:, [state.index[name] for name in c.keys]] = problem.slopes(theta, list(c.keys))
        point = State(theta, r, slopes, state.names)
        step, reached, _ = problem.linear_step(point, names, released)
        # A straight line must not promise what the point itself shows it has not.
        actual = cost - float(r @ r) - problem.prior(theta, released)
        gain = cost - reached
        if c.name in LIMITS:
            gain = min(gain, max(actual, 0.0) + 0.5 * max(gain, 0.0))
        if best is None or gain > best[0].gain:
            best = Trial(c, gain, problem.moved(theta, names, step)), point
    return best
