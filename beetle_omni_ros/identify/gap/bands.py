"""
Whether slow and quick motion tell the same of an entry, or of what a controller answers to gusts.

In closed loop a gust d and the motion go together: a controller with loop gain L leaves of it
d / (1 + L), and answers with the rest. Where L is large, below about 1 Hz, the commands say -d
and hardly anything moves: a fit takes that for an inertia twice as large, or a thrust half as
strong. Above, nothing answers, and what moves goes with the gust. A number of the robot is the
same at all frequencies. (Bias of closed-loop identification by frequency: Forssell and Ljung,
Closed-loop identification revisited, Automatica 35, 1999.)
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.residual import CHANNELS, THIN
from beetle_omni_ros.identify.inference.least_squares import solved
from beetle_omni_ros.identify.inference.prior import together


def by_band(problem: Problem, x: np.ndarray, r: np.ndarray,
            groups: str = 'B') -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """
    Scores (K,) and information (K, K) of each band of each group of channels.

    Their sums are ``x.T @ r`` and ``x.T @ x`` of these channels.

    Args:
        problem: which channel and flight a sample belongs to.
        x: (n, K) whitened slopes.
        r: (n,) whitened residual.
        groups: of channels.

    """
    p, first = problem.p, 0
    edges = [0.0, *p.band_edges, np.inf]
    periods = {'B': THIN * p.grid * p.body_every, 'A': p.grid * p.world_every,
               'W': p.grid * p.rate_every, 'J': p.grid * p.joint_every}
    for group, channels in CHANNELS.items():
        rows = [(problem.flight == f) & (problem.where == first + c)
                for f in np.unique(problem.flight) for c in range(len(channels))]
        first += len(channels)
        if group not in groups:
            continue
        spectra = [_spectrum(x[keep], r[keep], periods[group]) for keep in rows if keep.any()]
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            score, information = np.zeros(x.shape[1]), np.zeros((x.shape[1],) * 2)
            for frequency, slopes, rest in spectra:
                band = (frequency >= low) & (frequency < high)
                score += (slopes[band].conj().T @ rest[band]).real
                information += (slopes[band].conj().T @ slopes[band]).real
            yield score, information


def apart(problem: Problem, x: np.ndarray, r: np.ndarray) -> tuple[float, float]:
    """
    What numbers of the body's equations explain that hold in all motion, or in a part of it.

    Args:
        problem: as of :func:`by_band`.
        x: (n, K) whitened slopes, without what other numbers could take over.
        r: (n,) whitened residual without the numbers, likewise.

    Returns:
        chi2 gained by one set of numbers for all bands; by one for the bands below ``slow_below``
        and none above, or the other way round, whichever is more.

    """
    parts = list(by_band(problem, x, r))
    edge = 1 + list(problem.p.band_edges).index(problem.p.slow_below)
    everywhere, slow, quick = (_gain(*(sum(part[k] for part in some) for k in (0, 1)))
                               for some in (parts, parts[:edge], parts[edge:]))
    return everywhere, max(slow, quick)


def in_part_alone(problem: Problem, x: np.ndarray, r: np.ndarray, gain: float = 0.0) -> bool:
    """
    Whether numbers explain far more in a part of the motion than in all.

    Args:
        problem: as of :func:`by_band`.
        x: as of :func:`apart`.
        r: likewise.
        gain: of the objective in all, where beliefs are part of it: what tolerances beyond all
            belief could take over, a mass by thrust, shows in no band and is none the less there.

    """
    everywhere, part = apart(problem, x, r)
    return part > problem.p.part_share * max(everywhere, gain) + problem.p.part_free * x.shape[1]


def _gain(score, information):
    return float(score @ np.linalg.pinv(information, rcond=1e-8, hermitian=True) @ score)


def _spectrum(x, r, period):
    """Frequencies [Hz], and spectra of the columns whose products add up to those in time."""
    n = len(r)
    frequency = np.fft.rfftfreq(n, period)
    twice = np.where((frequency == 0) | (2 * np.arange(len(frequency)) == n), 1.0, 2.0)
    weight = np.sqrt(twice / n)
    return frequency, weight[:, None] * np.fft.rfft(x, axis=0), weight * np.fft.rfft(r)


def aside(problem: Problem, state: State, names: list[str], columns: np.ndarray,
          free: frozenset[str]) -> tuple[np.ndarray, np.ndarray]:
    """
    ``columns`` (n, K) and the residual (n,) of a fit, less what the named keys could take over.

    Args:
        problem: beliefs.
        state: the fit, with slopes.
        names: of the keys.
        columns: whitened.
        free: keys of which nothing is believed.

    """
    s = state.slopes[:, [state.index[name] for name in names]]
    slope, _ = together(problem.beliefs, state.theta, names, free)
    left = np.column_stack([columns, state.r])
    left -= s @ solved(s.T @ s + np.diag(slope**2), s.T @ left)
    return left[:, :-1], left[:, -1]
