"""Forward selection and backward elimination of candidates with cross-validation."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from beetle_omni_ros.identify.gap.candidates import (
    Candidate,
    CLOSED_LOOP_BIAS,
    Found,
    IMPOSSIBLE,
    NOT_CONFIRMED,
    TOO_SMALL,
)
from beetle_omni_ros.identify.gap.certainty import excitation
from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.gates import (
    at_bound,
    closed_loop_bias,
    COMMANDS,
    confirmed,
    cross_validate,
    same_response,
    significant,
    significant_in_prior,
)
from beetle_omni_ros.identify.gap.proposals import Proposals


class Search:
    """
    Search for the catalogue entries that explain the residual of one problem.

    ``progress`` gets a short text at each stage.
    """

    def __init__(self, problem: Problem, candidates: list[Candidate],
                 progress: Callable[[str], None] = lambda text: None):
        self.problem, self.candidates, self.progress = problem, candidates, progress
        self.p = problem.p
        self.names = [name for name, key in problem.keys.items() if not key.form]
        self.wide = {name: problem.p.wide * problem.keys[name].typical for name in self.names}
        self.always = [name for name in problem.priors if name in problem.keys]

    _proposals: Proposals       # of the current step
    _baseline: State            # fit without any of them

    def run(self) -> Found:
        """Run the search."""
        found, problem, all_candidates = Found(), self.problem, self.candidates
        self.progress('noise')
        problem.smooth_tilts({})
        problem.state({}, self.names)
        start = self._fit_with_noise({}, [])
        found.base = dict(start[0].theta)
        found.low_excitation = excitation(problem) < self.p.least_liveliness
        state, cost = self._grow(found, *start)
        state, cost = self._prune(found, state, cost)
        found.theta, found.state = dict(state.theta), state
        base_state, before = self._refit(State(found.base, problem.residual(found.base),
                                               state.slopes, state.names), [])
        found.base = dict(base_state.theta)
        if found.accepted:
            before = self._plausible_cost(base_state, before)
        found.cost = (before, cost, self._cost_of_all(state))
        self.progress('rivals')
        self.candidates = all_candidates
        self._find_rivals(found, state, cost)
        return found

    def _grow(self, found, state, cost):
        """Add the best trial while one is acceptable; return the fit with all of them."""
        while (best := self._best_candidate(found, state, cost)) is not None \
                and len(found.accepted) < self.p.most_effects:
            if found.low_excitation and best.candidate.acts_on_body_only(self.problem.keys):
                # With low excitation, a second body force would be closed-loop bias.
                self.candidates = [c for c in self.candidates
                                   if not c.acts_on_body_only(self.problem.keys)]
            found.accepted.append(best)
            state, cost = self._fit_with_noise(best.theta, [t.candidate for t in found.accepted])
        return state, cost

    def _best_candidate(self, found, state, cost):
        """The trial to accept beside the accepted ones, or None."""
        self.progress(f'step {len(found.accepted) + 1}')
        floor, named = self._cost_of_all(state), [t.candidate for t in found.accepted]
        trials = self._propose(state, cost, named)
        for trial in trials:
            found.trials[trial.candidate.label] = trial
        best = self._select(trials, cost, floor, named)
        while best is None and (more := self._proposals.fit_more()):
            best = self._select(more, cost, floor, named)
            found.trials |= {trial.candidate.label: trial for trial in more}
        return best

    def _free(self, accepted):
        return frozenset(name for c in accepted for name in c.keys)

    def _involved(self, accepted):
        return list(dict.fromkeys([*self.always, *(n for c in accepted for n in c.keys)]))

    def _refit(self, state, accepted, iterations=3, split=False):
        return self.problem.refine(state, self._involved(accepted), self._free(accepted),
                                   iterations, split)

    def _plausible_cost(self, state, cost):
        """
        Objective of a fit without effects and with all tolerances in a plausible range.

        Otherwise a tolerance of 3 % may absorb an effect of 30 % at a price of a hundred of chi2.
        The effect would then explain too little.
        """
        problem, held, theta = self.problem, set(), dict(state.theta)
        for _ in range(self.p.takeovers):
            beyond = {n for n in self.always if n not in held
                      and abs(problem.priors[n].residual(theta.get(n, 0.0))) > self.p.beyond}
            if not beyond:
                break
            held |= beyond
            for name in beyond:
                theta[name] = problem.priors[name].within(theta[name], self.p.beyond)
            start = State(theta, problem.residual(theta), state.slopes, state.names)
            names = [n for n in self.always if n not in held]
            now, cost = problem.refine(start, names, frozenset(), 2)
            theta = dict(now.theta)
        return cost

    def _fit_with_noise(self, theta, accepted):
        """Alternate noise and fit, with new slopes of all keys at the point reached."""
        problem = self.problem
        at = dict(theta)
        if theta:
            problem.smooth_tilts(theta)
            problem.state(theta, self.names)
        state = problem.learn_noise(self.wide)
        for _ in range(self.p.most_turns):
            state, _ = self._refit(state, accepted)
            if not self._left_linear_range(at, state.theta):
                problem.update_residual(state.theta)
                break
            at = dict(state.theta)
            problem.smooth_tilts(at)
            problem.state(at, self.names)
            state = problem.learn_noise(self.wide, 2)
        state = problem.learn_noise(self.wide, 2)
        # Converge fully: any remaining decrease would be credited to every candidate.
        return self._refit(state, accepted, self.p.most_iterations, split=True)

    def _left_linear_range(self, a, b):
        """Whether slopes taken at one point are invalid at the other."""
        return any(abs(a.get(name, 0.0) - b.get(name, 0.0)) > self.p.far * self.problem.keys[
            name].typical for name in {*a, *b} if self.problem.keys[name].curved)

    def _cost_of_all(self, state):
        """Objective of a linear fit of all keys."""
        step = self.problem.linear_fit_of_all(state, self.wide)
        rest = state.r + state.slopes @ step
        moved = {n: state.theta.get(n, 0.0) + d for n, d in zip(state.names, step, strict=True)}
        return float(rest @ rest) + self.problem.prior_cost(
            moved, frozenset(n for n in moved if n not in self.problem.priors))

    def _propose(self, state, cost, accepted):
        """Trials of all candidates beside the accepted ones; the best are fitted."""
        taken, free = {c.label for c in accepted}, self._free(accepted)
        candidates = [c for c in self.candidates
                      if c.label not in taken and not any(key in free for key in c.keys)]
        self._proposals = Proposals(self.problem, candidates, state, cost,
                                    self._involved(accepted), free)
        self._baseline = state
        return self._proposals.fit_best()

    def _select(self, trials, cost, floor, accepted):
        """The first trial that passes all gates; sets the reasons of the others."""
        chosen, p = None, self.p
        names_taken = {(c.name, c.member) for c in accepted}
        for trial in trials:
            c = trial.candidate
            price = p.parameter_price * (len(c.keys) - 1)
            need = p.least_gain + price
            trial.share = trial.gain / max(cost - floor, trial.gain, 1e-9)
            if trial.refined and self._closed_loop_bias(trial, accepted):
                trial.reason = CLOSED_LOOP_BIAS
            elif not significant(p, trial.gain, trial.prior_gain, price):
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
                if not confirmed(trial, p):
                    trial.reason = NOT_CONFIRMED
                elif trial.share < p.least_share and not (
                        sure and trial.share > p.weak_share) \
                        and not significant_in_prior(p, trial.gain, trial.prior_gain, price):
                    trial.reason = 'explains too small a share of the unexplained chi2'
                else:
                    chosen = trial
        return chosen

    def _impossible(self, trial):
        commanded = any(name in COMMANDS for name in trial.candidate.keys)
        return at_bound(self.problem.keys, trial, self.problem.models[0].signals.delays(
            trial.theta) if commanded else (), self.p.early_command)

    def _closed_loop_bias(self, trial, accepted):
        return closed_loop_bias(self.problem, trial,
                                self._proposals.points[trial.candidate.label],
                                self._involved(accepted), self._free(accepted))

    def _cross_validate(self, trial, accepted):
        cross_validate(self.problem, trial, self._proposals.points[trial.candidate.label],
                       self._baseline, self._involved(accepted), self._free(accepted))

    def _prune(self, found, state, cost):
        """Drop entries that later steps or the noise after the last step made superfluous."""
        while found.accepted:
            dropped = self._first_impossible(found.accepted, state) \
                or self._first_superfluous(found.accepted, state, cost)
            if dropped is None:
                break
            found.accepted = [trial for trial in found.accepted if trial is not dropped]
            theta = {n: v for n, v in state.theta.items()
                     if n not in dropped.candidate.keys or n in self.problem.priors}
            state, cost = self._fit_with_noise(theta, [t.candidate for t in found.accepted])
        return state, cost

    def _first_impossible(self, accepted, state):
        """An accepted entry that is physically impossible in the joint fit, or None."""
        for trial in accepted:
            if self._impossible(replace(trial, theta=state.theta)):
                trial.reason = IMPOSSIBLE
                return trial
        return None

    def _first_superfluous(self, accepted, state, cost):
        """The weakest accepted entry, if its loss is insignificant or it is too small, or None."""
        losses, prior_gain = [], []
        everything = [t.candidate for t in accepted]
        for trial in accepted:
            rest = [t.candidate for t in accepted if t is not trial]
            zero = {n: 0.0 for n in trial.candidate.keys if n not in self.problem.priors}
            theta = {**state.theta, **zero}
            start = State(theta, self.problem.residual(theta), state.slopes, state.names)
            there, reached = self._refit(start, rest, 2)
            losses.append(reached - cost)
            prior_gain.append(self.problem.prior_cost(there.theta, self._free(rest))
                              - self.problem.prior_cost(state.theta, self._free(everything)))
        weakest = int(np.argmin(losses))
        trial = accepted[weakest]
        small = not trial.candidate.large_enough(self.problem.keys, state.theta)
        if significant(self.p, losses[weakest], prior_gain[weakest]) and not small:
            return None
        trial.reason = 'superfluous beside the others'
        return trial

    def _find_rivals(self, found, state, cost):
        """Replace each accepted entry by others; those that explain as much form a set with it."""
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
            for other in self._propose(start, without, others):
                if other.candidate.name == own.name and other.candidate.member == own.member:
                    continue
                near_enough = other.gain > gain - margin \
                    or same_response(found, own.name, other.candidate.name, self.p.rival_gain)
                if not (other.refined and near_enough) \
                        or self._impossible(other) \
                        or not other.candidate.large_enough(self.problem.keys, other.theta):
                    continue
                self._cross_validate(other, others)
                if confirmed(other, self.p):
                    near.append(other)
            trial.gain = gain
            found.rivals[own.label] = near
