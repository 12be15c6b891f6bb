"""
Slow balance of torques, for flights without gyroscope.

The mean torque of a block about roll and pitch must agree with the difference of the rates at its
ends, which the attitude shows, whatever a feedback does: y_f = A_f (theta + eta_f) + e_f. All
flights can be of one session, so the scatter of rotors between sessions is part of ``theta``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from math import log

import numpy as np
from scipy.special import chdtri

from beetle_omni_ros.identify.flights.evidence import least_size, Posterior, SCALES
from beetle_omni_ros.identify.flights.keys import entries_of, keys_of, prior_of
from beetle_omni_ros.model.parameters import RobotParameters

SLOW = {'rotor_thrust_coefficient', 'rotor_hub_moment', 'centre_of_mass'}
SESSION = 0.035     # of a rotor's thrust between sessions: 0.3 g, normal flights of CrazyPAD
FREEDOM = 9         # of this scatter, four flights and three axes: its prior is a Student's t
SCATTER = SESSION * np.sqrt(FREEDOM / chdtri(FREEDOM, (np.arange(8)[::-1] + 0.5) / 8))


class Balance:
    """Evidence of single entries; for results it is engine, solution and judge in one."""

    def __init__(self, parts: Sequence[tuple[np.ndarray, np.ndarray]], robot: RobotParameters):
        """Weigh all; a part has (B, 2) means of a flight and (B, 2, K) slopes by the keys."""
        # torques are linear in the scales of rotors, not in their logarithms
        self.keys = {n: replace(key, relative=False) for n, key in keys_of(robot, SLOW).items()}
        self.names = list(self.keys)
        self.index = {name: k for k, name in enumerate(self.names)}
        self._rotors, hub = (np.array([key.effect == name for key in self.keys.values()])
                             for name in ('rotor_thrust_coefficient', 'rotor_hub_moment'))
        unit = np.where(self._rotors, [key.base for key in self.keys.values()], 1.0)
        self.entries = entries_of(keys_of(robot, SLOW - {'rotor_hub_moment'}))
        priors = [prior_of(robot, key, 0.0, 0.0) for key in self.keys.values()]
        self.narrow, self.typical, flight = np.array(
            [[s.narrow, s.typical, s.flight] for s in priors]).T
        self.narrow[hub] += SCALES[-1] * self.typical[hub]
        # scatter of the means about a constant of each flight and the free hub moment
        y, slope = (np.concatenate([(x - x.mean(axis=0)).ravel() for x in xs]) for xs in (
            [y for y, _ in parts], [slopes[..., hub.argmax()] for _, slopes in parts]))
        left = y - slope * (slope @ y) / (slope @ slope)
        self.noise = left @ left / (len(y) - 2 * len(parts) - 1)
        self.info, self.right = np.zeros((len(hub), len(hub))), np.zeros(len(hub))
        for y, slopes in parts:
            a = slopes.reshape(y.size, -1) / unit
            inverse = np.linalg.inv(a * flight**2 @ a.T + self.noise * np.eye(y.size))
            self.info += a.T @ inverse @ a
            self.right += a.T @ inverse @ y.ravel()
        flat = robot.rotors.positions * [1, 1, 0]
        self._places = flat / np.linalg.norm(flat, axis=1, keepdims=True)
        self.judge, self.banned, self.unsteady = self, dict[int, float](), dict[int, float]()
        sets: list[tuple[int, ...]] = [(), *((k,) for k in range(len(self.entries)))]
        density = {chosen: self.posterior(self.indices(chosen)).gain for chosen in sets}
        self.gains = {chosen: value - density[()] for chosen, value in density.items()}
        self.best = max(sets, key=self.gains.__getitem__)
        self.e_value = float(np.logaddexp.reduce([self.gains[chosen] for chosen in sets[1:]]))

    def indices(self, chosen: Sequence[int]) -> list[int]:
        """Indices of the keys of some entries."""
        return [self.index[key] for k in chosen for key in self.entries[k].keys]

    def gain(self, judge: Balance, one: tuple[int, ...], other: tuple[int, ...]) -> float:
        """Ln of the probability of one set of entries over that of another."""
        return self.gains[one] - self.gains[other]

    def least(self, index: list[int], evidence: float) -> float:
        """Typical sizes of keys that have this mean ``evidence``, with a normal scatter."""
        prior = np.diag(1 / (self.narrow**2 + (SESSION * self._rotors)**2))
        known = self.info - self.info @ np.linalg.inv(self.info + prior) @ self.info
        ratio = self.typical[index][:, None] * known[np.ix_(index, index)] * self.typical[index]
        return least_size(ratio, evidence, SCALES[:1])

    def _shapes(self, own):
        """Prior covariances (K, K) of an entry: a load is fixed anywhere, or below a rotor."""
        root = np.diag(np.isin(np.arange(len(self.typical)), own) * self.typical)
        arms = [root[:, own] @ place for place in self._places] if len(own) > 1 else []
        return [root**2, *(np.outer(arm, arm) for arm in arms)]

    def posterior(self, index: Sequence[int]) -> Posterior:
        """Ln of the evidence of the keys of an entry, up to a constant, and their estimate."""
        own, fits = sorted(index), []
        slabs = [scale**2 * shape for shape in self._shapes(own) for scale in SCALES]
        for scatter, slab in product(SCATTER, slabs):
            prior = np.diag(self.narrow**2 + (scatter * self._rotors)**2) + slab
            covariance = np.linalg.inv(self.info + np.linalg.inv(prior))
            theta = covariance @ self.right
            fits.append((0.5 * (self.right @ theta + np.linalg.slogdet(covariance)[1]
                                - np.linalg.slogdet(prior)[1]), theta,
                         covariance[np.ix_(own, own)]))
        density, mean, inner = (np.array(column) for column in zip(*fits, strict=True))
        total = np.logaddexp.reduce(density)
        weight = np.exp(density - total)
        theta = weight @ mean
        apart = (mean - theta)[:, own]
        covariance = np.tensordot(weight, inner, 1) + (apart.T * weight) @ apart
        # rotors, a load anywhere and a load below each rotor are equally likely
        count = len(self.entries) + len(self._places) if own else 1
        total -= log(count * len(SCATTER) * len(SCALES))
        return Posterior(float(total), theta, theta[own], covariance)
