"""One step's trials: every candidate estimated from slopes, the promising ones fitted."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.gap.candidates import Candidate, LIMITS
from beetle_omni_ros.identify.gap.fit import CURVED, Problem, State
from beetle_omni_ros.identify.gap.forks import forked
from beetle_omni_ros.identify.gap.gauge import handed_over
from beetle_omni_ros.identify.gap.trial import Trial

REFINED = 5             # candidates of each step that are fitted, not only estimated
PROMISING = 0.25        # of the best linear gain
PROMISING_CURVED = 0.1  # likewise, of those that a straight line cannot judge


def proposed(problem: Problem, candidates: list[Candidate], state: State, cost: float,
             involved: list[str], free: frozenset[str]) -> tuple[list[Trial], dict[str, State]]:
    """
    Try each candidate beside what is fitted, on all cores.

    Args:
        problem: flights, beliefs, noise.
        candidates: to be tried.
        state: the fit so far, with slopes of everything.
        cost: objective there.
        involved: keys that are fitted in any case.
        free: of which nothing is believed.

    Returns:
        trials, most gain first, and by label the point at which each was judged.

    """
    h, g = state.slopes.T @ state.slopes, state.slopes.T @ state.r
    chi2 = float(state.r @ state.r)

    def names_with(c):
        return list(dict.fromkeys([*involved, *c.keys])), free | set(c.keys)

    def estimated(c):
        names, released = names_with(c)
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

    trials, points = [], {}
    for c, (trial, difference) in zip(candidates, forked(estimated, candidates), strict=True):
        trials.append(trial)
        points[c.label] = state.with_difference(difference) if difference else state
    trials.sort(key=lambda t: -t.gain)
    chosen = _promising(problem, trials)

    def refined(k):
        c = trials[k].candidate
        new, reached = problem.refine(points[c.label], *names_with(c), 4)
        return new.beside(state), reached

    for k, (difference, reached) in zip(chosen, forked(refined, chosen), strict=True):
        c = trials[k].candidate
        points[c.label] = state.with_difference(difference)
        theta = dict(points[c.label].theta)
        believed = problem.prior(state.theta, free) - problem.prior(theta, names_with(c)[1])
        trials[k] = Trial(c, cost - reached, theta, True, believed)
    trials.sort(key=lambda t: -t.gain)
    return trials, points


def _promising(problem, trials):
    """Indices of the trials, best first, that are worth a fit of their own."""
    best = max(trials[0].gain, 1.0) if trials else 1.0
    chosen = []
    for k, trial in enumerate(trials):
        curved = any(problem.keys[n].parameter in CURVED for n in trial.candidate.keys)
        if trial.gain < (PROMISING_CURVED if curved else PROMISING) * best \
                or trial.gain < 0.5 * problem.p.least_gain or len(chosen) >= REFINED + 3:
            continue
        if len(chosen) < REFINED or curved:
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
