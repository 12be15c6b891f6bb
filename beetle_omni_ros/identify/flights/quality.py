"""
How well a solution explains flights: discrepancies, errors, and what repeats unexplained.

Three tests look at what the fit leaves. They know nothing of causes.

- Repeatable: laws of thrusts, forces and torques that are fitted to one block predict the others.
  The gain is compared with that of drawn noise. What fits one block alone counts nothing.
- Line: a frequency at which the whitened spectrum, the mean over the blocks, exceeds its
  neighbours by more than exponentially distributed power allows.
- Tolerance: a number of the robot that is in no entry, such as the lag of one rotor, is fitted
  far beyond its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np
from scipy.special import chdtrc, fdtrc

from beetle_omni_ros.identify.flights.discrepancy import laws, placed
from beetle_omni_ros.identify.flights.engine import Engine
from beetle_omni_ros.identify.flights.evidence import Solution
from beetle_omni_ros.identify.flights.linearised import RELEVANT
from beetle_omni_ros.identify.flights.spectrum import pooled, Spectrum, spectrum

DRAWS = 499             # simulated flights without anything unexplained
OMITTED = RELEVANT**2   # share of thrust and weight: products of deviations, in no linear model
SLOWEST = 1.0                               # [Hz] of a line; slower ones are the flight's own path
NEAR = 12                                   # frequencies on each side that a line is compared with

LEAST_TIME = 1.0        # [s] in a regime, of which an RMS is stated
UNITS = {'force': 'm/s^2', 'torque': 'rad/s^2', 'acceleration': 'm/s^2', 'rate': 'rad/s',
         'joint': 'rad'}


def fitted(engine: Engine, solution: Solution, k: int) -> np.ndarray:
    """
    (K,) keys of flight k, fitted without the discrepancy.

    In a fit with it, tolerances and discrepancy may oppose each other, so that the fit without
    the share of the discrepancy leaves forces that the measurements do not show.
    """
    theta = solution.plain.posterior(engine.indices(solution.best)).theta
    x = solution.plain.equations.of_flight(k, theta)[:len(engine.names)]
    x[:engine.known] += theta[:engine.known]
    return x


def errors(engine: Engine, solution: Solution, named: Sequence[int], flights: Sequence
           ) -> dict[str, Any]:
    """
    Whitened RMS of flights without and with the named entries, over that of a fit; closure.

    Tolerances of the robot are as fitted, so that they count in none of the three: fitted again,
    they would explain the noise of these flights. The last fit adapts the named entries and the
    discrepancy to these flights. Their own deviations are fitted within their priors in each case.
    The noise is that of the fitted flights. A deviation counts by its size over its prior, too, so
    that no flight takes a named effect as its own. Named sensors are those of all flights.
    """
    generic, keys = np.zeros(len(engine.names) - engine.known), engine.indices(named)
    theta = np.concatenate([solution.theta[:engine.known], generic])
    point = np.concatenate([engine.point_of(solution, solution.theta), generic])
    spectra, fitted = engine.others(flights, point)
    less, own = theta.copy(), engine.flight.copy()
    less[keys] = 0.0
    for _, key, column in engine.repeats:
        if not fitted and key not in keys:    # sensors of flights that judge may be others
            own[key] = engine.typical[column]
    every = own.copy()
    every[engine.known:] = engine.narrow[engine.known:]
    every[keys] += 9 * engine.typical[keys]
    noise, total, count = pooled(solution.spectra), np.zeros(3), 0
    for each in spectra:
        each.noise = noise
        g, h = (part.sum(axis=(0, 1)) for part in each.grams())
        r2, noise_of_own = each.power(), 0.0
        for k, (start, free) in enumerate(((less, own), (theta, own), (theta, every))):
            at = np.flatnonzero(free > 0)
            left, info = h - g @ start, g[np.ix_(at, at)]
            inner = np.linalg.inv(info + np.diag(free[at]**-2))
            total[k] += r2 - 2 * h @ start + start @ g @ start - left[at] @ (inner @ left[at])
            # what the wider priors explain of white noise alone
            explained = float(np.trace(inner @ info))
            noise_of_own = noise_of_own if k else explained
            total[k] += explained - noise_of_own
        count += each.size
    total = np.maximum(total, 1e-9 * count)
    before, after, floor = np.sqrt(total / count).tolist()
    # chi2 that is left of the difference, if the flights show a difference at all
    closure = 1 - max(total[1] - total[2], 0.0) / (total[0] - total[2]) \
        if total[0] - total[1] > 2 * log(1 / engine.alpha) else None
    return {'closure': closure, 'gap_before': before / floor, 'gap_after': after / floor}


def where_of(engine: Engine, solution: Solution) -> list[dict]:
    """
    Disagreement of the robot file by channel and regime of the flight, largest first.

    ``excess``: RMS of the whitened residual over the noise; of a regime, in proportion to the
    RMS there. Rows of the regime 'flight' are about all samples, with ``excess_after`` of the fit
    without discrepancy, and ``rms``, ``rms_after`` and ``discrepancy_rms`` of what repeats and is
    in no entry, with a unit.
    """
    whitened, raw = [], []
    for k, (flight, found) in enumerate(zip(engine.flights, solution.spectra, strict=True)):
        x = fitted(engine, solution, k)
        deviations = np.sqrt(np.diagonal(found.noise, axis1=1, axis2=2))[found.band]
        whitened.append([(rest / deviations).reshape(-1, len(engine.channels))
                         for rest in (found.residual, found.at(x))])
        raw.append([np.where(flight.mask, flight.linear(at, []).residual, np.nan)
                    for at in ({}, dict(zip(engine.names, engine.point_of(solution, x),
                                            strict=False)))])
    excess, rms = (np.sqrt([np.nanmean(np.concatenate(parts)**2, axis=0)
                            for parts in zip(*own, strict=True)]) for own in (whitened, raw))
    before = np.concatenate([parts[0] for parts in raw])
    regime = np.concatenate([regimes_of(flight.motion) for flight in engine.flights])
    weights, rows = solution.equations.of_generic(solution.theta), list[dict]()
    for c, name in enumerate(engine.channels):
        discrepancy = np.concatenate([
            generic[flight.mask[:, c], c].reshape(-1, len(weights)) @ weights
            for flight, generic in zip(engine.flights, engine.generic, strict=True)])
        rows.append({'channel': name, 'regime': 'flight', 'excess': float(excess[0, c]),
                     'excess_after': float(excess[1, c]), 'rms': float(rms[0, c]),
                     'rms_after': float(rms[1, c]), 'discrepancy_rms': float(discrepancy.std()),
                     'unit': UNITS[name.partition('_')[0]]})
        for text in np.unique(regime):
            there = before[regime == text, c]
            there = there[np.isfinite(there)]
            if len(there) * engine.flights[0].period >= LEAST_TIME:
                rows.append({'channel': name, 'regime': str(text), 'excess': float(
                    excess[0, c] * np.sqrt(np.mean(there**2)) / rms[0, c])})
    return sorted(rows, key=lambda row: -row['excess'])


def regimes_of(motion: dict[str, np.ndarray]) -> np.ndarray:
    """(N,) regime of each sample: rotate, near ground, translate, tilted or hover."""
    return np.select([np.linalg.norm(motion['rate'], axis=1) > 0.8, motion['position'][:, 2] < 0.6,
                      np.linalg.norm(motion['velocity'], axis=1) > 0.4,
                      np.abs(motion['tilt']).max(axis=1) > 1.0],
                     ['rotate', 'near ground', 'translate', 'tilted'], 'hover')


@dataclass(frozen=True)
class Unexplained:
    """
    Result of a test.

    Attributes:
        what: no known effect explains, in words.
        probability: of a value as large without anything unexplained.
        gain: logarithm of the likelihood that the left-out blocks gain [nat]; of a line, that of
            its power; of a tolerance, that of its prior.

    """

    what: str
    probability: float
    gain: float

    @property
    def sentence(self) -> str:
        """What was found, as the end of a sentence."""
        return f'no known effect explains {self.what} (probability {self.probability:.1g})'


def repeatable(flights: list, spectra: list[Spectrum], left: list[np.ndarray],
               filters: list[np.ndarray], channels: tuple[str, ...]) -> Unexplained:
    """
    Test of laws that predict blocks which they were not fitted to.

    The gain of a group of weights with covariance M is the sum of h_b' M h_c / 2 over pairs of
    blocks with scores h. The group counts that most exceeds what the power of the noise gives.

    ``flights`` have ``robot``, ``motion`` and ``time``, ``filters`` (C, L) whiten each of them.
    The others are as of :func:`line`.
    """
    own, (slopes, groups) = spectra[0].parts[0][0], laws(flights)
    parts = []
    for flight, found, rest, kernels, effect in zip(flights, spectra, left, filters, slopes,
                                                    strict=True):
        effect = placed(effect, channels)
        small = spectrum(np.zeros(effect.shape[:2]), effect, flight.mask, flight.period,
                         found.floor, flight.highest, [own], kernels)
        count = found.counts[0]
        root = np.linalg.inv(np.linalg.cholesky(found.noise[-1][np.ix_(own, own)]))
        a = np.zeros((*small.residual.shape[:2], len(own), effect.shape[2]))
        a[..., small.parts[0][1]] = small.parts[0][2]
        for band, lost in (*found.hidden, *found.balanced):
            a[:, np.flatnonzero(small.band == band)[:, None], np.isin(own, lost)] = 0.0
        a = (root @ a[:, :count]).reshape(len(rest), -1, effect.shape[2])
        b = (rest[:, :count][..., own] @ root.T).reshape(len(rest), -1, 1)
        parts.append((a, b))
    info = np.concatenate([a.transpose(0, 2, 1) @ a for a, _ in parts])
    score = np.concatenate([(a * b).sum(axis=1) for a, b in parts])
    inner = np.linalg.inv(info.sum(axis=0) + np.eye(len(info[0])) / RELEVANT**2)
    weights, scatter = inner @ score.sum(axis=0), []
    for a, b in parts:      # noise has nothing that laws explain of a coefficient by the others
        b = (b[..., 0] - a @ weights) / (1 - ((a @ inner) * a).sum(axis=2))
        scatter.append((a * b[..., None]**2).transpose(0, 2, 1) @ a)
    rng, (values, vectors) = np.random.default_rng(0), np.linalg.eigh(np.concatenate(scatter))
    roots = vectors * np.sqrt(np.maximum(values, 0))[:, None]
    drawn = rng.normal(size=(len(score), DRAWS, len(roots[0]))) @ roots.transpose(0, 2, 1)
    drawn += OMITTED * rng.normal(size=drawn.shape[1:]) @ info
    drawn = np.concatenate([score[:, None], drawn], axis=1)
    gains, excess = [], []
    for c in groups:
        inner = np.linalg.inv(info[:, c, c].sum(axis=0) + np.eye(c.stop - c.start) / RELEVANT**2)
        whole, each = (((x @ inner) * x).sum(axis=-1) / 2
                       for x in (drawn[..., c].sum(axis=0), drawn[..., c]))
        gains.append(whole - each.sum(axis=0))
        null = gains[-1][1:]
        excess.append((gains[-1] - null.mean()) / max(null.std(), 1e-9))
    most = np.max(excess, axis=0)
    return Unexplained('a force or torque that depends on the motion and repeats', float(
        np.mean(most >= most[0])), float(gains[np.argmax([one[0] for one in excess])][0]))


def line(spectra: list[Spectrum], left: list[np.ndarray], channels: tuple[str, ...],
         own: list[int]) -> Unexplained | None:
    """
    Test of a periodic force or torque; None: clocks allow slow motion only.

    Args:
        spectra: of the flights.
        left: (B, F, C) whitened residual of each flight after the fit.
        channels: names of all channels.
        own: indices of those that are tested.

    """
    # blocks of flights differ in length, and so do their frequencies
    step = max(found.step for found in spectra)
    last = min((rest.shape[1] - 1) * found.step
               for found, rest in zip(spectra, left, strict=True))
    frequency = step * np.arange(int(np.ceil(SLOWEST / step)), int(last / step) + 1)
    rest = np.concatenate([rest[:, np.rint(frequency / found.step).astype(int)][..., own]
                           for found, rest in zip(spectra, left, strict=True)])**2
    blocks, power = len(rest), rest.mean(axis=0)
    # a slope of the spectrum is no line, so the larger of both sides counts
    places = np.arange(NEAR, len(power) - NEAR)
    if not len(places):
        return None
    ratio = np.array([power[k] / np.maximum(power[k - NEAR:k - 1].mean(axis=0),
                                            power[k + 2:k + NEAR + 1].mean(axis=0))
                      for k in places])
    k, c = np.unravel_index(ratio.argmax(), ratio.shape)
    chance = float(fdtrc(blocks, blocks * (NEAR - 1), ratio[k, c])) * ratio.size
    shown = ' and '.join(channels[own[i]].replace('_', ' ') for i in np.argsort(-ratio[k])[:2])
    return Unexplained(
        f'a vibration of {frequency[places[k]]:.2g} Hz in {shown}', min(chance, 1.0),
        float(blocks * (ratio[k, c] - 1 - np.log(ratio[k, c])) / 2))


def beyond(engine: Engine, solution: Solution) -> Unexplained | None:
    """Test of the numbers of the robot that have a tolerance, but are in no entry; None: none."""
    taken = {key for entry in engine.entries for key in entry.keys}
    own = [k for k, name in enumerate(engine.names[:engine.real])
           if name not in taken and not engine.kept[k]]
    if not own:
        return None
    sizes = solution.theta[own] / engine.narrow[own]
    most, k = float(np.abs(sizes).max()), own[int(np.argmax(np.abs(sizes)))]
    effect, _, index = engine.names[k].rstrip(']').partition('[')
    place, off = int(index or 0), float(solution.theta[k])
    what, size = {
        'rotor.lag': (f'the lag of rotor {place + 1}', f'{100 * np.expm1(off):.2g} %'),
        'position.offset': (f"the {'xyz'[place % 3]} of rotor {place // 3 + 1}",
                            f'{1000 * off:.2g} mm'),
        'modules.share': ('the effect of the tilting modules', f'{100 * off:.2g} %'),
    }.get(effect, (effect, f'{off:.2g}'))
    return Unexplained(
        f'{what}, which is off by {size}, {most:.0f} standard deviations of its tolerance',
        min(1.0, len(own) * float(chdtrc(1, most**2))), float(sizes @ sizes) / 2)


def unexplained(engine: Engine, solution: Solution) -> list[Unexplained]:
    """
    What the tests show; the most improbable first. They share the accepted probability.

    Where an entry is excluded, or noise hides the motion, the controller feeds noise back, and
    what repeats may be its answer; nothing is tested there. Nor is it where commands balance
    torques, because most entries have no slope there.
    """
    own = [c for c in solution.spectra[0].parts[0][0]
           if engine.channels[c].split('_')[0] not in engine.without_motion(engine.balanced)]
    if solution.banned or not own:
        return []
    left = [found.at(fitted(engine, solution, k)) for k, found in enumerate(solution.spectra)]
    tests = [repeatable(engine.flights, solution.spectra, left, engine.filters, engine.channels),
             line(solution.spectra, left, engine.channels, own), beyond(engine, solution)]
    least = engine.alpha / len(tests)
    return sorted((test for test in tests if test and test.probability < least),
                  key=lambda test: test.probability)
