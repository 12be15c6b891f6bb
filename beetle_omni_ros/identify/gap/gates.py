"""Criteria of acceptance beside the gain: held-out blocks, closed-loop bias, physical bounds."""

import numpy as np

from beetle_omni_ros.identify.gap.bands import differs_between_bands, project_out
from beetle_omni_ros.identify.gap.candidates import Found, Trial
from beetle_omni_ros.identify.gap.fit import HALVINGS, Problem, State
from beetle_omni_ros.identify.gap.keys import delays_of, Key, LIMITS
from beetle_omni_ros.identify.gap.parameters import GapParameters
from beetle_omni_ros.identify.inference.blocks import HeldOut
from beetle_omni_ros.robot.effects import CATALOGUE

COMMANDS = delays_of('tilt', 'thrust')


def significant(p: GapParameters, gain: float, prior_gain: float, price: float = 0.0) -> bool:
    """
    Whether a gain is too large to be chance.

    ``prior_gain`` is the part of the gain in the priors. Keys beyond the first have a ``price``.
    """
    return gain >= p.least_gain + price or significant_in_prior(p, gain, prior_gain, price)


def significant_in_prior(p: GapParameters, gain: float, prior_gain: float,
                         price: float = 0.0) -> bool:
    """
    Whether the gain in the priors alone is significant; arguments as of :func:`significant`.

    A gain in the data may be closed-loop bias by gusts. A gain in the priors means that tolerances
    would otherwise exceed those of real robots. It is not noise, so a smaller gain suffices.
    """
    return min(gain, prior_gain) >= p.least_believed + price


def at_bound(keys: dict[str, Key], trial: Trial, delays: tuple[float, ...] = (),
             early: float = 0.0) -> bool:
    """
    Whether a value is at its bound or physically impossible.

    Zero is a valid bound of an effect of one sign: the robot lacks an effect of the robot file.
    A reading must not be younger than its stamp. A command must not act before its stamp: its
    ``delays`` [s] with these deviations must exceed ``-early`` [s].
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


def confirmed(trial: Trial, p: GapParameters) -> bool:
    """Whether held-out blocks confirm a trial; see :func:`cross_validate`."""
    held = trial.held
    sure = held.total >= p.held_out_errors * held.error \
        or held.positive >= p.held_out_nearly_all and (
            trial.gain >= p.least_uneven or trial.prior_gain >= p.least_believed)
    return sure and held.total >= p.held_out_share * trial.gain \
        and held.positive >= p.held_out_blocks \
        and held.without_best >= max(p.elsewhere_share * min(held.total, trial.gain),
                                     p.least_elsewhere)


def same_response(found: Found, own: str, other: str, least: float) -> bool:
    """
    Whether two entries approximate one response that neither describes completely.

    Example: a lag of second order, if the catalogue has only dead time and a lag of first order.
    Then ``other`` still gains beside the accepted ``own``, at least ``least`` in chi2, and the
    data do not determine which one is wrong.
    """
    beside = found.trials.get(other)
    return CATALOGUE[own].same_response == other and beside is not None and beside.gain > least \
        and beside not in found.accepted


def closed_loop_bias(problem: Problem, trial: Trial, point: State, involved: list[str],
                     free: frozenset[str]) -> bool:
    """
    Whether a trial that acts on body forces alone may be closed-loop bias by gusts.

    ``point`` is its fit; ``involved`` and ``free`` are those of the fit without the entry.
    """
    c = trial.candidate
    if not c.acts_on_body_only(problem.keys):
        return False
    others = [name for name in involved if name not in c.keys]
    slopes, r = project_out(problem, point, others, point.slopes[
        :, [point.index[name] for name in c.keys]], free)
    return differs_between_bands(problem, slopes, r - slopes @ [
        trial.theta.get(name, 0.0) for name in c.keys], trial.gain)


def cross_validate(problem: Problem, trial: Trial, point: State, without: State,
                   involved: list[str], free: frozenset[str]) -> None:
    """
    Set ``trial.held``: gains on each block, with all keys fitted to the other blocks.

    ``point`` is the trial's fit, ``without`` the best fit without the entry, with the keys
    ``involved``. ``point`` with the candidate's keys at zero would be too far from its own fit for
    a linear prediction.
    """
    c = trial.candidate
    with_it = list(dict.fromkeys([*involved, *c.keys]))
    others = [name for name in with_it if name not in c.keys or name in problem.priors]
    trial.held = HeldOut(
        _held_out_costs(problem, without, others, free)
        - _held_out_costs(problem, point, with_it, free | set(c.keys), c.name in LIMITS))


def _held_out_costs(problem, at, names, free, nonlinear=False):
    """Objective (blocks,) on each block of a fit to the others; ``nonlinear``: by the residual."""
    s = at.slopes[:, [at.index[name] for name in names]]
    parts = [(s[rows].T @ s[rows], s[rows].T @ at.r[rows], float(at.r[rows] @ at.r[rows]))
             for rows in (problem.block == b for b in range(problem.blocks))]
    total = [sum(part[k] for part in parts) for k in range(3)]
    costs = []
    for block, (h, g, chi2) in enumerate(parts):
        step, _ = problem.solve(at.theta, names, free, total[0] - h, total[1] - g,
                                total[2] - chi2)
        if nonlinear:
            costs.append(_cost_after_step(problem, at, names, free, step, problem.block == block))
            continue
        prior = problem.prior_cost(problem.moved(at.theta, names, step), free)
        costs.append(chi2 + 2 * g @ step + step @ h @ step + prior / problem.blocks)
    return np.array(costs)


def _cost_after_step(problem, at, names, free, step, rows):
    """
    Objective on ``rows`` after a step, by the residual itself.

    A limit that acts mostly in one block is undetermined without it, so a linear prediction is
    useless. The step is halved until the other rows gain.
    """
    def objective(theta, r, some):
        return float(r[some] @ r[some]) + problem.prior_cost(theta, free)

    theta, r = at.theta, at.r
    before = objective(theta, r, ~rows)
    for halving in range(HALVINGS):
        moved = problem.moved(at.theta, names, 0.5**halving * step)
        there = problem.residual(moved)
        if objective(moved, there, ~rows) <= before:
            theta, r = moved, there
            break
    return float(r[rows] @ r[rows]) + problem.prior_cost(theta, free) / problem.blocks
