"""Gauss-Newton fits of several flights with Gaussian priors and coloured noise."""

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

HALVINGS = 4    # of a step, in the line search
# Deviations, residual, indices of changed columns, and those columns.
Difference = tuple[dict[str, float], np.ndarray, np.ndarray, np.ndarray]


@dataclass
class State:
    """
    Point of a fit with its residual and slopes.

    Attributes:
        theta: deviations by key name.
        r: (n,) whitened residual of all flights.
        slopes: (n, K) whitened derivatives, for ``names``.
        names: keys of the columns.

    """

    theta: dict[str, float]
    r: np.ndarray
    slopes: np.ndarray
    names: list[str]
    index: dict[str, int] = field(default_factory=dict)

    def __post_init__(self):
        self.index = {name: k for k, name in enumerate(self.names)}

    def difference_to(self, other: State) -> Difference:
        """Difference to a state with the same names; cheap to send to another process."""
        changed = np.flatnonzero((self.slopes != other.slopes).any(axis=0)) \
            if self.slopes is not other.slopes else np.zeros(0, dtype=int)
        return self.theta, self.r, changed, self.slopes[:, changed]

    def with_difference(self, difference: Difference) -> State:
        """The state that has this ``difference`` to this one; inverse of :meth:`difference_to`."""
        theta, r, changed, columns = difference
        slopes = self.slopes
        if len(changed):
            slopes = slopes.copy()
            slopes[:, changed] = columns
        return State(theta, r, slopes, self.names)


class Problem:
    """
    The flights of a fit, the priors and the noise.

    Args:
        models: one for each fitted flight.
        keys: all keys by name.
        priors: priors of the keys that every fit includes.
        p: parameters (params/gap.yaml).
        held_out: flights that are not fitted; :meth:`parallel` also works on them.

    Attributes:
        noise: noise in force; :meth:`learn_noise` changes it.
        workers: processes for :meth:`parallel`, or None.
        block: (n,) index of the cross-validation block of each whitened sample.
        where: (n,) index of group and channel of a sample.
        flight: (n,) index of its flight.
        time: (n,) its time in the flight [s].

    """

    workers: Workers | None = None

    def __init__(self, models: list[FlightModel], keys: dict[str, Key],
                 priors: dict[str, Prior], p: GapParameters,
                 held_out: list[FlightModel] | tuple = ()):
        self.models, self.keys, self.priors, self.p = models, keys, priors, p
        self.all_models = [*models, *held_out]
        self._smoothing: list[tuple[dict[str, float], list[int]]] = []
        self.noise = Noise.white(p)
        self._raw: list[tuple] = []     # of each flight: residual, slopes, names, theta
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
        """Set the noise."""
        self.noise = noise
        self._label()

    def residual(self, theta: dict[str, float]) -> np.ndarray:
        """(n,) whitened residual."""
        return np.concatenate(self.parallel(_residual, range(len(self.models)), theta))

    def slopes(self, theta: dict[str, float], names: list[str]) -> np.ndarray:
        """(n, len(names)) whitened derivatives of the residual."""
        return np.concatenate(self.parallel(_slopes, range(len(self.models)), theta, names))

    def state(self, theta: dict[str, float], names: list[str]) -> State:
        """Residual and slopes at a point."""
        self._raw = [(*raw, names, theta)
                     for raw in self.parallel(_raw, range(len(self.models)), theta, names)]
        return self._whitened()

    def smooth_tilts(self, theta: dict[str, float],
                     models: list[FlightModel] | None = None) -> None:
        """Take the fast part of noisy tilts from the servo model at ``theta``; see FlightModel."""
        some = self.models if models is None else models
        self._apply_smoothing([
            *self._smoothing, (theta, [self.all_models.index(model) for model in some])])

    def _apply_smoothing(self, smoothing):
        """Apply the entries that this process has not applied yet, in order."""
        for theta, some in smoothing[len(self._smoothing):]:
            for k in some:
                self.all_models[k].smooth_tilts(theta)
        self._smoothing = smoothing

    def parallel(self, function: Callable, items: Iterable, *common: Any) -> list:
        """
        ``[function(self, item, *common) for item in items]``, in several processes.

        Args:
            function: module-level function. It must not change the noise or the smoothing.
            items: picklable arguments, one for each call.
            common: further picklable arguments.

        """
        if self.workers is None:
            return [function(self, item, *common) for item in items]
        return self.workers.map(_run_item, items, self.noise, self._smoothing, function, common)

    def update_residual(self, theta: dict[str, float]) -> None:
        """Replace the residual by that at a nearby point; keep the slopes of :meth:`state`."""
        rest = self.parallel(_raw, range(len(self.models)), theta, [])
        self._raw = [(r, old[1], old[2], theta)
                     for (r, _), old in zip(rest, self._raw, strict=True)]

    def _whitened(self):
        r = np.concatenate([self.noise.whiten(raw) for raw, *_ in self._raw])
        s = np.concatenate([self.noise.whiten(slopes) for _, slopes, *_ in self._raw])
        return State(dict(self._raw[0][3]), r, s, list(self._raw[0][2]))

    def learn_noise(self, wide: dict[str, float], rounds: int = 3) -> State:
        """
        Estimate the noise around a fit of all keys, linear from the last state.

        Noise and fit alternate. Keys without prior get the standard deviations ``wide`` by name.
        Returns the last state, whitened with the new noise.
        """
        names = self._raw[0][2]
        state = self._whitened()
        for _ in range(rounds):
            step = self.linear_fit_of_all(state, wide)
            rest = []
            for raw, slopes, *_ in self._raw:
                rest.append({g: raw[g] + slopes[g] @ step for g in raw})
            self.noise = Noise.of(rest, self.p)
            self._label()
            state = self._whitened()
        assert len(names) == state.slopes.shape[1]
        return state

    def noise_of_each(self, theta: dict[str, float], wide: dict[str, float]) -> list[Noise]:
        """
        Noise of each flight, around a fit of all keys to this flight alone.

        Gusts differ between flights. The fit removes what any known effect explains. ``theta`` is
        the point of linearisation for held-out flights. Fitted flights come first in the result.
        """
        raw = [*self._raw, *[None] * (len(self.all_models) - len(self.models))]
        return self.parallel(_noise_of, enumerate(raw), self._raw[0][2], theta, wide)

    def linear_fit_of_all(self, state: State, wide: dict[str, float]) -> np.ndarray:
        """(K,) step of a linear fit of all keys; ``wide``: see :meth:`learn_noise`."""
        h, g = state.slopes.T @ state.slopes, state.slopes.T @ state.r
        slope, off = together(self.priors, state.theta, state.names)
        sought = [0.0 if name in self.priors else wide.get(name, 1.0)**-2
                  for name in state.names]
        return -np.linalg.solve(h + np.diag(slope**2 + sought), g + slope * off)

    def prior_cost(self, theta: dict[str, float], free: frozenset[str] = frozenset()) -> float:
        """Chi2 of the priors, without those of the keys in ``free``."""
        return sum(prior.residual(theta.get(name, 0.0))**2
                   for name, prior in self.priors.items() if name not in free)

    def linear_step(self, state: State, names: list[str],
                    free: frozenset[str]) -> tuple[np.ndarray, float]:
        """Gauss-Newton step (K,) of the named keys, and expected objective after it."""
        s, r = state.slopes[:, [state.index[name] for name in names]], state.r
        return self.solve(state.theta, names, free, s.T @ s, s.T @ r, float(r @ r))

    def solve(self, theta, names, free, h, g, chi2):
        """Complete :meth:`linear_step` from the normal equations of the data."""
        slope, off = together(self.priors, theta, names, free)
        h, g = h + np.diag(slope**2), g + slope * off
        step = -solved(h, g)
        cost = chi2 + self.prior_cost(theta, free) + 2 * g @ step + step @ h @ step
        return step, float(cost)

    def refine(self, state: State, names: list[str], free: frozenset[str],
               iterations: int = 3, split: bool = False) -> tuple[State, float]:
        """
        Fit the named keys in a few ``iterations``; return the fitted state and its objective.

        Only slopes of curved keys are renewed after a step. With ``split``, a failed step of all
        keys is retried without keys of friction, play and limits, whose slopes are not smooth.
        """
        theta, r = dict(state.theta), state.r
        slopes, cost = state.slopes, float(r @ r) + self.prior_cost(theta, free)
        timing = any(self.keys[name].parameter == 'delay' for name in free)
        curved = [name for name in names if self.keys[name].curved and (
            name not in self.priors or name in free
            or timing and self.keys[name].parameter == 'delay')]
        smooth = [name for name in names if not (
            name in free and self.keys[name].effect in LIMITS)]
        now = State(theta, r, slopes, state.names)
        for iteration in range(iterations):
            found = self._line_search(now, names, free, cost)
            if found is None and split and len(smooth) < len(names):
                found = self._line_search(now, smooth, free, cost)
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

    def _line_search(self, now, names, free, cost):
        """Keys, residual and objective of the first halved step that decreases the objective."""
        step, _ = self.linear_step(now, names, free)
        for halving in range(HALVINGS):
            trial = self.moved(now.theta, names, 0.5**halving * step)
            r = self.residual(trial)
            new = float(r @ r) + self.prior_cost(trial, free)
            if new < cost - 1e-9:
                return trial, r, new
        return None

    def moved(self, theta: dict[str, float], names: list[str],
              step: np.ndarray) -> dict[str, float]:
        """``theta`` with the named keys changed by ``step`` (K,), within their physical ranges."""
        moved = dict(theta)
        for name, change in zip(names, step, strict=True):
            key = self.keys[name]
            moved[name] = float(np.clip(theta.get(name, 0.0) + change, key.low, key.high))
        return moved


def _run_item(problem, item, noise, smoothing, function, common):
    """Call ``function`` in a worker, with noise and smoothing of the parent process."""
    problem.noise = noise
    problem._apply_smoothing(smoothing)
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
    alone = Problem([problem.all_models[k]], problem.keys, problem.priors, problem.p)
    if raw is None:
        alone.state(theta, names)
    else:
        alone._raw = [raw]
    alone.learn_noise(wide)
    return alone.noise
