"""
Fits of common values and of deviations of each group, with evidence and held-out blocks.

A *unit* is one measured channel of one recording. Its parameters are ``theta = base + S x``: the
columns of ``S`` are the prior standard deviations of a common value and of the deviations of the
groups to which the unit belongs. So the prior of ``x`` is standard normal. The evidence is
Laplace's approximation (MacKay 2003, chapter 28): a parameter that the data do not need lowers it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t

from beetle_omni_ros.identify.inference.robust import huber

CONVERGED = 1e-4    # decrease of the cost, relative to the number of samples
WIDTH = 1.96        # standard deviations of a 95 % interval
SLOWEST = 4         # cosines of slow noise


@dataclass(frozen=True)
class Spread:
    """
    Prior standard deviations of one parameter about its base value, in its coordinate.

    Attributes:
        common: of the value that all units share; 0: it has none.
        groups: name of a grouping -> standard deviation of the deviations of its groups.

    """

    common: float
    groups: dict[str, float]


def design(spreads: Sequence[Spread], labels: dict[str, Sequence], active: np.ndarray
           ) -> np.ndarray:
    """
    The matrices S (U, P, X) of all units.

    Args:
        spreads: P parameters.
        labels: name of a grouping -> the group of each of the U units. A grouping with one group
            has no deviations, unless the parameter has no common value.
        active: (P,) parameters that may change.

    """
    count = len(next(iter(labels.values())))
    columns = []
    for p in np.flatnonzero(active):
        spread = spreads[int(p)]
        parts = [(spread.common, np.ones(count))] if spread.common else []
        for name, deviation in spread.groups.items():
            groups = sorted(set(labels[name]))
            if deviation and (len(groups) > 1 or not spread.common):
                parts += [(deviation, np.array([label == group for label in labels[name]]))
                          for group in groups]
        for scale, member in parts:
            column = np.zeros((count, len(spreads)))
            column[:, p] = scale * member
            columns.append(column)
    return np.stack(columns, axis=-1) if columns else np.zeros((count, len(spreads), 0))


@dataclass(frozen=True, eq=False)
class Fit:
    """
    Solution of a hierarchical problem.

    Attributes:
        x: (X,) standardised values.
        s: (U, P, X) design.
        theta: (U, P) parameters of each unit.
        chi2: sum of squared whitened residuals, with Huber's loss.
        information: (X, X) of data and prior.
        held: (blocks,) chi2 of each block, predicted from the others.
        deviations: (blocks, X) change of x without each block.
        inflation: variance of the gradient over that of independent residuals, >= 1.
        slow: (recordings, SLOWEST, X) slowest changes of the gradient over each recording.
        converged: whether the last step changed the cost by less than CONVERGED a sample.

    """

    x: np.ndarray
    s: np.ndarray
    theta: np.ndarray
    chi2: float
    information: np.ndarray
    held: np.ndarray
    deviations: np.ndarray
    inflation: float
    slow: np.ndarray
    converged: bool = False

    def evidence(self, inflation: float) -> float:
        """Logarithm of the evidence [nat], without constants, for an inflated noise."""
        size = len(self.x)
        inner = (self.information - np.eye(size)) / inflation + np.eye(size)
        return float(-0.5 * (self.chi2 / inflation + self.x @ self.x)
                     - 0.5 * np.linalg.slogdet(inner)[1])

    def covariance(self) -> np.ndarray:
        """
        (X, X) covariance of x, from curvature and from the slowest change of the residuals.

        The curvature holds for noise inflated by :attr:`inflation`, which is that of short
        memory. Noise that drifts over the whole recording moves some parameters further, as a
        zero. So each parameter is widened by the mean over the units that have it of its variance
        by :attr:`slow`, with the quantile of Student's t for as many terms (Lazarus et al. 2018).
        """
        size = len(self.x)
        curvature = np.linalg.inv((self.information - np.eye(size)) / self.inflation
                                  + np.eye(size))
        inverse = np.linalg.inv(self.information)
        widen = np.ones(size)
        for p in range(self.s.shape[1]):
            own = self.s[self.s[:, p].any(axis=1), p]
            if not len(own):
                continue
            # cosines of each recording: at least SLOWEST in all units
            count = -(-SLOWEST // len(own))
            waves = own @ inverse @ self.slow[:, :count].reshape(-1, size).T
            slow = (waves**2).sum(axis=1) / count + ((own @ inverse)**2).sum(axis=1)
            ratio = (slow / np.einsum('ux,xy,uy->u', own, curvature, own)).mean()
            ratio *= (t.isf(0.025, len(own) * count) / WIDTH)**2
            widen[own.any(axis=0)] = np.sqrt(max(ratio, 1.0))
        return curvature * widen[:, None] * widen

    def spread(self) -> np.ndarray:
        """(U, P, P) covariance of theta of each unit."""
        return self.s @ self.covariance() @ self.s.transpose(0, 2, 1)


Model = Callable[[np.ndarray, np.ndarray], tuple[list[np.ndarray], list[np.ndarray]]]


def solve(model: Model, base: np.ndarray, s: np.ndarray, x: np.ndarray, groups: Sequence,
          blocks: list[np.ndarray], low: np.ndarray, high: np.ndarray, memory: dict | int = 20,
          iterations: int = 15) -> Fit:
    """
    Levenberg-Marquardt in the standardised values.

    Args:
        model: (theta (U, P), active (P,)) -> whitened residuals of each unit (n_u,), and their
            derivatives (P, n_u); rows of inactive parameters are ignored.
        base: (U, P) values at x = 0.
        s: (U, P, X) design.
        x: (X,) start.
        groups: recording of each unit; units of one recording with equally many samples have them
            together.
        blocks: (n_u,) number of the block of each sample, from 0, for each unit.
        low: (P,) lower bounds of theta; a value beyond is clipped.
        high: (P,) upper bounds.
        memory: samples over which residuals may be correlated, for all groups or by group.
        iterations: largest number of iterations.

    """
    active = (s != 0).any(axis=(0, 2))

    def at(x):
        theta = np.clip(base + s @ x, low, high)
        raw = model(theta, active)
        own, ratio = zip(*map(huber, raw[0]), strict=True)
        return theta, own, [j * r for j, r in zip(raw[1], ratio, strict=True)], raw

    def normal(slopes, residuals):
        return (sum(part.T @ (j @ j.T) @ part for part, j in zip(s, slopes, strict=True)),
                sum(part.T @ (j @ r) for part, j, r in zip(s, slopes, residuals, strict=True)))

    def cost(x, residuals):
        return sum(r @ r for r in residuals) + x @ x

    damping, now = 0.01, at(x)
    value, samples, converged = cost(x, now[1]), sum(map(len, now[1])), True
    for _ in range(iterations if x.size else 0):
        h, g = normal(now[2], now[1])
        h, g = h + np.eye(len(x)), g + x
        step = -np.linalg.solve(h + damping * np.diag(np.diag(h)), g)
        tried = x + np.clip(step, -2.0, 2.0)
        new = at(tried)
        after = cost(tried, new[1])
        if after < value:
            fall, x, now, value = value - after, tried, new, after
            damping = max(damping / 5, 1e-6)
            if fall < CONVERGED * samples:
                break
        else:
            damping *= 8
            if damping > 1e5:
                break
    else:
        converged = not x.size
    theta, residuals, slopes, raw = now
    return replace(_judged(x, s, theta, residuals, slopes, raw, groups, blocks, memory),
                   converged=converged)


def _judged(x, s, theta, residuals, slopes, raw, groups, blocks, memory):
    """The fit with its curvature, its scatter and the prediction of each block by the others."""
    count = 1 + max(int(block.max(initial=0)) for block in blocks)
    size = len(x)
    parts, scores = np.zeros((count, size, size)), np.zeros((count, size))
    # Units of one recording with other rates have their own samples.
    series = {(group, len(r)): np.zeros((len(r), size))
              for group, r in zip(groups, residuals, strict=True)}
    for part, j, r, group, block in zip(s, slopes, residuals, groups, blocks, strict=True):
        series[group, len(r)] += (j * r).T @ part
        for b in range(count):
            own = j[:, block == b]
            parts[b] += part.T @ (own @ own.T) @ part
            scores[b] += part.T @ (own @ r[block == b])
    information = parts.sum(axis=0) + np.eye(size)
    gradient = scores.sum(axis=0) + x
    deviations = np.array([-np.linalg.solve(information - h, gradient - g)
                           for h, g in zip(parts, scores, strict=True)]).reshape(count, size)
    held = np.zeros(count)
    for part, r, j, block in zip(s, *raw, blocks, strict=True):
        moved = j.T @ (part @ deviations.T) if size else np.zeros((len(r), count))
        held += np.bincount(block, huber(r + moved[np.arange(len(r)), block])[0]**2, count)
    ratio, slow = 1.0, np.array([_slow(g) for g in series.values()])
    if size:
        inverse = np.linalg.inv(information)
        spread = sum(_long_run(g, memory[group] if isinstance(memory, dict) else memory)
                     for (group, _), g in series.items())
        ratio = np.trace(inverse @ spread) / max(np.trace(inverse @ (information - np.eye(size))),
                                                 1e-9)
    return Fit(x, s, theta, float(sum(r @ r for r in residuals)), information, held, deviations,
               float(max(ratio, 1.0)), slow)


def _long_run(scores, memory):
    """Variance (X, X) of the sum of correlated scores (n, X) (Newey and West 1987)."""
    total = scores.T @ scores
    for lag in range(1, min(memory, len(scores) - 1) + 1):
        part = scores[lag:].T @ scores[:-lag]
        total += (1 - lag / (memory + 1)) * (part + part.T)
    return total


def _slow(scores):
    """First cosine transforms (SLOWEST, X) of scores (n, X); each squared is a variance."""
    n = len(scores)
    waves = np.cos(np.pi * np.arange(1, SLOWEST + 1)[:, None] * (np.arange(n) + 0.5) / n)
    return np.sqrt(2) * waves @ scores
