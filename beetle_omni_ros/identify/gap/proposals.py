"""Trials of one step of the search: linear estimates of all candidates, fits of the best."""

import numpy as np

from beetle_omni_ros.identify.gap.candidates import Candidate, Trial
from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.keys import delays_of, LIMITS, THRUST_BUS, TILT_BUS
from beetle_omni_ros.robot.effects import CATALOGUE

SENSORS = delays_of('imu', 'mocap', 'encoders')


class Proposals:
    """
    Trials of all candidates beside the present fit, in several processes.

    Attributes:
        trials: one for each candidate, largest gain first.
        points: label -> state of the trial.

    """

    def __init__(self, problem: Problem, candidates: list[Candidate], state: State, cost: float,
                 involved: list[str], free: frozenset[str]):
        self.problem, self.state, self.cost = problem, state, cost
        self.involved, self.free = involved, free
        normal = (state.slopes.T @ state.slopes, state.slopes.T @ state.r,
                  float(state.r @ state.r))
        result = problem.parallel(_estimated, candidates, state, cost, involved, free, normal)
        self.trials: list[Trial] = []
        self.points: dict[str, State] = {}
        for c, (trial, difference) in zip(candidates, result, strict=True):
            self.trials.append(trial)
            self.points[c.label] = state.with_difference(difference) if difference else state
        self.trials.sort(key=lambda t: -t.gain)

    def fit_best(self) -> list[Trial]:
        """Fit the most promising candidates; return all trials, largest gain first."""
        self._fit(_promising(self.problem, self.trials))
        return self.trials

    def fit_more(self) -> list[Trial]:
        """
        Fit the next candidates with sufficient linear gain; return these trials.

        Stronger candidates may have been rejected; they must not hide a weaker valid one.
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
        starts = [(trials[k].candidate, points[trials[k].candidate.label].difference_to(state))
                  for k in chosen]
        result = problem.parallel(_refined, starts, state, self.involved, self.free)
        for k, (difference, reached) in zip(chosen, result, strict=True):
            c = trials[k].candidate
            points[c.label] = state.with_difference(difference)
            theta = dict(points[c.label].theta)
            prior_gain = problem.prior_cost(state.theta, self.free) - problem.prior_cost(
                theta, _with(c, self.involved, self.free)[1])
            trials[k] = Trial(c, self.cost - reached, theta, True, prior_gain)
        trials.sort(key=lambda t: -t.gain)


def _with(c, involved, free):
    """Keys of a fit with a candidate, and keys whose priors are ignored."""
    return list(dict.fromkeys([*involved, *c.keys])), free | set(c.keys)


def _estimated(problem, c, state, cost, involved, free, normal):
    """Linear estimate of a candidate's trial, and the difference of its state to ``state``."""
    names, released = _with(c, involved, free)
    if c.starts or c.fixed:
        trial, point = _elsewhere(problem, state, cost, c, names, released)
        return trial, point.difference_to(state)
    (h, g, chi2), index = normal, [state.index[name] for name in names]
    theta = delays_handed_over(state.theta, c)
    step, reached = problem.solve(theta, names, released, h[np.ix_(index, index)], g[index],
                                  chi2)
    trial = Trial(c, cost - reached, problem.moved(theta, names, step))
    return trial, None if theta is state.theta else State(
        theta, problem.residual(theta), state.slopes, state.names).difference_to(state)


def _refined(problem, starts, state, involved, free):
    """Fitted state of a candidate as difference to ``state``, and its objective."""
    c, difference = starts
    new, reached = problem.refine(state.with_difference(difference), *_with(c, involved, free), 4)
    return new.difference_to(state), reached


def _promising(problem, trials):
    """Indices of the trials, largest gain first, that are worth a fit."""
    best = max(trials[0].gain, 1.0) if trials else 1.0
    p = problem.p
    chosen: list[int] = []
    for k, trial in enumerate(trials):
        curved = any(problem.keys[n].curved for n in trial.candidate.keys)
        if trial.gain < (p.promising_curved if curved else p.promising) * best \
                or trial.gain < p.looked_at * p.least_gain \
                or len(chosen) >= p.refined + 3:
            continue
        if len(chosen) < p.refined or curved:
            chosen.append(k)
    return chosen


def _elsewhere(problem, state, cost, c, names, released):
    """Trial of a candidate that must be linearised at its own starts."""
    best = None
    for start in c.starts or ((0.0,) * len(c.keys),):
        theta = {**state.theta, **c.fixed, **dict(zip(c.keys, start, strict=True))}
        r = problem.residual(theta) if any(start) else state.r
        slopes = state.slopes.copy()
        slopes[:, [state.index[name] for name in c.keys]] = problem.slopes(theta, list(c.keys))
        point = State(theta, r, slopes, state.names)
        step, reached = problem.linear_step(point, names, released)
        # A linear estimate of a limit is bounded by the actual gain at the start.
        actual = cost - float(r @ r) - problem.prior_cost(theta, released)
        gain = cost - reached
        if c.name in LIMITS:
            gain = min(gain, max(actual, 0.0) + 0.5 * max(gain, 0.0))
        if best is None or gain > best[0].gain:
            best = Trial(c, gain, problem.moved(theta, names, step)), point
    return best


def delays_handed_over(theta, candidate):
    """
    Deviations with delays moved from the tolerances of the bus to the candidate's own delay.

    The data do not separate the two. A fit that starts with half of the delay in the bus would
    stay there, because the prior allows it.
    """
    key, late = f'{candidate.name}.delay', CATALOGUE[candidate.name].delays
    if not {'tilt', 'thrust'} & set(late) or theta.get(key):
        return theta
    # Only differences count: all sensors late by dt equals all commands early by dt.
    common = float(np.mean([theta.get(name, 0.0) for name in SENSORS]))
    result = {**theta, **{name: theta.get(name, 0.0) - common for name in SENSORS}}
    tilt, thrust = (theta.get(name, 0.0) + common for name in (TILT_BUS, THRUST_BUS))
    if len(late) == 2:
        own = (tilt + thrust) / 2
        tilt, thrust = tilt - own, thrust - own
    elif late == ('tilt',):
        own, tilt = tilt - thrust, thrust
    else:
        own, thrust = thrust - tilt, tilt
    return {**result, key: own, TILT_BUS: tilt, THRUST_BUS: thrust}
