"""
Test for closed-loop bias: comparison of gains in slow and in fast motion.

In closed loop, gust and motion are correlated. A controller with loop gain L leaves d / (1 + L)
of a gust d. At low frequencies, where L is large, the commands are about -d with little motion. A
fit explains this by a larger inertia or a smaller thrust. At high frequencies the motion follows
the gust. A parameter of the robot is the same at all frequencies. Source: Forssell and Ljung,
Closed-loop identification revisited, Automatica 35, 1999 (bias by frequency).
"""

from collections.abc import Iterator

import numpy as np

from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.residual import CHANNELS, THIN
from beetle_omni_ros.identify.inference.least_squares import solved
from beetle_omni_ros.identify.inference.prior import together


def by_band(problem: Problem, x: np.ndarray, r: np.ndarray,
            groups: str = 'B') -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """
    Scores (K,) and information (K, K) of each frequency band of each of the groups of channels.

    Their sums are ``x.T @ r`` and ``x.T @ x`` for whitened slopes x and whitened residual r.
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


def gain_by_part(problem: Problem, x: np.ndarray, r: np.ndarray) -> tuple[float, float]:
    """
    Gains in chi2 of body parameters for all bands together and for a part of them.

    Other keys are projected out of the whitened slopes x (n, K) and the residual r (n,).

    Returns:
        gain of one set of values for all bands; larger gain of one set for the bands below or for
        those above ``slow_below``.

    """
    parts = list(by_band(problem, x, r))
    edge = 1 + list(problem.p.band_edges).index(problem.p.slow_below)
    everywhere, slow, quick = (_gain(*(sum(part[k] for part in some) for k in (0, 1)))
                               for some in (parts, parts[:edge], parts[edge:]))
    return everywhere, max(slow, quick)


def differs_between_bands(problem: Problem, x: np.ndarray, r: np.ndarray,
                          gain: float = 0.0) -> bool:
    """
    Whether parameters explain far more in a part of the bands than in all; see gain_by_part.

    ``gain`` is the total gain of the objective with the priors. An effect that implausible
    tolerances could absorb gains in the priors and not in the bands.
    """
    everywhere, part = gain_by_part(problem, x, r)
    return part > problem.p.part_share * max(everywhere, gain) + problem.p.part_free * x.shape[1]


def _gain(score, information):
    return float(score @ np.linalg.pinv(information, rcond=1e-8, hermitian=True) @ score)


def _spectrum(x, r, period):
    """Frequencies [Hz] and one-sided spectra with the inner products of the time series."""
    n = len(r)
    frequency = np.fft.rfftfreq(n, period)
    twice = np.where((frequency == 0) | (2 * np.arange(len(frequency)) == n), 1.0, 2.0)
    weight = np.sqrt(twice / n)
    return frequency, weight[:, None] * np.fft.rfft(x, axis=0), weight * np.fft.rfft(r)


def project_out(problem: Problem, state: State, names: list[str], columns: np.ndarray,
                free: frozenset[str]) -> tuple[np.ndarray, np.ndarray]:
    """Columns (n, K) and residual (n,) of a fit without what the named keys explain."""
    s = state.slopes[:, [state.index[name] for name in names]]
    slope, _ = together(problem.priors, state.theta, names, free)
    left = np.column_stack([columns, state.r])
    left -= s @ solved(s.T @ s + np.diag(slope**2), s.T @ left)
    return left[:, :-1], left[:, -1]
