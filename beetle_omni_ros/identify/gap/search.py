"""Forward addition and backward removal of entries, each step judged on unseen blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from beetle_omni_ros.identify.gap.candidates import (
    Candidate,
    FOUGHT,
    Found,
    IMPOSSIBLE,
    NOT_HELD,
    TOO_SMALL,
)
from beetle_omni_ros.identify.gap.certainty import liveliness
from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.gates import (
    at_bound,
    believed,
    COMMANDS,
    cross_validate,
    enough,
    fought,
    holds,
    neither_holds,
)
from beetle_omni_ros.identify.gap.proposals import Proposals
from beetle_omni_ros.identify.inference.selection import grow, prune


class Search:
    """
    A search over one problem.

    Args:
        problem: flights, beliefs, noise.
        candidates: that may be accepted.
        progress: called with a short text at each stage.

    """

    def __init__(self, problem: Problem, candidates: list[Candidate],
                 progress: Callable[[str], None] = lambda text: None):
        self.problem, self.candidates, self.progress = problem, candidates, progress
        self.p = problem.p
        self.names = [name for name, key in problem.keys.items() if not key.form]
        self.wide = {name: problem.p.wide * problem.keys[name].typical for name in self.names}
        self.always = [name for name in problem.beliefs if name in problem.keys]

    _proposals: Proposals       # of the present step

    def run(self) -> Found:
        """Search; see the module."""
        found, problem, everyone = Found(), self.problem, self.candidates
        self.progress('noise')
        problem.guide({})
        problem.state({}, self.names)
        begun = self._settle({}, [])
        found.base = dict(begun[0].theta)
        found.still = liveliness(problem) < self.p.least_liveliness
        found.accepted, (state, cost) = grow([], begun, partial(self._best, found),
                                             partial(self._joined, found), self.p.most_effects)
        state, cost = self._prune(found, state, cost)
        found.theta, found.state = dict(state.theta), state
        base_state, before = self._refit(State(found.base, problem.residual(found.base),
                                               state.slopes, state.names), [])
        found.base = dict(base_state.theta)
        if found.accepted:
            before = self._believable(base_state, before)
        found.cost = (before, cost, self._floor(state))
        self.progress('rivals')
        self.candidates = everyone
        self._find_rivals(found, state, cost)
        return found

    def _best(self, found, accepted, model):
        """The trial to accept beside the accepted ones, or None."""
        self.progress(f'step {len(accepted) + 1}')
        state, cost = model
        floor, named = self._floor(state), [t.candidate for t in accepted]
        trials = self._step(state, cost, named)
        for trial in trials:
            found.trials[trial.candidate.label] = trial
        best = self._judge(trials, cost, floor, named)
        while best is None and (more := self._proposals.fit_more()):
            best = self._judge(more, cost, floor, named)
            found.trials |= {trial.candidate.label: trial for trial in more}
        return best

    def _joined(self, found, accepted, best):
        if found.still and best.candidate.pushes(self.problem.keys):
            # One explanation of a flight that cannot decide is enough.
            self.candidates = [c for c in self.candidates if not c.pushes(self.problem.keys)]
        accepted = [*accepted, best]
        return accepted, self._settle(best.theta, [t.candidate for t in accepted])

    def _free(self, accepted):
        return frozenset(name for c in accepted for name in c.keys)

    def _involved(self, accepted):
        return list(dict.fromkeys([*self.always, *(n for c in accepted for n in c.keys)]))

    def _refit(self, state, accepted, iterations=3, apart=False):
        return self.problem.refine(state, self._involved(accepted), self._free(accepted),
                                   iterations, apart)

    def _believable(self, state, cost):
        """
        Objective of a fit without effects in which nothing is further off than robots are.

        A tolerance of 3 % takes an effect of 30 % over for a hundred of chi2, whatever the data
        would say of the effect: what the effect explains must not be counted against that.
        """
        problem, held, theta = self.problem, set(), dict(state.theta)
        for _ in range(self.p.takeovers):
            beyond = {n for n in self.always if n not in held
                      and abs(problem.beliefs[n].residual(theta.get(n, 0.0))) > self.p.beyond}
            if not beyond:
                break
            held |= beyond
            for name in beyond:
                theta[name] = problem.beliefs[name].within(theta[name], self.p.beyond)
            start = State(theta, problem.residual(theta), state.slopes, state.names)
            names = [n for n in self.always if n not in held]
            now, cost = problem.refine(start, names, frozenset(), 2)
            theta = dict(now.theta)
        return cost

    def _settle(self, theta, accepted):
        """Noise and fit in turn, and fresh slopes of everything at the point reached."""
        problem = self.problem
        at = dict(theta)
        if theta:
            problem.guide(theta)
            problem.state(theta, self.names)
        state = problem.learn_noise(self.wide)
        for _ in range(self.p.most_turns):
            state, _ = self._refit(state, accepted)
            if not self._far(at, state.theta):
                problem.renew(state.theta)
                break
            at = dict(state.theta)
            problem.guide(at)
            problem.state(at, self.names)
            state = problem.learn_noise(self.wide, 2)
        state = problem.learn_noise(self.wide, 2)
        # To the end: what this fit leaves on the way is a gain of every candidate's.
        return self._refit(state, accepted, self.p.most_iterations, apart=True)

    def _far(self, a, b):
        """Whether slopes taken at one point are of little use at the other."""
        return any(abs(a.get(name, 0.0) - b.get(name, 0.0)) > self.p.far * self.problem.keys[
            name].typical for name in {*a, *b} if self.problem.keys[name].curved)

    def _floor(self, state):
        """Objective of a straight-line fit of everything at once."""
        step = self.problem._solve_all(state, self.wide)
        rest = state.r + state.slopes @ step
        moved = {n: state.theta.get(n, 0.0) + d for n, d in zip(state.names, step, strict=True)}
        return float(rest @ rest) + self.problem.prior(
            moved, frozenset(n for n in moved if n not in self.problem.beliefs))

    def _step(self, state, cost, accepted):
        """Trials of all candidates beside the accepted ones, the best of them fitted."""
        taken, free = {c.label for c in accepted}, self._free(accepted)
        asked = [c for c in self.candidates
                 if c.label not in taken and not any(key in free for key in c.keys)]
        self._proposals = Proposals(self.problem, asked, state, cost, self._involved(accepted),
                                    free)
        self._without = state
        return self._proposals.fit_best()

    def _judge(self, trials, cost, floor, accepted):
        """The first trial that passes every gate; the others get their reason."""
        chosen, p = None, self.p
        names_taken = {(c.name, c.member) for c in accepted}
        for trial in trials:
            c = trial.candidate
            price = p.parameter_price * (len(c.keys) - 1)
            need = p.least_gain + price
            trial.share = trial.gain / max(cost - floor, trial.gain, 1e-9)
            if trial.refined and self._fought(trial, accepted):
                trial.reason = FOUGHT
            elif not enough(p, trial.gain, trial.believed, price):
                trial.reason = 'explains too little'
            elif not trial.refined:
                trial.reason = 'others explain more'
            elif not c.large_enough(self.problem.keys, trial.theta):
                trial.reason = TOO_SMALL
            elif (c.name, c.member) in names_taken:
                trial.reason = 'named already'
            elif self._impossible(trial):
                trial.reason = IMPOSSIBLE
            elif chosen is not None:
                trial.reason = 'others explain more'
            else:
                self._cross_validate(trial, accepted)
                much = p.weak_agreement if trial.gain > p.weak_gain * need else p.strong_agreement
                sure = trial.held.total > much * trial.held.error \
                    and trial.held.positive >= p.sure_blocks
                if not holds(trial, p):
                    trial.reason = NOT_HELD
                elif trial.share < p.least_share and not (
                        sure and trial.share > p.weak_share) \
                        and not believed(p, trial.gain, trial.believed, price):
                    trial.reason = 'explains too small a part of what is left'
                else:
                    chosen = trial
        return chosen

    def _impossible(self, trial):
        commanded = any(name in COMMANDS for name in trial.candidate.keys)
        return at_bound(self.problem.keys, trial, self.problem.models[0].signals.delays(
            trial.theta) if commanded else (), self.p.early_command)

    def _fought(self, trial, accepted):
        return fought(self.problem, trial, self._proposals.points[trial.candidate.label],
                      self._involved(accepted), self._free(accepted))

    def _cross_validate(self, trial, accepted):
        cross_validate(self.problem, trial, self._proposals.points[trial.candidate.label],
                       self._without, self._involved(accepted), self._free(accepted))

    def _prune(self, found, state, cost):
        """Drop what later steps, or the noise learnt after the last one, made superfluous."""
        found.accepted, model = prune(found.accepted, (state, cost), self._worst, self._dropped)
        return model

    def _worst(self, accepted, model):
        return self._beyond(accepted, model[0]) or self._superfluous(accepted, *model)

    def _dropped(self, accepted, model, dropped):
        theta = {n: v for n, v in model[0].theta.items()
                 if n not in dropped.candidate.keys or n in self.problem.beliefs}
        return self._settle(theta, [t.candidate for t in accepted])

    def _beyond(self, accepted, state):
        """Return an accepted entry that the fit of all together made physically impossible."""
        for trial in accepted:
            if self._impossible(replace(trial, theta=state.theta)):
                trial.reason = IMPOSSIBLE
                return trial
        return None

    def _superfluous(self, accepted, state, cost):
        """Return the accepted entry whose loss chance explains, or that is too small by now."""
        losses, of_beliefs = [], []
        everything = [t.candidate for t in accepted]
        for trial in accepted:
            rest = [t.candidate for t in accepted if t is not trial]
            zero = {n: 0.0 for n in trial.candidate.keys if n not in self.problem.beliefs}
            theta = {**state.theta, **zero}
            start = State(theta, self.problem.residual(theta), state.slopes, state.names)
            there, reached = self._refit(start, rest, 2)
            losses.append(reached - cost)
            of_beliefs.append(self.problem.prior(there.theta, self._free(rest))
                              - self.problem.prior(state.theta, self._free(everything)))
        weakest = int(np.argmin(losses))
        trial = accepted[weakest]
        small = not trial.candidate.large_enough(self.problem.keys, state.theta)
        if enough(self.p, losses[weakest], of_beliefs[weakest]) and not small:
            return None
        trial.reason = 'superfluous beside the others'
        return trial

    def _find_rivals(self, found, state, cost):
        """Exchange each accepted entry for others; what does as well makes a set with it."""
        for trial in found.accepted:
            others = [t.candidate for t in found.accepted if t is not trial]
            own = trial.candidate
            zero = dict.fromkeys(own.keys, 0.0)
            theta = {**state.theta, **zero}
            start = State(theta, self.problem.residual(theta), state.slopes, state.names)
            start, without = self._refit(start, others, 2)
            gain = without - cost
            margin = max(self.p.rival_gain, self.p.rival_share * gain)
            near = []
            for other in self._step(start, without, others):
                if other.candidate.name == own.name and other.candidate.member == own.member:
                    continue
                near_enough = other.gain > gain - margin \
                    or neither_holds(found, own.name, other.candidate.name, self.p.rival_gain)
                if not (other.refined and near_enough) \
                        or self._impossible(other) \
                        or not other.candidate.large_enough(self.problem.keys, other.theta):
                    continue
                self._cross_validate(other, others)
                if holds(other, self.p):
                    near.append(other)
            trial.gain = gain
            found.rivals[own.label] = near
