"""How sure the numbers are, what these data could have shown, and what they cannot tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from beetle_omni_ros.identify.gap.candidates import Candidate
from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.residual import THIN
from beetle_omni_ros.identify.gap.series import matrices
from beetle_omni_ros.robot.effects import CATALOGUE

MODEL_ERROR = 0.005     # of a value: no form is exact
BUS_DELAY = 0.002       # [s] that commands may differ by, when asking what could be seen
LEAST_SCALE = 0.3       # of the variance, where a floor made the data look noisier than they are


def deviations(problem: Problem, state: State, names: list[str],
               free: frozenset[str]) -> dict[str, float]:
    """
    Half widths of 95 % intervals.

    The larger of two: noise and beliefs through the curvature of the objective, and the
    scatter between blocks of the flights, which needs no noise model.
    """
    columns = [state.index[name] for name in names]
    s = state.slopes[:, columns]
    data = s.T @ s
    belief = np.zeros(len(names))
    for k, name in enumerate(names):
        if name in problem.beliefs and name not in free:
            belief[k] = problem.beliefs[name].slope(state.theta.get(name, 0.0))**2
    scale = 1 / np.sqrt(np.maximum(np.diag(data) + belief, 1e-12))
    inverse = np.linalg.inv((data + np.diag(belief)) * scale[:, None] * scale
                            + 1e-10 * np.eye(len(names))) * scale[:, None] * scale
    weights = (s**2).sum(axis=0)
    widths = {}
    blocks = [problem.block == b for b in range(problem.blocks)]
    scores = np.array([s[rows].T @ state.r[rows] for rows in blocks])
    for k, name in enumerate(names):
        level = max(LEAST_SCALE, float((s[:, k]**2 * state.r**2).sum() / max(weights[k], 1e-12)))
        a = inverse[k]
        curvature = level * float(a @ data @ a) + float((a * a * belief).sum())
        scatter = float(((scores @ a)**2).sum()) * len(blocks) / max(len(blocks) - 1, 1) \
            if len(blocks) > 1 else 0.0
        factor = student.ppf(0.975, max(len(blocks) - 1, 1)) if scatter > curvature else 1.96
        x = state.theta.get(name, 0.0)
        widths[name] = factor * np.sqrt(max(curvature, scatter)) + MODEL_ERROR * abs(x)
    return widths


def liveliness(problem: Problem) -> float:
    """
    How far accelerations exceed what no known effect explains, on the axis where they do most.

    Near 1 or below, the robot moves because it is pushed, and its controller's commands answer
    the push: thrust, speed and rate of turn then go with the push, and a fit takes that for an
    effect of theirs (a thrust too weak, a negative inflow). Only a motion that somebody planned
    is independent of what disturbs it.
    """
    moved = []
    for model in problem.models:
        force, _, turning = model.signals.imu({})
        rotation = matrices(model.signals.pose({})[1])
        both = np.concatenate([np.einsum('nij,nj->ni', rotation, force), turning], axis=1)
        moved.append(model.filters['B'](both[::THIN]).var(axis=0))
    noise = problem.noise.spread['B']
    # Axes of the world against axes of the body: the mean over the three.
    level = np.repeat([(noise[:3]**2).mean(), (noise[3:]**2).mean()], 3)
    return float(np.sqrt((np.mean(moved, axis=0) / level).max()))


@dataclass(frozen=True)
class Visibility:
    """
    What the data could show of one candidate.

    Attributes:
        sigma: of a realistic effect beside everything that is believed.
        rivals: name -> sigma that is left beside that rival alone.

    """

    sigma: float
    rivals: dict[str, float]


def visibility(problem: Problem, state: State, always: list[str],
               candidates: list[Candidate]) -> dict[str, Visibility]:
    """Label -> what the data could show of each candidate with slopes at its neutral value."""
    s = state.slopes
    data = s.T @ s
    keys, index = problem.keys, state.index
    base = np.array([index[name] for name in always])
    # Where a belief says nothing within a range, a realistic effect may well lie outside.
    prior = np.array([problem.beliefs[name].slope(state.theta.get(name, 0.0))**2
                      if not name.startswith('base.') else BUS_DELAY**-2 for name in always])

    def left(own, also):
        """Information on ``own`` beside what is believed and ``also``."""
        mask = np.array([name not in own for name in always])
        other = np.concatenate([base[mask], [index[n] for n in also if n not in own
                                             and n not in np.array(always)[mask]]]).astype(int)
        loose = set(also)
        weight = np.concatenate([
            [0.0 if n in loose else w for n, w, m in zip(always, prior, mask, strict=True) if m],
            np.zeros(len(other) - int(mask.sum()))])
        mine = [index[n] for n in own]
        cross = data[np.ix_(other, mine)]
        inner = data[np.ix_(other, other)] + np.diag(weight + 1e-9)
        schur = data[np.ix_(mine, mine)] - cross.T @ np.linalg.solve(inner, cross)
        size = np.array([keys[n].typical for n in own])
        return np.sqrt(max(float(np.max(size**2 * np.diag(schur))), 0.0))

    smooth = [c for c in candidates if not c.starts and not c.fixed]
    made = {}
    for c in smooth:
        rivals = {}
        for o in smooth:
            if o.name in _rivals_of(c) and o.label != c.label:
                rivals[o.label] = left(c.keys, o.keys)
        made[c.label] = Visibility(left(c.keys, ()), rivals)
    return made


def _rivals_of(candidate):
    return CATALOGUE[candidate.name].confused_with
