"""Fits of several flights together, by Gauss and Newton with beliefs beside the data."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from beetle_omni_ros.identify.gap.keys import Key, LIMITS
from beetle_omni_ros.identify.gap.noise import Noise
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.gap.residual import FlightModel
from beetle_omni_ros.identify.gap.workers import Workers
from beetle_omni_ros.identify.inference.least_squares import solved
from beetle_omni_ros.identify.inference.prior import Prior, together

HALVINGS = 4
# Deviations, residual, columns that changed and their slopes: what a state is beside another.
Difference = tuple[dict[str, float], np.ndarray, np.ndarray, np.ndarray]


@dataclass
class State:
    """
    Everything at one point.

    Attributes:
        theta: deviations by key name.
        r: (n,) whitened residual of all flights.
        slopes: (n, K) whitened, for ``names``.
        names: of the columns.

    """

    theta: dict[str, float]
    r: np.ndarray
    slopes: np.ndarray
    names: list[str]
    index: dict[str, int] = field(default_factory=dict)

    def __post_init__(self):
        self.index = {name: k for k, name in enumerate(self.names)}

    def beside(self, other: State) -> Difference:
        """What of this state differs from another one with the same names."""
        changed = np.flatnonzero((self.slopes != other.slopes).any(axis=0)) \
            if self.slopes is not other.slopes else np.zeros(0, dtype=int)
        return self.theta, self.r, changed, self.slopes[:, changed]

    def with_difference(self, difference: Difference) -> State:
        """The state of which :meth:`beside` this one told the difference."""
        theta, r, changed, columns = difference
        slopes = self.slopes
        if len(changed):
            slopes = slopes.copy()
            slopes[:, changed] = columns
        return State(theta, r, slopes, self.names)


class Problem:
    """
    The flights, what is believed, and the noise.

    Args:
        models: one for each flight.
        keys: by name.
        beliefs: of keys that always are free.
        p: parameters.
        others: flights that judge, whose work is shared as well.

    Attributes:
        noise: in force; change it by :meth:`learn_noise`.
        workers: processes that share the work, or None.
        block: (n,) number of the block that a whitened sample belongs to.
        where: (n,) index of group and channel of a sample.

    """

    workers: Workers | None = None

    def __init__(self, models: list[FlightModel], keys: dict[str, Key],
                 beliefs: dict[str, Prior], p: GapParameters,
                 others: list[FlightModel] | tuple = ()):
        self.models, self.keys, self.beliefs, self.p = models, keys, beliefs, p
        self.everyone = [*models, *others]
        self._guides: list[tuple[dict[str, float], list[int]]] = []
        self.noise = Noise.white(p)
        self._raw: list[tuple] = []     # of each flight, as the last state found them
        self._label()

    def _label(self):
        blocks, where, flights, times, first = [], [], [], [], 0
        for k, model in enumerate(self.models):
            pieces = max(round(model.flight.duration / self.p.block),
                         -(-self.p.least_blocks // len(self.models)))
            counts = {g: len(model.times(g)) for g in self.noise.taps}
            for c, (group, _, index) in enumerate(self.noise.places(counts)):
                t = model.times(group)[index]
                part = np.clip((t / model.flight.duration * pieces).astype(int), 0, pieces - 1)
                blocks.append(first + part)
                where.append(np.full(len(t), c))
                flights.append(np.full(len(t), k))
                times.append(t)
            first += pieces
        self.block, self.where = np.concatenate(blocks), np.concatenate(where)
        self.flight, self.time, self.blocks = np.concatenate(flights), np.concatenate(times), first

    def use(self, noise: Noise) -> None:
        """Take a noise that was learnt elsewhere."""
        self.noise = noise
        self._label()

    def residual(self, theta: dict[str, float]) -> np.ndarray:
        """(n,) whitened."""
        return np.concatenate(self.share(_residual, range(len(self.models)), theta))

    def slopes(self, theta: dict[str, float], names: list[str]) -> np.ndarray:
        """(n, len(names)) whitened."""
        return np.concatenate(self.share(_slopes, range(len(self.models)), theta, names))

    def state(self, theta: dict[str, float], names: list[str]) -> State:
        """Residual and slopes at a point."""
        self._raw = [(*raw, names, theta)
                     for raw in self.share(_raw, range(len(self.models)), theta, names)]
        return self._whitened()

    def guide(self, theta: dict[str, float], models: list[FlightModel] | None = None) -> None:
        """Let noisy encoders' tilts follow the servos at this point; see FlightModel."""
        self._follow([*self._guides, (theta, [self.everyone.index(model) for model in (
            self.models if models is None else models)])])

    def _follow(self, guides):
        """Do the last of these, those that were not done here; each builds on the one before."""
        for theta, some in guides[len(self._guides):]:
            for k in some:
                self.everyone[k].guide(theta)
        self._guides = guides

    def share(self, function: Callable, items: Iterable, *common: Any) -> list:
        """
        ``[function(self, item, *common) for item in items]``, in several processes.

        Args:
            function: of a module. It sees this noise and these guides, and must not change them.
            items: which can be sent to another process.
            common: likewise.

        """
        if self.workers is None:
            return [function(self, item, *common) for item in items]
        return self.workers.map(_shared, items, self.noise, self._guides, function, common)

    def renew(self, theta: dict[str, float]) -> None:
        """Take the residual at a point nearby; slopes stay those of the last :meth:`state`."""
        rest = self.share(_raw, range(len(self.models)), theta, [])
        self._raw = [(r, old[1], old[2], theta)
                     for (r, _), old in zip(rest, self._raw, strict=True)]

    def _whitened(self):
        r = np.concatenate([self.noise.whiten(raw) for raw, *_ in self._raw])
        s = np.concatenate([self.noise.whiten(slopes) for _, slopes, *_ in self._raw])
        return State(dict(self._raw[0][3]), r, s, list(self._raw[0][2]))

    def learn_noise(self, wide: dict[str, float], rounds: int = 3) -> State:
        """
        Estimate the noise around a fit of everything, linear from the last state.

        Args:
            wide: key -> deviation within which numbers without a belief are sought.
            rounds: of noise and fit.

        Returns:
            the last state, whitened anew.

        """
        names = self._raw[0][2]
        state = self._whitened()
        for _ in range(rounds):
            step = self._solve_all(state, wide)
            rest = []
            for raw, slopes, *_ in self._raw:
                rest.append({g: raw[g] + slopes[g] @ step for g in raw})
            self.noise = Noise.of(rest, self.p)
            self._label()
            state = self._whitened()
        assert len(names) == state.slopes.shape[1]
        return state

    def noises(self, theta: dict[str, float], wide: dict[str, float]) -> list[Noise]:
        """
        Noise of each flight alone, around a fit of everything to it.

        Gusts differ from flight to flight; what any known number could explain is none of them.

        Args:
            theta: point at which slopes are taken of flights that were not fitted.
            wide: as of :meth:`learn_noise`.

        Returns:
            the noise of each flight that was fitted, then of the others.

        """
        raw = [*self._raw, *[None] * (len(self.everyone) - len(self.models))]
        return self.share(_noise_of, enumerate(raw), self._raw[0][2], theta, wide)

    def _solve_all(self, state, wide):
        h, g = state.slopes.T @ state.slopes, state.slopes.T @ state.r
        slope, off = together(self.beliefs, state.theta, state.names)
        sought = [0.0 if name in self.beliefs else wide.get(name, 1.0)**-2
                  for name in state.names]
        return -np.linalg.solve(h + np.diag(slope**2 + sought), g + slope * off)

    def prior(self, theta: dict[str, float], free: frozenset[str] = frozenset()) -> float:
        """Cost of straying from what is believed, of keys that are not ``free``."""
        return sum(belief.residual(theta.get(name, 0.0))**2
                   for name, belief in self.beliefs.items() if name not in free)

    def linear_step(self, state: State, names: list[str], free: frozenset[str],
                    rows: np.ndarray | None = None) -> tuple[np.ndarray, float, np.ndarray]:
        """
        The best change of the named keys if slopes were constant.

        Args:
            state: point, residual and slopes.
            names: keys that may change.
            free: of which nothing is believed.
            rows: samples that count; default all.

        Returns:
            (K,) change, the objective expected after it, (K, K) normal matrix.

        """
        columns = [state.index[name] for name in names]
        s = state.slopes[:, columns]
        r = state.r
        if rows is not None:
            s, r = s[rows], r[rows]
        h, g = s.T @ s, s.T @ r
        return self.solve(state.theta, names, free, h, g, float(r @ r))

    def solve(self, theta, names, free, h, g, chi2):
        """Finish :meth:`linear_step` from the data's normal equations."""
        slope, off = together(self.beliefs, theta, names, free)
        h, g = h + np.diag(slope**2), g + slope * off
        step = -solved(h, g)
        cost = chi2 + self.prior(theta, free) + 2 * g @ step + step @ h @ step
        return step, float(cost), h

    def refine(self, state: State, names: list[str], free: frozenset[str],
               iterations: int = 3, apart: bool = False) -> tuple[State, float]:
        """
        Fit the named keys.

        Slopes of keys that act almost linearly are kept; those of curved ones are renewed.

        Args:
            state: where to begin, with residual and slopes.
            names: keys that may change.
            free: of which nothing is believed.
            iterations: at most.
            apart: whether, where no part of a step of all is better, keys whose slopes are smooth
                go on without those of friction, play and limits.

        Returns:
            the point reached, and the objective there.

        """
        theta, r = dict(state.theta), state.r
        slopes, cost = state.slopes, float(r @ r) + self.prior(theta, free)
        timing = any(self.keys[name].parameter == 'delay' for name in free)
        curved = [name for name in names if self.keys[name].curved and (
            name not in self.beliefs or name in free
            or timing and self.keys[name].parameter == 'delay')]
        smooth = [name for name in names if not (
            name in free and self.keys[name].effect in LIMITS)]
        now = State(theta, r, slopes, state.names)
        for iteration in range(iterations):
            found = self._descended(now, names, free, cost)
            if found is None and apart and len(smooth) < len(names):
                found = self._descended(now, smooth, free, cost)
            if found is None:
                break
            trial, r, new = found
            gain, cost = cost - new, new
            slopes = now.slopes
            if curved and iteration + 1 < iterations and gain > 0.5:
                slopes = slopes.copy()
                slopes[:, [now.index[name] for name in curved]] = self.slopes(trial, curved)
            now = State(trial, r, slopes, now.names)
            if gain < 0.5:
                break
        return now, cost

    def _descended(self, now, names, free, cost):
        """Keys, residual and objective after the longest tried part of a step that is better."""
        step, _, _ = self.linear_step(now, names, free)
        for halving in range(HALVINGS):
            trial = self.moved(now.theta, names, 0.5**halving * step)
            r = self.residual(trial)
            new = float(r @ r) + self.prior(trial, free)
            if new < cost - 1e-9:
                return trial, r, new
        return None

    def moved(self, theta: dict[str, float], names: list[str],
              step: np.ndarray) -> dict[str, float]:
        """``theta`` with the named keys changed by ``step`` (K,), within what is physical."""
        moved = dict(theta)
        for name, change in zip(names, step, strict=True):
            key = self.keys[name]
            moved[name] = float(np.clip(theta.get(name, 0.0) + change, key.low, key.high))
        return moved


def _shared(problem, item, noise, guides, function, common):
    """Do one piece of work at the noise and the guides that the first process has by now."""
    problem.noise = noise
    problem._follow(guides)
    return function(problem, item, *common)


def _residual(problem, k, theta):
    return problem.noise.whiten(problem.models[k].residual(theta))


def _slopes(problem, k, theta, names):
    return problem.noise.whiten(problem.models[k].slopes(theta, names))


def _raw(problem, k, theta, names):
    model = problem.models[k]
    return model.residual(theta), model.slopes(theta, names) if names else None


def _noise_of(problem, item, names, theta, wide):
    k, raw = item
    alone = Problem([problem.everyone[k]], problem.keys, problem.beliefs, problem.p)
    if raw is None:
        alone.state(theta, names)
    else:
        alone._raw = [raw]
    alone.learn_noise(wide)
    return alone.noise
