"""Flights linearised at one point, with the noise that is learned around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from beetle_omni_ros.identify.flights.discrepancy import discrepancies
from beetle_omni_ros.identify.flights.evidence import normal
from beetle_omni_ros.identify.flights.keys import Entry, Prior
from beetle_omni_ros.identify.flights.spectrum import (
    EDGES,
    pooled,
    Spectrum,
    spectrum,
    whitening,
)

FREE = 100.0            # typical deviations that known effects may have while noise is learned,
                        # so that the noise holds nothing that they explain
STEPS = 1.0, 0.5, 0.25, 0.0     # tried parts of a step from a start to fitted values
FORM = 0.25             # relative error of an entry by its form
# Share of the variance that motion must explain: noise that feedback answers in phase then biases
# a factor by less than the error of form.
MOVED = 1 / (1 + FORM**2)
DRIVES = 'thrust_coefficient.scale'     # key whose slopes are what the commands cause
BY_MOTION = 'rotor_hub_moment.coefficient'      # key of a torque that does not act by commands
IN_LOOP = 'force', 'torque', 'acceleration', 'rate', 'joint'  # noise of these reaches commands
DYNAMIC = range(1, len(EDGES))   # bands without the mean
SAME = 0.04             # share of a typical difference between flights by which one value varies
FLOORS = {'force': 0.02, 'torque': 0.05, 'acceleration': 0.02, 'rate': 0.004, 'joint': 0.0005}
RELEVANT = 0.01         # of hover thrust and of weight: smallest relevant discrepancy
GROUPS = (0.0, 0.5, 2.0)    # [Hz] lower ends of the groups of bands of the test of constancy
TURN = 1 / (2 * np.pi * GROUPS[-1])     # [s] one radian there: the phase of an answer of feedback


class Linearised:
    """
    Several flights with their keys, priors, filters and noise.

    Args:
        flights: objects with ``linear(theta, names)``, ``mask``, ``period``, ``channels`` and
            ``turning``: group that shows whether the robot moves; '': the torques alone do.
        priors: keys and their priors.
        entries: catalogue entries that may be named.
        bounds: smallest and largest value of a key.
        kept: keys of tolerances that have bounds.
        far: keys whose deviation may be many times typical.
        curved: starts, and their tangents, of effects without a slope.
        varying: key of a sensor -> typical difference between flights.
        alpha: accepted probability of a false alarm.
        clock: key that shifts all inputs of the body equations; '': none.

    """

    def __init__(self, flights: Sequence, priors: dict[str, Prior],
                 entries: list[Entry], bounds: dict[str, tuple[float, float]] | None = None,
                 far: frozenset[str] = frozenset(), alpha: float = 0.05,
                 curved: frozenset[str] = frozenset(), varying: dict[str, float] | None = None,
                 kept: frozenset[str] = frozenset(), clock: str = ''):
        self.flights, self.names, self.entries = list(flights), list(priors), list(entries)
        self.real = len(priors)
        priors = self._late({**priors, **self._repeat(priors, varying or {})}, clock)
        names = self.names
        self.narrow, self.typical, self.flight = (np.array(
            [getattr(priors[name], kind) for name in names])
            for kind in ('narrow', 'typical', 'flight'))
        self.bounds = np.array([(bounds or {}).get(name, (-np.inf, np.inf)) for name in names])
        self.kept = np.array([name in kept for name in names])
        self.index = {name: k for k, name in enumerate(names)}
        self._generic()
        self.filters: list = [None] * len(self.flights)     # (C, L) of each flight
        # bands and channels without motion, and those in which commands balance other forces
        self.still: list = [[] for _ in self.flights]
        self.balanced: list = [[] for _ in self.flights]
        self._last: dict = {}       # flight -> point and linear model
        self._phi: dict = {}        # flight -> its filters, and spectrum of the discrepancy
        kinds = [c.split('_')[0] for c in self.channels]
        kinds = ['body' if kind in ('force', 'torque') else kind for kind in kinds]
        self.groups = [np.array([k for k, own in enumerate(kinds) if own == kind])
                       for kind in dict.fromkeys(kinds)]
        self.owner = np.zeros(self.known, dtype=int)
        for k, entry in enumerate(self.entries):
            self.owner[[self.index[key] for key in entry.keys]] = k
        self.alpha = alpha
        self.far = np.array([name in far for name in self.names[:self.known]])
        self.curved = np.array([name in curved for name in self.names[:self.known]])

    def _repeat(self, priors, varying):
        """
        Entries of what may differ from flight to flight, with a key for each flight.

        A key of a sensor either has one value in all flights, or one value a flight. The second
        is an entry beside the first, so that a difference between flights is not named.
        """
        # (flight, index of the key, index of its value in this flight)
        self.repeats: list[tuple[int, int, int]] = []
        more: dict[str, Prior] = {}
        if len(self.flights) < 2:
            return more
        for entry in [e for e in self.entries if set(e.keys) <= set(varying)]:
            own = []
            for k in range(len(self.flights)):
                for key in entry.keys:
                    own.append(f'{key}#{k}')
                    self.repeats.append((k, self.names.index(key), len(self.names)))
                    self.names.append(own[-1])
                    more[own[-1]] = Prior(SAME * varying[key], varying[key], 0.0)
            self.entries.append(replace(entry, keys=tuple(own), varying=True))
        return more

    def _late(self, priors, clock):
        """
        Keys of the answer of feedback: forces and torques that are late, in each group of bands.

        In a band, feedback is a complex factor between the residual and what the commands cause.
        Its real part looks like a factor of thrust or mass. Its imaginary part looks like late
        inputs of the body equations; ``clock`` is the key that shifts all of them.
        """
        self.late = {}      # column -> key and channels of its slopes
        for kind in (('force', 'torque') if clock else ()):
            own = [c for c, name in enumerate(self.flights[0].channels) if name.startswith(kind)]
            self.late[len(self.names)] = self.names.index(clock), own
            self.names.append(f'late {kind}')
            priors = priors | {self.names[-1]: Prior(1e-3 * priors[clock].typical, TURN, 0.0)}
        return priors

    def _at(self, k, theta):
        """(R,) values of the real keys in flight k at all keys (K,)."""
        values = theta[:self.real].copy()
        for flight, key, own in self.repeats:
            if flight == k:
                values[key] += theta[own]
        return values

    def _generic(self):
        """Keys of the generic discrepancy: weights of features, by rotors and by world forces."""
        self.channels = self.flights[0].channels
        self.generic = discrepancies(self.flights)
        sources, count = self.generic[0].shape[2:]
        self.known = len(self.names)
        index = self.known + np.arange(sources * count).reshape(sources, count)
        self.weights = [index[:4].ravel(), index[4:].ravel()]   # share one power each
        self.names += [f'{kind}.{k}' for kind in range(sources) for k in range(count)]
        size = index.size
        self.narrow = np.concatenate([self.narrow, np.full(size, RELEVANT / np.sqrt(count))])
        self.start = self.narrow.copy()
        self.typical = np.concatenate([self.typical, np.zeros(size)])
        self.flight = np.concatenate([self.flight, np.zeros(size)])

    def _whiten(self, theta, etas):
        """Make the filters of these flights, and one for others, at a point; spectra there."""
        self._settle(theta, etas)
        self._learn(spectra := self._spectra(theta, etas))
        self.filters = [self._filter(s, s.noise) for s in spectra]
        self.common = self._filter(max(spectra, key=lambda s: s.band[-1]), pooled(spectra))
        spectra = self._spectra(theta, etas)
        self._find_motion(spectra, theta, etas)
        return spectra

    def without_motion(self, *more: list) -> list[str]:
        """Groups of channels that show only means in every flight, or ``more`` bands."""
        found = [[*chain(*lists)] for lists in zip(self.still, *more, strict=True)]
        return [kind for kind, own in self._in_loop()
                if all({band for band, each in still if each == own} >= {*DYNAMIC}
                       for still in found)]

    def _in_loop(self):
        """Kinds of channels with noise that reaches the commands, and their indices."""
        found = {kind: [c for c, name in enumerate(self.channels) if name.startswith(kind)]
                 for kind in IN_LOOP}
        return [(kind, own) for kind, own in found.items() if own]

    def _find_motion(self, spectra, theta, etas):
        """
        Find bands and channels of each flight in which noise hides the motion, but for the mean.

        A controller at rest answers noise. Then motion and commands correlate with the noise of
        the sensors, and a fit takes the answer for the robot. Where IMU and MoCap show that the
        robot turns, what the model leaves is no noise, and counts. Joints may rest there, and
        the noise of their readings, which is known, hides them. Where the commands of a table are
        large and the acceleration is not, they balance a torque by the motion. It is known there.
        What acts by commands is not: less of everything would be less of their noise.
        """
        fit, equations = self._learn(spectra)
        self.still, self.balanced = [], []
        for k, (flight, each) in enumerate(zip(self.flights, spectra, strict=True)):
            values = dict(zip(self.names, self._at(k, theta + etas[k]), strict=False))
            whole = self.transformed(k, flight.measured(values)).residual
            rest = each.at(fit + equations.of_flight(k, fit))
            bands = {kind: self._hidden(each, own, rest, whole) for kind, own in self._in_loop()}
            balanced: list[int] = []
            if not flight.turning:      # what the model lacks is more than the noise
                bands = {kind: bands.get(kind, []) for kind in flight.fed_back}
                if 'force' not in bands:
                    balanced, bands['torque'] = self._balanced(each, rest, bands['torque'])
            elif len(bands[flight.turning]) < len(DYNAMIC):
                bands |= dict.fromkeys(('force', 'torque', 'joint'), [])
            if flight.turning:      # its answer biases gains by less than servos differ
                noise = self.transformed(k, flight.encoder_noise()).residual
                bands['joint'] = sorted({*bands['joint'], *self._hidden(
                    each, dict(self._in_loop())['joint'], noise, whole,
                    flight.p.tolerance_lag**2)})
            self.still.append([(band, own) for kind, own in self._in_loop()
                               for band in bands.get(kind, [])])
            self.balanced.append([(band, own) for kind, own in self._in_loop()
                                  if kind == 'torque' for band in balanced])

    def _balanced(self, spectrum, rest, hidden):
        """Bands of the ``hidden`` ones in which commands balance torques, and the others."""
        own = dict(self._in_loop()).get('torque', [])
        if DRIVES not in self.names or not own:
            return [], hidden
        caused = self._hidden(spectrum, own, rest, spectrum.by(self.names.index(DRIVES)))
        balanced = [band for band in hidden if band not in caused]
        # rotors scatter, so that means of torques show nothing beside such bands alone
        alone = [0] if balanced and len(hidden) == len(DYNAMIC) else []
        return balanced, alone + [band for band in hidden if band in caused]

    def _hidden(self, spectrum, own, rest, whole, most=1 - MOVED):
        """Bands in which ``rest`` is more than this share of the channels ``own`` of ``whole``."""
        powers = [[float((x[:, spectrum.band == band][..., own]**2).sum()) for x in (rest, whole)]
                  for band in DYNAMIC]
        return [band for band, (a, b) in zip(DYNAMIC, powers, strict=True) if a >= most * b]

    def _filter(self, spectrum, noise):
        power = np.diagonal(noise, axis1=1, axis2=2)[:spectrum.band[-1] + 1]
        return whitening(power, self.flights[0].period)

    def _linearised(self, theta, etas, before, made=None):
        """Spectra at a point, or ``made`` ones; their noise begins at that of those ``before``."""
        self._settle(theta, etas)
        self.acting, self.point = self.curved & (theta[:self.known] == 1), theta
        spectra = made or self._spectra(theta, etas)
        other = [k for k, name in enumerate(self.names[:self.known]) if name != BY_MOTION]
        for each, still, balanced, eta in zip(
                spectra, self.still, self.balanced, etas, strict=True):
            each.hidden = still
            each.forget(other, balanced, theta + eta)
        self.narrow[self.known:] = self.start[self.known:]
        for each, last in zip(spectra, before, strict=True):
            each.noise = last.noise
        self._learn(spectra, 2)
        return spectra

    def _restarted(self, theta, etas, spectra):
        """
        The point ``theta``, with starts moved to their fitted values, or a part of the way there.

        A secant is valid up to its start, and a slope for typical sizes. If the step is larger,
        a ``part`` of it is made: smaller ones are tried as long as less is left of the flights.
        """
        step = theta - self.point
        step[:self.known][self.curved] = 0.0
        acts = theta[:self.known][self.curved].any()
        self.part = STEPS[0]
        if not acts and (np.abs(step) <= self.typical)[:self.known].all():
            return theta
        starts, points = self.flights[0].starts if acts else {}, []
        fitted = dict(zip(self.names, theta[:self.known], strict=False))
        before = {name: dict(start) for name, start in starts.items()}
        for part in STEPS:
            starts.update({name: dict(start) for name, start in before.items()})
            at = theta - (1 - part) * step
            for name, value in (self.flights[0].restart(fitted, part) if acts else {}).items():
                at[self.index[name]] = value
            left = sum(self._left(k, at + eta, found) for k, (eta, found) in enumerate(
                zip(etas, spectra, strict=True)))
            points.append((left, part, at, {name: dict(start) for name, start in starts.items()}))
            if left > min(point[0] for point in points):
                break
        _, self.part, theta, moved = min(points, key=lambda point: point[0])
        starts.update(moved)
        self._last.clear()      # was made at the starts before
        return theta

    def _left(self, k, theta, found):
        """Whitened power of flight k at ``theta`` (K,), with the noise that was ``found``."""
        values = dict(zip(self.names, self._at(k, theta), strict=False))
        rest = self.transformed(k, self.flights[k].linear(values, []).residual)
        rest.noise = found.noise
        return rest.power()

    def transformed(self, k: int, series: np.ndarray) -> Spectrum:
        """Coefficients of a series (N, C) as those of the residual of flight k."""
        return self._spectrum(self.flights[k], series, np.zeros((*series.shape, 0)),
                              self.filters[k])

    def _spectrum(self, flight, residual, slopes, filters):
        floor = np.array([FLOORS[c.split('_')[0]] for c in flight.channels])
        return spectrum(residual, slopes, flight.mask, flight.period, floor, flight.highest,
                        self.groups, filters)

    def _spectra(self, theta, etas, fitted=True):
        """Spectra of the flights; the keys of each flight are those of the ``fitted`` ones."""
        spectra, every = [], list(range(len(self.channels)))
        for k, (flight, eta, phi, own) in enumerate(zip(
                self.flights, etas, self.generic, self.filters, strict=True)):
            at = self._at(k if fitted else -1, theta + eta)
            linear = self._linear(flight, at)
            shape = linear.residual.shape
            if self._phi.get(flight, (None,))[0] is not own or own is None:
                self._phi[flight] = own, self._spectrum(
                    flight, np.zeros(shape), -phi.reshape(*shape, -1), own)
            moved = np.flatnonzero(at)      # few; the residual is linear about the robot file
            residual = linear.residual - linear.slopes[..., moved] @ at[moved]
            found = self._spectrum(flight, residual, linear.slopes, own)
            spectra.append(found.joined([(column, key, rows) for at_flight, column, key, rows in (
                *((f, c, key, every) for f, key, c in self.repeats if fitted),
                *((k, c, key, rows) for c, (key, rows) in self.late.items()))
                if at_flight == k], self._phi[flight][1], self.known))
        return spectra

    def others(self, flights: Sequence, theta: np.ndarray) -> tuple[list, bool]:
        """Spectra of flights at ``theta`` (K,), common filter; whether they are the fitted."""
        keep, fitted = (self.flights, self.generic, self.filters), list(flights) == self.flights
        self.flights, self.filters = list(flights), [self.common] * len(flights)
        self.generic = discrepancies(self.flights)
        spectra = self._spectra(theta, np.zeros((len(flights), len(self.names))), fitted)
        self.flights, self.generic, self.filters = keep
        return spectra, fitted

    def _linear(self, flight, at):
        """Linear model of a flight at real keys; the last one is kept."""
        point, linear = self._last.get(flight, (None, None))
        if point is None or not np.array_equal(point, at):
            linear = flight.linear(dict(zip(self.names, at, strict=False)),
                                   self.names[:self.real])
            self._last[flight] = at, linear
        return linear

    def _settle(self, theta, etas):
        for k, (flight, eta) in enumerate(zip(self.flights, etas, strict=True)):
            at = self._at(k, theta + eta)
            if not np.array_equal(self._last.get(flight, (None, None))[0], at):
                flight.settle(dict(zip(self.names, at, strict=False)))

    def _learn(self, spectra, passes=8):
        """
        Learn noise and discrepancy around a fit in which every key may be far from the file.

        Returns:
            (K,) this fit and its normal equations.

        """
        wide = np.hypot(self.narrow, np.concatenate([np.where(self.far, FREE, 1), np.zeros(
            len(self.names) - self.known)]) * self.typical)
        for _ in range(passes):
            equations = normal(spectra, self.names, self.flight, whole=True)
            # in units of the priors, so that the sum is well conditioned
            covariance = wide[:, None] * np.linalg.inv(
                wide[:, None] * equations.info * wide + np.eye(len(wide))) * wide
            theta = covariance @ equations.right
            for own in self.weights:
                # each weight has its own power, with the median of its kind as one observation
                power = theta[own]**2 + np.diag(covariance)[own]
                self.narrow[own] = wide[own] = np.sqrt(0.5 * (power + np.median(power)))
            prior = pooled(spectra)
            for k, each in enumerate(spectra):
                own, inner, left, right = equations.flights[k]
                x = theta + equations.of_flight(k, theta)
                # theta + eta, eta = a - b theta + its own scatter
                move = np.eye(len(theta))
                move[own] -= inner @ left
                total = move @ covariance @ move.T
                total[np.ix_(own, own)] += inner
                each.learn(x, total, prior, weight=len(each.noise[0]) + 2.0)
        return theta, equations
