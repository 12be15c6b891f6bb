"""
Fits of servo models to one response log, for `identify joint` and `gap LOG.csv`.

Model errors of a servo last for tenths of seconds. An autoregressive filter whitens the residuals
(generalised least squares), so that chi2 counts independent information. A Huber loss limits the
influence of outliers. A layout maps a point to parameter sets: of one joint, or of several joints
with shared parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beetle_omni_ros.identify.inference.blocks import block_masks, gradient_scatter
from beetle_omni_ros.identify.inference.least_squares import (
    Coordinates,
    covariance,
    Fits,
    huber,
    minimise,
    Steps,
)
from beetle_omni_ros.identify.inference.noise import Noise
from beetle_omni_ros.identify.inference.prior import Prior, UNKNOWN
from beetle_omni_ros.identify.joint_log import JointLog
from beetle_omni_ros.identify.parameters import shipped
from beetle_omni_ros.identify.servo_model import INDEX, NAMES, simulate, TERMS

ORDERS = 6, 40          # range of the order of the whitening filter
DIFFERENCE = 0.05       # finite difference in scales of a parameter
SCATTER_BLOCKS = 10     # blocks for the scatter of the gradient


class SingleJoint:
    """
    Layout of a point for one joint: its parameter set.

    Attributes:
        coordinates: encoding of a point (P,).
        owner: (P,) index of the only joint that a parameter changes, -1 if it changes all.
        steps: parameters of the iteration.

    """

    coordinates = Coordinates(tuple(TERMS.values()))
    owner = np.full(len(NAMES), -1)
    steps = Steps()

    def sets(self, points: np.ndarray) -> np.ndarray:
        """(M, J, len(NAMES)) parameter sets of points (M, P)."""
        return decode(points)[:, None]


SINGLE_JOINT = SingleJoint()
encode, decode = SINGLE_JOINT.coordinates.encode, SINGLE_JOINT.coordinates.decode


@dataclass(frozen=True)
class Problems:
    """
    Fits that are solved together.

    Attributes:
        joints: (B, J) indices of the log's joints.
        points: (B, P) starts, or fitted points.
        free: (B, P) mask of fitted parameters.
        weight: (B, N) weight of each sample, 0 if held out.

    """

    joints: np.ndarray
    points: np.ndarray
    free: np.ndarray
    weight: np.ndarray

    @classmethod
    def single_joints(cls, joint: np.ndarray | list[int], sets: np.ndarray, free: np.ndarray,
                      weight: np.ndarray) -> Problems:
        """Problems of single joints (B,), from parameter sets (B, n)."""
        return cls(np.asarray(joint)[:, None], encode(sets), free, weight)

    def pick(self, rows) -> Problems:
        """Some of the problems."""
        return Problems(self.joints[rows], self.points[rows], self.free[rows], self.weight[rows])

    @staticmethod
    def join(parts: list[Problems]) -> Problems:
        """All problems of several groups."""
        return Problems(*(np.concatenate([getattr(part, name) for part in parts])
                          for name in ('joints', 'points', 'free', 'weight')))


def fitted_samples(log: JointLog) -> np.ndarray:
    """(N,) weight of each sample: 0 during settling."""
    return (log.t >= log.t[0] + shipped().servo.settling).astype(float)


def first_noise(log: JointLog) -> Noise:
    """White noise for the first fit."""
    return Noise.white(len(log.joints), shipped().servo.first_noise)


def noise_around(log: JointLog, sets: np.ndarray, weight: np.ndarray) -> Noise:
    """Noise of each joint around its parameter set (J, n), from samples with a weight (N,)."""
    error = simulate(log, np.arange(len(sets)), sets) - log.measured
    order = int(np.clip(round(shipped().servo.memory / log.period), *ORDERS))
    return Noise.of(error[:, weight > 0], order, max(log.quantum, 1e-4) / np.sqrt(12))


class ServoFitter:
    """
    Solver of :class:`Problems` on one log.

    The layout of the points is :class:`SingleJoint`, or one of joints with shared parameters.
    """

    def __init__(self, log: JointLog, noise: Noise, layout=SINGLE_JOINT,
                 prior: Prior = UNKNOWN):
        self.log, self.noise, self.layout, self.prior = log, noise, layout, prior
        self._limits = layout.coordinates.low, layout.coordinates.high

    def _simulated(self, sets, joints, weight):
        """(K, N) weighted, whitened residuals with Huber loss of sets (K, n) of joints (K,)."""
        error = simulate(self.log, joints, sets) - self.log.measured[joints]
        return huber(self.noise.whiten(error, joints)) * np.sqrt(weight)

    def residuals(self, points: np.ndarray, joints: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(M, J N) weighted, whitened residuals whose sum of squares is the Huber loss."""
        sets = self.layout.sets(points)
        count = sets.shape[1]
        return self._simulated(sets.reshape(-1, sets.shape[2]), joints.ravel(),
                               np.repeat(weight, count, axis=0)).reshape(len(points), -1)

    def jacobian(self, problems: Problems, base: np.ndarray) -> np.ndarray:
        """(M, P, J N) finite differences of the residuals; 0 if not free."""
        rows, columns = np.nonzero(problems.free)
        moved = problems.points[rows].copy()
        at = np.arange(len(rows)), columns
        step = np.where(moved[at] + DIFFERENCE > self._limits[1][columns], -DIFFERENCE, DIFFERENCE)
        moved[at] += step
        sets = self.layout.sets(moved)
        # A parameter of one joint needs a simulation of that joint only.
        owner, every = self.layout.owner[columns, None], np.arange(sets.shape[1])
        index, place = np.nonzero((owner == -1) | (owner == every))
        row, base = rows[index], base.reshape(len(base), len(every), -1)
        found = self._simulated(sets[index, place], problems.joints[row, place],
                                problems.weight[row])
        slopes = np.zeros((*problems.points.shape, *base.shape[1:]))
        slopes[row, columns[index], place] = (found - base[row, place]) / step[index, None]
        return slopes.reshape(*problems.points.shape, -1)

    def solve(self, problems: Problems, iterations: int = 20) -> Fits:
        """Minimise the chi2 of each problem within the bounds."""
        return minimise(
            problems.points, problems.free, *self._limits,
            lambda points, rows: self.residuals(points, problems.joints[rows],
                                                problems.weight[rows]),
            lambda points, rows, base: self.jacobian(Problems(
                problems.joints[rows], points, problems.free[rows], problems.weight[rows]), base),
            self.prior, iterations, self.layout.steps)

    def cost(self, problems: Problems) -> np.ndarray:
        """(B,) chi2 of the points without the prior."""
        return (self.residuals(problems.points, problems.joints, problems.weight)**2).sum(axis=1)

    def covariances(self, problems: Problems) -> list[tuple[np.ndarray, float]]:
        """Covariance (P, P) of each problem's point without the prior, and scatter of chi2."""
        base = self.residuals(problems.points, problems.joints, problems.weight)
        result = []
        for slopes, r, free, weight in zip(self.jacobian(problems, base), base, problems.free,
                                           problems.weight, strict=True):
            own = covariance(slopes @ slopes.T, free)
            blocks = np.tile(block_masks(weight, SCATTER_BLOCKS), (1, problems.joints.shape[1]))
            result.append((own, gradient_scatter(slopes, r, own, blocks)))
        return result


def prior_of(centre: np.ndarray, deviations: dict[str, float]) -> Prior:
    """Prior of a joint's point about ``centre`` (n,), with deviations in units of the values."""
    spread = np.full(len(NAMES), np.inf)
    for name, deviation in deviations.items():
        spread[INDEX[name]] = deviation / TERMS[name].scale
    return Prior(spread, centre=centre)
