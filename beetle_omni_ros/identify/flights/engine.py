"""The flight engine: weigh sets of catalogue entries, linearise again at the best one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from beetle_omni_ros.identify.flights.evidence import Judge, log_prior, normal, Solution
from beetle_omni_ros.identify.flights.linearised import FORM, GROUPS, Linearised
from beetle_omni_ros.identify.flights.spectrum import EDGES, Spectrum

ROUNDS, MOST_ROUNDS = 3, 6      # linearisations of a given set; of one that is searched at most
STAYS = 0.25            # of its standard deviation: a smaller step of a value changes no interval
NEAR_START = 0.1        # share of a start within which an effect without a slope is nearly linear
MOST = 8                # entries of a set
PAIRED = 20             # entries whose pairs are all weighed; others follow from the best set


class Engine(Linearised):
    """Weighs sets of entries on several flights; arguments are those of its base."""

    certain = False     # whether the scatter of the blocks is taken as known

    def run(self, first: dict[str, float] | None = None) -> Solution:
        """Relinearise, learn the noise and search, several times; ``first``: deviations there."""
        theta = np.zeros(len(self.names))
        for name, value in (first or {}).items():
            theta[self.index[name]] = value
        etas = np.zeros((len(self.flights), len(self.names)))
        spectra: list[Spectrum] = self._whiten(theta, etas)
        self.only_acting = False
        best: tuple[int, ...] | None = None
        turn = 0
        while True:
            turn += 1
            spectra = self._linearised(theta, etas, spectra, spectra if turn == 1 else None)
            solution = self._steady(spectra)
            own = sorted(self.indices(solution.best))
            step = np.abs(solution.theta[own] - theta[own])
            stays = (step <= STAYS * np.sqrt(np.diag(solution.posterior.covariance))).all()
            same, best = solution.best == best, solution.best
            if turn < MOST_ROUNDS and not (same and stays):
                theta, etas = self._next(solution)
                if self.part or not same:
                    continue
            return self._with_plain(self._acting(solution))

    def _acting(self, solution):
        """
        The solution; if it has a start far from where it acts, that of a search at its value.

        What an effect without a slope does far from its start is not known there.
        """
        own = np.array(self.indices(solution.best), dtype=int)
        own = own[self.curved[own]]
        if (np.abs(solution.theta[own] - self.point[own]) <= NEAR_START).all():
            return solution
        self.only_acting = True
        return self._steady(self.again(solution, solution.best).spectra)

    def again(self, solution: Solution, chosen: tuple[int, ...]) -> Solution:
        """The set ``chosen``, linearised at its own values; nothing is searched."""
        judge = solution.judge
        for _ in range(ROUNDS):
            solution = replace(solution, best=chosen, judge=judge, equations=judge.equations,
                               posterior=judge.posterior(self.indices(chosen)))
            theta, etas = self._next(solution)
            solution.spectra = self._linearised(theta, etas, solution.spectra)
            judge = self._weighing(solution.spectra, solution.banned, self.narrow[self.known:])
        return self._with_plain(replace(
            solution, judge=judge, equations=judge.equations,
            posterior=judge.posterior(self.indices(chosen))))

    def likely(self, solution: Solution) -> Solution:
        """
        The best set as if the scatter of the blocks were known.

        Few blocks name nothing, because their scatter is uncertain. That does not exclude that an
        entry explains what they show.
        """
        self.certain = True
        found = self._with_plain(self._search(solution.spectra, solution.banned))
        self.certain = False
        return found

    def _with_plain(self, solution):
        solution.plain = self._weighing(solution.spectra, solution.banned,
                                        1e-9 * self.start[self.known:])
        return solution

    def _next(self, solution):
        """Point of the next linearisation, common and of flights: starts of the best set only."""
        etas = np.array([solution.equations.of_flight(k, solution.theta)[:len(self.names)]
                         for k in range(len(self.flights))])
        etas[:, :self.known][:, self.curved] = 0.0
        theta = np.zeros(len(self.names))
        theta[:self.known] = self.point_of(solution, solution.theta)
        return self._restarted(theta, etas, solution.spectra), etas

    def point_of(self, solution: Solution, theta: np.ndarray) -> np.ndarray:
        """
        Known keys of ``theta`` (K,) at which flights can be computed.

        Starts that are not in the best set have slopes, but must not act.
        """
        point, own = theta[:self.known].copy(), self.indices(solution.best)
        point[self.curved] = 0.0
        point[own] = theta[own]
        return point

    def _steady(self, spectra):
        """
        Search until each named entry has one value in all bands.

        In a closed loop, noise reaches the commands, and an entry explains the feedback instead of
        the robot. Its value then differs between frequencies. The most unsteady entry is
        excluded, and the search begins again without it.
        """
        banned: dict[int, float] = {}
        sought = None
        while True:
            solution = self._search(spectra, banned)
            solution.sought = sought = solution.posterior.gain if sought is None else sought
            self._constancy(solution, banned)
            worst = max(solution.unsteady, key=solution.unsteady.get, default=None)
            if worst is None or solution.unsteady[worst] <= 0:
                solution.banned = banned
                return solution
            banned[worst] = solution.unsteady[worst]

    def indices(self, chosen: Sequence[int]) -> list[int]:
        """Indices of the keys of some entries."""
        return [self.index[key] for k in chosen for key in self.entries[k].keys]

    def _search(self, spectra, banned):
        judge = self._weighing(spectra, banned, self.narrow[self.known:])
        gains: dict[tuple[int, ...], float] = {}
        total = len(self.entries)

        def weight(chosen):
            if chosen not in gains:
                gains[chosen] = judge.gain(self.indices(chosen), ())
            return log_prior(len(chosen), total) + gains[chosen]

        best: tuple[int, ...] = ()
        top = weight(best)
        # of the variants of an entry, the one that explains most alone
        variants: dict[tuple, int] = {}
        for k in (k for k in range(total) if k not in banned):
            entry, first = self.entries[k], self.index[self.entries[k].keys[0]]
            if self.only_acting and self.curved[first] and not self.acting[first]:
                continue
            same = entry.name, entry.member, entry.varying
            if same not in variants or weight((k,)) > weight((variants[same],)):
                variants[same] = k
        allowed = list(variants.values())
        singles: list[tuple[int, ...]] = [(k,) for k in allowed]
        strong = sorted(sorted(allowed, key=lambda k: weight((k,)))[-PAIRED:])
        for chosen in (*singles, *combinations(strong, 2)):
            value = weight(chosen)
            if value > top and self._apart(chosen):
                best, top = chosen, value
        # Pairwise gains need not be transitive: the next set must be better than all before it.
        visited: list[tuple[int, ...]] = []
        while best not in visited:
            visited.append(best)
            near = {tuple(sorted(set(best) - out | more))
                    for out in [set(), *({k} for k in best)]
                    for more in [set(), *({k} for k in allowed if k not in best)]}
            better = sorted(((self.gain(judge, c, best), c) for c in near - {best}
                             if len(c) <= MOST and self._apart(c)), reverse=True)
            best = next((c for gain, c in better if gain > 0 and all(
                self.gain(judge, c, old) > 0 for old in visited)), best)
        weight(best)
        weight(tuple(k for k in best if self.entries[k].varying))
        posterior = judge.posterior(self.indices(best))
        return Solution(self.names, self.entries, gains, best, posterior, judge.equations, judge,
                        judge, spectra)

    def _apart(self, chosen):
        """Whether no effect of a set is one of all joints and also one of a single joint."""
        own = {(self.entries[k].name, self.entries[k].member is None) for k in chosen
               if not self.entries[k].varying}
        return len(own) == len({name for name, _ in own})

    def _weighing(self, spectra, banned, generic):
        """Judge of sets; ``generic`` are the prior deviations of the discrepancy."""
        equations, keys, copies, _ = self._split(spectra, banned, generic)
        wide = np.tile(self.typical[keys], copies)
        return self._judge(equations, form=wide, size=wide)

    def gain(self, judge: Judge, one: tuple[int, ...], other: tuple[int, ...]) -> float:
        """Ln of the probability of one set of entries over that of another."""
        total = len(self.entries)
        return judge.gain(self.indices(one), self.indices(other)) \
            + log_prior(len(one), total) - log_prior(len(other), total)

    def _split(self, spectra, banned, generic, entry=None):
        """
        Normal equations with separate values for the groups of bands, and their judge.

        Excluded entries have a value of typical size in each group always: what feedback makes of
        them must not be explained by others. ``entry`` has a deviation by the error of its form.
        """
        # group of each band
        bands = np.array([0, *np.searchsorted(GROUPS, EDGES[:-1], side='right') - 1])
        copies = int(bands.max()) + 1
        own = np.array(self.indices((entry,)) if entry is not None else [], dtype=int)
        free = np.array([*self.indices(tuple(banned)), *(self.late if banned else ())], dtype=int)
        keys = np.concatenate([own, free])
        equations = normal(spectra, self.names, self.flight, keys, bands, generic)
        return equations, keys, copies, len(own)

    def _constancy(self, solution, banned):
        """
        Gain [nat] of one value for each group of bands over one value, of each named entry.

        One value admits the error of the entry's form in each group of bands.
        """
        named = self.indices(solution.best)
        for k in solution.best:
            if not self.entries[k].in_loop:
                continue
            split, keys, copies, count = self._split(
                solution.spectra, banned, self.narrow[self.known:], k)
            value = np.abs(solution.theta[keys])
            if self.curved[keys[0]]:    # tangents are deviations from the value, the start's
                value[:count] = value[0]
            size = np.maximum(self.typical[keys], value)
            form = np.maximum(self.narrow[keys], FORM * value)
            form[count:] = self.typical[keys[count:]]
            judge = self._judge(split, np.hypot(self.narrow, self.typical * 9), named,
                                np.tile(form, copies), np.tile(size, copies))
            own = self.known + (np.arange(copies)[:, None] * len(keys) + np.arange(count)).ravel()
            solution.unsteady[k] = judge.posterior(own).gain

    def _judge(self, equations, wide=None, named=(), form=(), size=()):
        """Judge of all known keys, and of deviations of bands with priors ``form``, ``size``."""
        more = len(form)
        narrow, bounds = self.narrow[:self.known].copy(), self.bounds.copy()
        for k in named:
            narrow[k] = wide[k]
        bounds[[k for k in named if self.kept[k]], 1] = np.inf      # beyond their tolerances
        flat = np.zeros(more, dtype=bool)
        return Judge(equations, np.concatenate([narrow, form]),
                     np.concatenate([self.typical[:self.known], size]),
                     np.concatenate([bounds, np.tile([-np.inf, np.inf], (more, 1))]),
                     np.concatenate([self.kept, flat]),
                     np.concatenate([self.owner, np.full(more, len(self.entries))]),
                     None if self.certain else self.alpha / len(self.entries),
                     np.concatenate([self.far, flat]),
                     np.concatenate([self.acting, flat]))
