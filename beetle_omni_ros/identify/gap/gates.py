"""What a step of the search must pass beside its gain: blocks left out, gusts, physical bounds."""

from __future__ import annotations

import numpy as np

from beetle_omni_ros.identify.gap.bands import aside, in_part_alone
from beetle_omni_ros.identify.gap.candidates import Found, Trial
from beetle_omni_ros.identify.gap.fit import HALVINGS, Problem, State
from beetle_omni_ros.identify.gap.keys import delays_of, Key, LIMITS
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.inference.blocks import HeldOut
from beetle_omni_ros.robot.effects import CATALOGUE

COMMANDS = delays_of('tilt', 'thrust')


def enough(p: GapParameters, gain: float, of_beliefs: float, price: float = 0.0) -> bool:
    """
    Whether a step gains enough to be no chance.

    Args:
        p: parameters.
        gain: of the objective.
        of_beliefs: part of it.
        price: of numbers beyond the first.

    """
    return gain >= p.least_gain + price or believed(p, gain, of_beliefs, price)


def believed(p: GapParameters, gain: float, of_beliefs: float, price: float = 0.0) -> bool:
    """
    Whether what a step gains is of beliefs, and enough of it.

    What data gain may be gusts and the answers to them. Beliefs gain where tolerances would have
    to be farther off than robots are: that is no noise, and less of it says as much.

    Args:
        p: parameters.
        gain: of the objective.
        of_beliefs: part of it.
        price: of numbers beyond the first.

    """
    return min(gain, of_beliefs) >= p.least_believed + price


def at_bound(keys: dict[str, Key], trial: Trial, delays: tuple[float, ...] = (),
             early: float = 0.0) -> bool:
    """
    Whether a number is as far off as it can be.

    An effect of one sign may end at zero: the flights lack what the file has. Readings that would
    be younger than their stamps are beyond it, and so are commands that would act before theirs.

    Args:
        keys: by name.
        trial: with its numbers.
        delays: from the stamps of tilt and thrust commands until they act, with them [s].
        early: that a command may act before its stamp [s].

    """
    if any(name in COMMANDS for name in trial.candidate.keys) \
            and min(delays, default=0.0) < -early:
        return True
    for name in trial.candidate.keys:
        x, key = trial.theta.get(name, 0.0), keys[name]
        below = x <= key.low and not key.ends_at_none
        effect = CATALOGUE[key.effect]
        aged = set(effect.delays) & {'imu', 'encoders'} and not effect.own_clock
        if x >= key.high or below or aged and key.value(x) < 0:
            return True
    return False


def holds(trial: Trial, p: GapParameters) -> bool:
    """Whether blocks that were left out agree; see :func:`cross_validate`."""
    held = trial.held
    sure = held.total >= p.held_out_errors * held.error \
        or held.positive >= p.held_out_nearly_all and (
            trial.gain >= p.least_uneven or trial.believed >= p.least_believed)
    return sure and held.total >= p.held_out_share * trial.gain \
        and held.positive >= p.held_out_blocks \
        and held.without_best >= max(p.elsewhere_share * min(held.total, trial.gain),
                                     p.least_elsewhere)


def neither_holds(found: Found, own: str, other: str, least: float) -> bool:
    """
    Whether two entries are forms of one response, whose shape is neither's.

    Where one is joined and the other still gains beside it, the response has a shape that neither
    holds, such as a lag of second order, and which number is wrong is open.

    Args:
        found: with the trials beside what is accepted.
        own: name of an accepted entry.
        other: name of the entry that might be meant as well.
        least: of chi2, that the other gains beside it.

    """
    beside = found.trials.get(other)
    return CATALOGUE[own].same_response == other and beside is not None and beside.gain > least \
        and beside not in found.accepted


def fought(problem: Problem, trial: Trial, point: State, involved: list[str],
           free: frozenset[str]) -> bool:
    """
    Whether what shows in forces alone may be a controller's answers to gusts.

    Args:
        problem: flights, beliefs, noise.
        trial: fitted.
        point: of its fit.
        involved: keys of the fit without the entry.
        free: of which nothing is believed there.

    """
    c = trial.candidate
    if not c.pushes(problem.keys):
        return False
    others = [name for name in involved if name not in c.keys]
    slopes, r = aside(problem, point, others, point.slopes[
        :, [point.index[name] for name in c.keys]], free)
    return in_part_alone(problem, slopes, r - slopes @ [
        trial.theta.get(name, 0.0) for name in c.keys], trial.gain)


def cross_validate(problem: Problem, trial: Trial, point: State, without: State,
                   involved: list[str], free: frozenset[str]) -> None:
    """
    Set a trial's gain on each block left out, with all numbers fitted to the others.

    Args:
        problem: flights, beliefs, noise.
        trial: fitted.
        point: of its fit.
        without: the best fit without the entry. Not ``point`` with its keys at zero: far from its
            own fit a straight line promises more than it holds, where slopes are those of noise.
        involved: keys of that fit.
        free: of which nothing is believed there.

    """
    c = trial.candidate
    with_it = list(dict.fromkeys([*involved, *c.keys]))
    others = [name for name in with_it if name not in c.keys or name in problem.beliefs]
    trial.held = HeldOut(
        _left_out(problem, without, others, free)
        - _left_out(problem, point, with_it, free | set(c.keys), c.name in LIMITS))


def _left_out(problem, at, names, free, bent=False):
    """Objective (blocks,) on each block of a fit to the others; ``bent``: no straight line."""
    s = at.slopes[:, [at.index[name] for name in names]]
    parts = [(s[rows].T @ s[rows], s[rows].T @ at.r[rows], float(at.r[rows] @ at.r[rows]))
             for rows in (problem.block == b for b in range(problem.blocks))]
    total = [sum(part[k] for part in parts) for k in range(3)]
    costs = []
    for block, (h, g, chi2) in enumerate(parts):
        step, _, _ = problem.solve(at.theta, names, free, total[0] - h, total[1] - g,
                                   total[2] - chi2)
        if bent:
            costs.append(_reached(problem, at, names, free, step, problem.block == block))
            continue
        belief = problem.prior(problem.moved(at.theta, names, step), free)
        costs.append(chi2 + 2 * g @ step + step @ h @ step + belief / problem.blocks)
    return np.array(costs)


def _reached(problem, at, names, free, step, rows):
    """
    Objective on ``rows`` after a step, by the residual itself.

    A limit that acts in one block most is hardly known without it: there a straight line
    promises anything. The step is as long as the other rows gain by it.
    """
    def objective(theta, r, some):
        return float(r[some] @ r[some]) + problem.prior(theta, free)

    theta, r = at.theta, at.r
    before = objective(theta, r, ~rows)
    for halving in range(HALVINGS):
        moved = problem.moved(at.theta, names, 0.5**halving * step)
        there = problem.residual(moved)
        if objective(moved, there, ~rows) <= before:
            theta, r = moved, there
            break
    return float(r[rows] @ r[rows]) + problem.prior(theta, free) / problem.blocks
