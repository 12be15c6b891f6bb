"""How well a solution explains flights: shares, discrepancies and errors before and after."""

from __future__ import annotations

from collections.abc import Sequence
from math import log

import numpy as np

from beetle_omni_ros.identify.flights.discrepancy import discrepancies
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.solution import Solution
from beetle_omni_ros.identify.flights.spectrum import pooled, Spectrum, spectrum


def fitted(engine: Engine, solution: Solution, k: int) -> np.ndarray:
    """(K,) keys of flight k, without the discrepancy."""
    x = solution.equations.of_flight(k, solution.theta)[:len(engine.names)]
    x[:engine.known] += solution.theta[:engine.known]
    return x


def noise_of(found: Spectrum) -> np.ndarray:
    """(F, C) standard deviations of the noise of the coefficients."""
    return np.sqrt(np.diagonal(found.noise, axis1=1, axis2=2))[found.band]


def explained(engine: Engine, solution: Solution, group: str) -> float:
    """Share of the variance of a group's measurements that the fit predicts, by motion."""
    own = [c for c, name in enumerate(engine.channels) if name.startswith(group)]
    left = total = 0.0
    for k, (flight, found) in enumerate(zip(engine.flights, solution.spectra, strict=True)):
        # without the generic discrepancy, which predicts what feedback leaves
        x = fitted(engine, solution, k)
        # a fit of feedback makes the robot heavier; the inertia is that of the file
        x[[k for k, name in enumerate(engine.names) if name.startswith('inertia.')]] = 0.0
        measured = spectrum(flight.linear({}, []).measured, np.zeros((*flight.mask.shape, 0)),
                            flight.mask, flight.period, found.floor, flight.highest,
                            engine.groups, engine.filters[k])
        moving = found.band > 0
        moving[found.counts[0]:] = False
        rest, all_of_it = ((x / noise_of(found))[:, moving][:, :, own] for x in (
            found.residual + found.slopes @ x, measured.residual))
        left, total = left + (rest**2).sum(), total + (all_of_it**2).sum()
    return 1 - left / total


def discrepancy_sizes(engine: Engine, solution: Solution) -> list[float]:
    """RMS of the discrepancy in each channel, with its unit."""
    weights = solution.equations.of_generic(solution.theta)
    return [float(np.concatenate([
        generic[flight.mask[:, c], c].reshape(-1, len(weights)) @ weights
        for flight, generic in zip(engine.flights, engine.generic, strict=True)]).std())
        for c in range(len(engine.channels))]


def errors(engine: Engine, solution: Solution, named: Sequence[int], flights: Sequence
           ) -> tuple[float, float, float, float | None]:
    """
    Whitened RMS of flights without and with the named entries, and of a fit; closure.

    Tolerances of the robot are as fitted, so that they count neither before nor after. The
    last fit adapts everything to these flights, within the priors.
    The flights' own deviations are fitted within their priors in each case. The noise is that
    of the fitted flights.
    """
    keep = engine.flights, engine.generic, engine.filters
    engine.flights, engine.filters = list(flights), [engine.common] * len(flights)
    engine.generic = discrepancies(engine.flights)
    zeros = np.zeros((len(flights), len(engine.names)))
    theta = np.concatenate([solution.theta[:engine.known],
                            np.zeros(len(engine.names) - engine.known)])
    fitted = engine.flights == keep[0]
    spectra = engine._spectra(theta, zeros, fitted)
    engine.flights, engine.generic, engine.filters = keep
    noise, total, count = pooled(solution.spectra), np.zeros(3), 0
    less = theta.copy()
    less[engine.indices(named)] = 0.0
    own = engine.flight.copy()
    for _, key, column in engine.repeats:
        if not fitted:      # sensors of flights that judge may differ from those of the others
            own[key] = engine.typical[column]
    every = np.hypot(engine.narrow, own)
    every[engine.indices(named)] += 9 * engine.typical[engine.indices(named)]
    for each in spectra:
        each.noise = noise
        g, h = (part.sum(axis=(0, 1)) for part in each.grams())
        r2 = each.power()
        for k, (start, free) in enumerate((
                (less, own), (theta, own), (theta, every))):
            at = np.flatnonzero(free > 0)
            left, info = h - g @ start, g[np.ix_(at, at)]
            inner = np.linalg.inv(info + np.diag(free[at]**-2))
            move = inner @ left[at]
            total[k] += r2 - 2 * h @ start + start @ g @ start - 2 * left[at] @ move \
                + move @ info @ move
            # what a fit explains of white noise alone
            total[k] += np.trace(inner @ info)
        count += each.size
    total = np.maximum(total, 1e-9 * count)
    # chi2 that is left of the difference, if the flights show a difference at all
    closure = 1 - max(total[1] - total[2], 0.0) / (total[0] - total[2]) \
        if total[0] - total[1] > 2 * log(1 / engine.alpha) else None
    before, after, floor = np.sqrt(total / count)
    return float(before), float(after), float(floor), closure


def left_of(engine: Engine, solution: Solution) -> list[np.ndarray]:
    """(B, F, C) whitened residual of each flight after the fit, without the discrepancy."""
    rows = []
    for k, found in enumerate(solution.spectra):
        rest = found.residual + found.slopes @ fitted(engine, solution, k)
        for key, values in solution.by_band:
            rest += found.slopes[:, :, :, key] * values[found.band][None, :, None]
        rows.append(rest)
    return rows
