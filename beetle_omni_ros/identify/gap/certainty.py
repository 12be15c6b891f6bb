"""Confidence intervals, excitation, and detectability of effects in these data."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from beetle_omni_ros.identify.gap.bands import by_band
from beetle_omni_ros.identify.gap.candidates import Candidate
from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.keys import LIMITS
from beetle_omni_ros.identify.gap.residual import THIN
from beetle_omni_ros.identify.gap.series import matrices
from beetle_omni_ros.identify.inference.least_squares import solved
from beetle_omni_ros.identify.inference.prior import together
from beetle_omni_ros.robot.effects import CATALOGUE


def deviations(problem: Problem, state: State, names: list[str],
               free: frozenset[str]) -> dict[str, float]:
    """
    Half widths of 95 % intervals, by key, as deviations.

    The half width is the largest of four estimates: the curvature of the objective, and the
    scatter between time blocks, between frequency bands, and between weak and strong excitation.
    The last three need no noise model. The last two detect errors that are equal in all flights,
    such as closed-loop bias or a wrong form of an equation. A share for the error of the form is
    added.
    """
    columns, p = [state.index[name] for name in names], problem.p
    s = state.slopes[:, columns]
    data = s.T @ s
    prior = together(problem.priors, state.theta, names, free)[0]**2
    inverse = solved(data + np.diag(prior), np.eye(len(names)), 1e-10)
    weights = (s**2).sum(axis=0)
    widths = {}
    blocks = [problem.block == b for b in range(problem.blocks)]
    scores = np.array([s[rows].T @ state.r[rows] for rows in blocks])
    slow_to_quick = list(by_band(problem, s, state.r, 'BAWJ'))
    for k, name in enumerate(names):
        level = max(p.least_variance,
                    float((s[:, k]**2 * state.r**2).sum() / max(weights[k], 1e-12)))
        a = inverse[k]
        curvature = level * float(a @ data @ a) + float((a * a * prior).sum())
        half = max(1.96 * np.sqrt(curvature), _half_width(scores @ a, len(blocks)))
        shares = np.array([score @ a for score, _ in slow_to_quick])
        expected = level * np.array([a @ information @ a for _, information in slow_to_quick])
        if (shares**2).sum() > p.disagree * expected.sum():
            half = max(half, _half_width(shares, max(
                p.least_bands, expected.sum()**2 / max((expected**2).sum(), 1e-30))))
        if name in free:
            shares = _by_excitation(s @ a, state.r, p.excitations)
            if (shares**2).sum() > p.disagree * level * float(a @ data @ a):
                half = max(half, _half_width(shares, p.excitations))
        form = p.form_part * abs(state.theta.get(name, 0.0)) \
            + p.form_share * problem.keys[name].smallest
        widths[name] = half + form
    return widths


def _by_excitation(weight, r, groups):
    """
    Contributions (groups,) of weakly to strongly excited samples to the change of a key.

    ``weight`` (n,) is the weight of each residual in the key. Groups have equal information.
    """
    order = np.argsort(np.abs(weight))
    part = np.cumsum(weight[order]**2)
    edges = np.searchsorted(part, part[-1] * np.arange(1, groups) / groups)
    return np.array([some.sum() for some in np.split((weight * r)[order], edges)])


def _half_width(shares, count):
    """Half width of a 95 % interval from the contributions of so many parts of the data."""
    if count < 2:
        return 0.0
    return student.ppf(0.975, count - 1) * np.sqrt((shares**2).sum() * count / (count - 1))


def excitation(problem: Problem) -> float:
    """
    Ratio of accelerations and unexplained residual, on the axis with the largest ratio.

    At a ratio of about 1 or less, the motion is mostly a reaction to gusts. The controller's
    commands then correlate with the gusts, and a fit attributes the gusts to thrust, speed or rate
    (closed-loop bias). Only a planned motion is independent of disturbances.
    """
    moved = []
    for model in problem.models:
        force, _, turning = model.signals.imu({})
        rotation = matrices(model.signals.pose({})[1])
        both = np.concatenate([np.einsum('nij,nj->ni', rotation, force), turning], axis=1)
        moved.append(model.filters['B'](both[::THIN]).var(axis=0))
    noise = problem.noise.spread['B']
    # Motion is in world axes and noise in body axes, so the mean over three axes is compared.
    level = np.repeat([(noise[:3]**2).mean(), (noise[3:]**2).mean()], 3)
    return float(np.sqrt((np.mean(moved, axis=0) / level).max()))


@dataclass(frozen=True)
class Detectability:
    """
    Detectability of one candidate.

    Attributes:
        sigma: standard deviations that an effect of typical size shows beside all tolerances.
        rivals: label of a rival -> standard deviations that remain beside this rival.

    """

    sigma: float
    rivals: dict[str, float]


def detectability(problem: Problem, state: State, always: list[str],
                  candidates: list[Candidate]) -> dict[str, Detectability]:
    """Label -> detectability of each candidate that is linear at its neutral value."""
    s = state.slopes
    data = s.T @ s
    keys, index = problem.keys, state.index
    base = np.array([index[name] for name in always])
    # Priors with a flat range: a typical effect may be outside the range.
    prior = np.array([problem.priors[name].slope(state.theta.get(name, 0.0))**2
                      if not name.startswith('base.') else problem.p.bus_seen**-2
                      for name in always])

    def left(own, also):
        """Standard deviations of ``own`` beside all tolerances and free keys ``also``."""
        mask = np.array([name not in own for name in always])
        other = np.concatenate([base[mask], [index[n] for n in also if n not in own
                                             and n not in np.array(always)[mask]]]).astype(int)
        loose = set(also)
        weight = np.concatenate([
            [0.0 if n in loose else w for n, w, m in zip(always, prior, mask, strict=True) if m],
            np.zeros(len(other) - int(mask.sum()))])
        mine = np.array([index[n] for n in own])
        cross = data[np.ix_(other, mine)]
        inner = data[np.ix_(other, other)] + np.diag(weight + 1e-9)
        schur = data[np.ix_(mine, mine)] - cross.T @ np.linalg.solve(inner, cross)
        size = np.array([keys[n].typical for n in own])
        return np.sqrt(max(float(np.max(size**2 * np.diag(schur))), 0.0))

    smooth = [c for c in candidates if not c.starts and not any(c.fixed.values())]
    result = {}
    for c in smooth:
        rivals = {}
        for o in smooth:
            if o.name in CATALOGUE[c.name].confused_with and o.label != c.label:
                rivals[o.label] = left(c.keys, o.keys)
        result[c.label] = Detectability(left(c.keys, ()), rivals)
    return result


def undetectable_limits(problem: Problem, state: State) -> list[str]:
    """
    Names of limits, friction and play that these flights would not show at a typical size.

    They have no slope where they do not act, so the residual itself is compared.
    """
    undetectable = []
    for name in LIMITS:
        own = [key for key in problem.keys.values() if key.effect == name]
        # The typical size is a share by which a limit is lower, or a value of friction or play.
        theta = {key.name: float(np.log(max(1 - key.typical, 0.05))) if key.relative
                 else key.typical for key in own}
        change = problem.residual({**state.theta, **theta}) - state.r
        if np.sqrt(change @ change) < problem.p.decidable:
            undetectable.append(name)
    return undetectable
