"""
Evidence of sets of catalogue entries from the normal equations of several flights.

For flight f, linearised at its own point,

    r_f = -(A_f theta + B_f eta_f) + e_f,

with the common deviations ``theta``, those of the flight ``eta_f`` and the noise ``e_f``. Keys
have normal priors. A set of entries widens the priors of its keys from narrow to typical. The
evidence of a set against the empty one is closed: with the profile of its keys, estimate m and
information I, it is the ratio of the densities of m under both priors. The covariance of m is
widened in each direction in which the blocks scatter more than their noise allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import comb, inf, log, pi, sqrt

import numpy as np

from beetle_omni_ros.identify.flights.keys import Entry
from beetle_omni_ros.identify.flights.spectrum import NONE, Spectrum
from beetle_omni_ros.identify.inference.noise import few_blocks, positive, within_limits

SCALES = 1.0, 3.0, 9.0  # times typical: the prior of a candidate is a mixture of these
MIXED = log(len(SCALES))    # its price
EXACT = 1e-3            # deviation of a factor that is one
ROUNDING = 1e-12        # share of a variance or of information below which it is lost in rounding


@dataclass(eq=False)
class Normal:
    """
    Normal equations of all flights without the deviations of the flights.

    Attributes:
        names: (K,) keys.
        info: (K, K) information of the data.
        right: (K,) right side.
        scores: (B, K) and slopes (B, K, K): score of a block at theta is scores - slopes theta.
        noise: (K, K) covariance of the sum of the scores by the noise alone. It is smaller than
            the information where deviations of flights or a discrepancy limit what is known.

    """

    names: list[str]
    info: np.ndarray
    right: np.ndarray
    scores: np.ndarray
    slopes: np.ndarray
    noise: np.ndarray
    flights: list[tuple] = field(default_factory=list, repr=False)
    eliminated: tuple[np.ndarray, np.ndarray] | None = None

    def of_generic(self, theta: np.ndarray) -> np.ndarray:
        """Weights of the eliminated generic keys at ``theta`` (K,); empty if none was."""
        if self.eliminated is None:
            return np.zeros(0)
        a, b = self.eliminated
        return a - b @ theta

    def of_flight(self, k: int, theta: np.ndarray) -> np.ndarray:
        """(K,) deviations of flight k from the common ``theta`` (K,)."""
        theta = np.insert(theta, len(self.names), self.of_generic(theta))
        own, inner, left, right = self.flights[k]
        eta = np.zeros(len(theta))
        eta[own] = inner @ (right - left @ theta)
        return eta


def normal(spectra: Sequence[Spectrum], names: list[str], flight: np.ndarray,
           split: np.ndarray = NONE, groups: np.ndarray = NONE,
           generic: np.ndarray | None = None, whole: bool = False) -> Normal:
    """
    Eliminate the deviations of each flight.

    Args:
        spectra: one for each flight.
        names: (K,) keys.
        flight: (K,) standard deviations between flights; 0: none.
        split: indices of keys that get a further deviation for each group of bands.
        groups: (bands,) group of each band, from 0.
        generic: standard deviations of the last keys, which are eliminated too; None: kept.
        whole: whether the scores are those of flights, not of their blocks.

    Returns:
        normal equations; the deviations of split keys follow the K keys.

    """
    count, copies = len(names), int(groups.max(initial=-1)) + 1
    further = copies * len(split)
    size = count + further
    own = np.flatnonzero(flight > 0)
    info, right, noise = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
    scores, slopes, flights = [], [], []
    for each in spectra:
        g, h = each.grams(groups if len(split) else NONE)
        g, h = (part.sum(axis=0, keepdims=True) for part in (g, h)) if whole else (g, h)
        gs, hs = np.zeros((len(g), size, size)), np.zeros((len(g), size))
        gs[:, :count, :count], hs[:, :count] = g.sum(axis=1), h.sum(axis=1)
        for group in range(copies if len(split) else 0):
            part = g[:, group]
            at = count + group * len(split) + np.arange(len(split))
            gs[:, :count, at] = part[:, :, split]
            gs[:, at, :count] = part[:, split]
            gs[:, at[:, None], at] = part[:, split][:, :, split]
            hs[:, at] = h[:, group][:, split]
        ge, gee, he = gs[:, own], gs[:, own][:, :, own], hs[:, own]
        inner = np.linalg.inv(gee.sum(axis=0) + np.diag(flight[own]**-2))
        left, right_e = ge.sum(axis=0), he.sum(axis=0)
        project = left.T @ inner                        # (size, E)
        a, b = inner @ right_e, inner @ left            # eta = a - b theta
        # each block carries its share of the prior, so that the sum is the score of all
        coupling = ge.transpose(0, 2, 1) - project @ gee - project * flight[own]**-2 / len(g)
        scores.append(hs - he @ project.T - coupling @ a)
        slopes.append(gs - project @ ge - coupling @ b)
        info += gs.sum(axis=0) - left.T @ inner @ left
        right += hs.sum(axis=0) - left.T @ a
        noise += gs.sum(axis=0) - left.T @ inner @ left - project * flight[own]**-2 @ project.T
        flights.append((own, inner, left, right_e))
    found = Normal(list(names), info, right, np.concatenate(scores), np.concatenate(slopes),
                   noise, flights)
    return found if generic is None else _without(found, count, generic)


def _without(whole, count, generic):
    """Normal equations without the generic keys, which end at ``count``."""
    size = len(whole.info)
    w = np.arange(count - len(generic), count)
    keep = np.setdiff1d(np.arange(size), w)
    inner = np.linalg.inv(whole.info[np.ix_(w, w)] + np.diag(generic**-2))
    left = whole.info[np.ix_(w, keep)]
    a, b = inner @ whole.right[w], inner @ left         # w = a - b theta
    project = left.T @ inner
    info = whole.info[np.ix_(keep, keep)] - left.T @ b
    right = whole.right[keep] - left.T @ a
    # scores at w: of the others less the projection of those of w
    s, g = whole.scores, whole.slopes
    scores = s[:, keep] - g[:, keep][:, :, w] @ a - (s[:, w] - g[:, w][:, :, w] @ a) @ project.T
    slopes = g[:, keep][:, :, keep] - g[:, keep][:, :, w] @ b \
        - project @ (g[:, w][:, :, keep] - g[:, w][:, :, w] @ b)
    n = whole.noise
    noise = n[np.ix_(keep, keep)] - project @ n[w][:, keep] - n[keep][:, w] @ project.T \
        + project @ n[np.ix_(w, w)] @ project.T
    return Normal(whole.names[:count - len(generic)], info, right, scores, slopes, noise,
                  whole.flights, (a, b))


@dataclass(eq=False)
class Posterior:
    """
    Evidence and estimate of one set.

    Attributes:
        gain: ln of the evidence over that of the empty set [nat].
        theta: (K,) mean of all keys.
        estimate: (d,) posterior mean of the set's keys.
        covariance: (d, d) their posterior covariance, widened by the blocks.

    """

    gain: float
    theta: np.ndarray
    estimate: np.ndarray
    covariance: np.ndarray


class Judge:
    """
    Evidence of sets for given normal equations and priors.

    Args:
        equations: normal equations.
        narrow: (K,) standard deviations that every key has.
        typical: (K,) what a candidate adds.
        bounds: (K, 2) smallest and largest possible values.
        kept: (K,) keys of tolerances with bounds, which are part of every comparison.
        owner: (K,) index of the entry of each key.
        level: probability at which the widening by few blocks holds; None: by their scatter alone.
        far: (K,) keys whose deviation may be much larger than typical; not those of sensors.
        acting: (K,) factors of effects that act at the point of linearisation. A set that has
            such an effect has it as linearised, with a factor of one.

    """

    def __init__(self, equations: Normal, narrow: np.ndarray, typical: np.ndarray,
                 bounds: np.ndarray, kept: np.ndarray, owner: np.ndarray, level: float | None,
                 far: np.ndarray, acting: np.ndarray):
        self.equations, self.narrow, self.typical = equations, narrow, typical
        self.bounds, self.kept = bounds.tolist(), kept
        self.bounded = np.isfinite(bounds).any(axis=1)
        self.always = tuple(np.flatnonzero(kept))
        self.covariance = np.linalg.inv(equations.info + np.diag(narrow**-2))
        self.mean = self.covariance @ equations.right
        # scores of blocks at the mean, and how those of the keys change them
        self._scores = equations.scores - equations.slopes @ self.mean
        self._slopes = equations.slopes @ self.covariance
        self.blocks = len(equations.scores)
        self.owner, self.far, self.acting = owner, far, acting
        self.student = 1.0 if level is None else few_blocks(level, self.blocks)
        self._kept: dict[tuple[int, ...], Posterior] = {}
        self._profiles: dict[tuple[int, ...], tuple] = {}

    def posterior(self, chosen: Sequence[int]) -> Posterior:
        """Evidence of the set of keys ``chosen`` (indices) over the empty set."""
        index = tuple(sorted(chosen))
        if index not in self._kept:
            c, estimate, wide, direction, slab = self._profile(index)
            free = _among(c, index)
            _, mean, total = self._bounded(c, estimate, wide,
                                           np.where(free, slab, self.narrow[c]), free)
            theta = self.mean + direction @ (mean - self.mean[c])
            self._kept[index] = Posterior(self.gain(index, ()), theta, mean[free],
                                          total[np.ix_(free, free)])
        return self._kept[index]

    def gain(self, one: Sequence[int], other: Sequence[int]) -> float:
        """
        Ln of the evidence of one set of keys over that of another [nat].

        Both are judged with the covariance of a fit of both together, so that the comparison of
        two sets with common keys depends on the others alone.
        """
        if set(one) == set(other):
            return 0.0
        c, estimate, wide, _, slab = self._profile(tuple(sorted({*one, *other})))
        total = 0.0
        for chosen, sign in ((one, 1.0), (other, -1.0)):
            free = _among(c, chosen)
            prior = np.where(free, slab, self.narrow[c])
            total += sign * (self._bounded(c, estimate, wide, prior, free)[0] - MIXED * len(
                np.unique(self.owner[c[free & self.far[c]]])))
        return float(total)

    def least(self, index: list[int], evidence: float) -> float:
        """Typical sizes of some keys that have this mean ``evidence``; see :func:`least_size`."""
        c, _, wide, _, _ = self._profile(tuple(sorted(index)))
        free = _among(c, index)
        far = bool(self.far[c[free]].any())
        ratio = np.linalg.solve(wide + np.diag(self.narrow[c]**2), np.diag(
            free * self.typical[c]**2))
        return least_size(ratio, evidence + MIXED * far, SCALES if far else SCALES[:1])

    def _profile(self, index):
        """Keys, estimate and its covariance, change of all keys by them, prior deviations."""
        if index in self._profiles:
            return self._profiles[index]
        c = np.array(sorted({*index, *self.always}), dtype=int)
        if not len(c):
            return c, np.zeros(0), np.zeros((0, 0)), np.zeros((len(self.mean), 0)), np.zeros(0)
        own = np.linalg.inv(self.covariance[np.ix_(c, c)])
        direction = self.covariance[:, c] @ own                     # (K, d)
        info = positive(own - np.diag(self.narrow[c]**-2), self.narrow[c])[2]
        score = own @ self.mean[c]
        estimate = np.linalg.solve(info, score)
        slab = np.where(self.acting[c], EXACT, np.hypot(
            self.narrow[c], self._scales(c, estimate) * self.typical[c]))
        fitted = np.linalg.solve(info + np.diag(slab**-2), score + self.acting[c] * slab**-2)
        scores = self._scores - self._slopes[:, :, c] @ (own @ (fitted - self.mean[c]))
        wide = self._widened(direction, info, scores @ direction)
        self._profiles[index] = c, estimate, wide, direction, slab
        return self._profiles[index]

    def _scales(self, c, estimate):
        """
        Factors (d,) of the typical deviations.

        The prior of a candidate is a mixture of three normal ones, 1, 3 and 9 times typical. Its
        term that reaches the estimate is used, a lower bound; its weight costs ln 3.
        """
        ratio = np.abs(estimate) / np.maximum(self.typical[c], 1e-12)
        group = np.zeros(len(c), dtype=int)
        for owner in np.unique(self.owner[c]):
            own = self.owner[c] == owner
            if self.far[c][own].all():
                group[own] = np.searchsorted((1.5, 4.5), ratio[own].max())
        return np.array(SCALES)[group]

    def _widened(self, direction, info, scores):
        """
        (d, d) covariance of a profile, widened where blocks scatter more than their noise.

        Only the part of the covariance is widened that the noise causes. The part by deviations
        of flights and by other keys is known from their priors.
        """
        scatter = scores.T @ scores * self.blocks / max(self.blocks - 1, 1)
        noise = direction.T @ self.equations.noise @ direction
        root, less, _ = positive(noise, np.maximum(
            np.diag(noise), ROUNDING * np.diag(info))**-0.5)
        ratio, axes = np.linalg.eigh(less @ scatter @ less.T)
        more = root @ (axes * (self.student * np.maximum(ratio, 1.0) - 1.0) @ axes.T) @ root.T
        inverse = np.linalg.inv(info)
        return inverse + inverse @ more @ inverse

    def _bounded(self, c, estimate, wide, prior, free):
        """
        Ln of the density of an estimate, and mean and covariance of its keys within their bounds.

        The priors are normal about zero, or about one for the factor of an effect that acts, and
        end at the bounds. The bounds of one key after the other cut the posterior, which stays
        normal with the mean and the covariance of what remains. The upper limit of a tolerance
        does not hold for a candidate. The lower one is physical.
        """
        if not len(c):
            return 0.0, estimate, wide
        variance, centre = prior**2, free * self.acting[c]
        estimate = estimate - centre
        both = wide + np.diag(variance)
        inverse = np.linalg.inv(both)
        # the normal density of an estimate with the covariance of noise and prior
        value = -0.5 * (estimate @ inverse @ estimate + np.linalg.slogdet(2 * pi * both)[1])
        total, mean = (variance[:, None] * inverse @ part for part in (wide, estimate))
        for k in np.flatnonzero(self.bounded[c]):
            (low, high), size = np.subtract(self.bounds[c[k]], centre[k]), float(prior[k])
            high = inf if free[k] and self.kept[c[k]] else high
            deviation, middle = sqrt(max(total[k, k], ROUNDING * variance[k])), float(mean[k])
            chance, shift, left = within_limits(
                (low - middle) / deviation, (high - middle) / deviation)
            value += chance - within_limits(low / size, high / size)[0]
            change = total[:, k] / deviation**2
            mean = mean + change * (shift * deviation)
            total = total - change[:, None] * (total[k] * (1 - left))
        return value, mean + centre, total


def _among(keys, chosen):
    """(d,) whether each of few keys is among the chosen ones; np.isin takes ten times as long."""
    chosen = set(chosen)
    return np.array([k in chosen for k in keys.tolist()], dtype=bool)


@dataclass(eq=False)
class Solution:
    """
    Result of the engine.

    Attributes:
        names: keys.
        entries: catalogue entries.
        gains: set of indices of entries -> ln of its evidence over that of the empty set.
        best: most probable set.
        posterior: its evidence and estimate.
        unsteady: named entry -> gain of one value for each group of bands over one value [nat].
        banned: entry that was excluded for this -> its gain.
        sought: gain of the best set before any was excluded [nat].
        plain: judge of a model without the generic discrepancy.

    """

    names: list[str]
    entries: list[Entry]
    gains: dict[tuple[int, ...], float]
    best: tuple[int, ...]
    posterior: Posterior
    equations: Normal
    judge: Judge
    plain: Judge
    spectra: list[Spectrum] = field(default_factory=list)
    unsteady: dict[int, float] = field(default_factory=dict)
    banned: dict[int, float] = field(default_factory=dict)
    sought: float = 0.0

    @property
    def theta(self) -> np.ndarray:
        """(K,) mean of the keys with the best set."""
        return self.posterior.theta

    @property
    def e_value(self) -> float:
        """Ln of the evidence of sets with an effect over those without, averaged by priors."""
        some, none = (np.logaddexp.reduce([-inf, *(
            log_prior(len(chosen), len(self.entries)) + gain for chosen, gain in self.gains.items()
            if all(self.entries[k].varying for k in chosen) is empty)]) for empty in (False, True))
        return float(some - none)


def least_size(ratio: np.ndarray, evidence: float, scales: Sequence[float]) -> float:
    """
    Typical sizes from which an effect has the mean ``evidence`` [nat].

    Args:
        ratio: (d, d) variance of its typical size, over that of an estimate without it, N.
        evidence: ln of densities with the variances N (1 + scale^2 ratio) and N.
        scales: of the wide prior; the best one counts.

    """
    own = np.linalg.eigvals(ratio).real
    sizes = []
    for wide in [scale**2 * own for scale in scales]:
        share = wide / (1 + wide)
        sizes.append((2 * evidence + (np.log1p(wide) - share).sum())
                     / max((own * share).sum(), 1e-12))
    return sqrt(min(sizes))


def log_prior(size: int, count: int) -> float:
    """Ln of the prior of one set of ``size`` of ``count`` entries; one more is half as likely."""
    return -(size + 1) * log(2.0) - log(comb(count, size))
