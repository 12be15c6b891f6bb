"""The hierarchical fit against closed forms of linear Gaussian problems."""

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.optimize import approx_fprime, minimize
from scipy.signal import lfilter
from scipy.special import huber
from scipy.stats import multivariate_normal, norm

from beetle_omni_ros.identify.inference.hierarchy import (
    bounded_step,
    design,
    log_orthant,
    solve,
    Spread,
    WIDTH,
)
from beetle_omni_ros.identify.inference.noise import Drifting, drifting, HUBER

JOINTS, LOGS = (1, 2, 3, 1, 2, 3), (0, 0, 0, 1, 1, 1)
LABELS = {'joint': JOINTS, 'log': LOGS}
SPREADS = (Spread(1.0, {'joint': 0.3}), Spread(0.5, {'joint': 0.1, 'log': 0.2}), Spread(0.7, {}))
SIGMA, COUNT, BLOCKS = 0.5, 60, 5
CONSTANT = np.log(np.sqrt(2 * np.pi) * SIGMA)      # [nat] of the noise of a sample
BOUND = np.full(3, 1e3)
ALL = np.ones(3, dtype=bool)


class Linear:
    """Units with the signals A (U, P, n) theta plus noise of deviation SIGMA."""

    def __init__(self, seed, active=ALL):
        rng = np.random.default_rng(seed)
        t, units = np.linspace(0, 2 * np.pi, COUNT), len(JOINTS)
        phases = rng.uniform(0, 2 * np.pi, (units, 3, 1))
        self.a = np.sin(np.array([3.0, 5.0, 8.0])[:, None] * t + phases)
        self.base = np.tile([1.0, -2.0, 0.5], (units, 1))
        s = design(SPREADS, LABELS, active)
        self.truth = self.base + s @ rng.standard_normal(s.shape[2])
        self.y = np.einsum('upn,up->un', self.a, self.truth) + SIGMA * rng.uniform(
            -1.7, 1.7, (units, COUNT))
        self.block = np.arange(COUNT) * BLOCKS // COUNT

    def __call__(self, theta, active):
        r = (np.einsum('upn,up->un', self.a, theta) - self.y) / SIGMA
        return list(r), list(self.a / SIGMA)

    def fit(self, active=ALL, model=None):
        s = design(SPREADS, LABELS, np.asarray(active))
        return solve(model or self, self.base, s, np.zeros(s.shape[2]),
                     [self.block] * len(JOINTS), -BOUND, BOUND)

    def prior(self, active=ALL):
        """Covariance (U P, U P) of all parameters, from groups that units share."""
        units = len(JOINTS)
        same = {name: np.equal.outer(group, group) for name, group in LABELS.items()}
        parts = np.array([on * sum((d**2 * same[name] for name, d in spread.groups.items()),
                                   np.full((units, units), spread.common**2))
                          for spread, on in zip(SPREADS, active, strict=True)])
        return np.einsum('puv,pq->upvq', parts, np.eye(3)).reshape(3 * units, 3 * units)

    def matrix(self, rows=slice(None)):
        """Signals of all parameters (U n, U P)."""
        a = self.a[..., rows]
        units, _, count = a.shape
        return np.einsum('upn,uv->unvp', a, np.eye(units)).reshape(units * count, 3 * units)

    def conditioned(self, rows=slice(None), active=ALL):
        """Mean (U, P) and covariance (U P, U P) given samples: conditioning of a Gaussian."""
        a, c = self.matrix(rows), self.prior(active)
        y = self.y[:, rows].ravel() - a @ self.base.ravel()
        gain = c @ a.T @ np.linalg.inv(a @ c @ a.T + SIGMA**2 * np.eye(len(y)))
        return self.base + (gain @ y).reshape(self.base.shape), c - gain @ a @ c


@pytest.mark.parametrize('active', [(1, 1, 1), (1, 0, 1), (0, 1, 0), (0, 0, 0)])
def test_common_values_and_deviations_are_those_of_the_conditioned_gaussian(active):
    active = np.array(active, dtype=bool)
    problem = Linear(0, active)
    fit = problem.fit(active)
    mean, covariance = problem.conditioned(active=active)
    assert fit.theta == pytest.approx(mean, abs=2e-4)      # 1e-3 of its deviation
    own = fit.s @ np.linalg.inv(fit.information) @ fit.s.transpose(0, 2, 1)
    for u in range(len(JOINTS)):
        assert own[u] == pytest.approx(covariance[3 * u:3 * u + 3, 3 * u:3 * u + 3], abs=1e-8)


def test_a_block_is_predicted_from_the_others_with_their_uncertainty():
    problem = Linear(1)
    fit = problem.fit()
    for b in range(BLOCKS):
        out = problem.block == b
        theta, covariance = problem.conditioned(~out)
        a = problem.matrix(out)
        density = multivariate_normal.logpdf(
            problem.y[:, out].ravel(), a @ theta.ravel(),
            a @ covariance @ a.T + SIGMA**2 * np.eye(len(a)))
        assert fit.held[b] == pytest.approx(density + CONSTANT * len(a), abs=1e-3)
        assert fit.theta + fit.s @ fit.deviations[b] == pytest.approx(theta, abs=1e-4)


@pytest.mark.parametrize('active', [(1, 1, 1), (1, 0, 1), (0, 0, 0)])
def test_the_evidence_is_the_marginal_likelihood(active):
    active = np.array(active, dtype=bool)
    problem = Linear(2, active)
    a, fit = problem.matrix(), problem.fit(active)
    exact = multivariate_normal.logpdf(
        problem.y.ravel(), a @ problem.base.ravel(),
        a @ problem.prior(active) @ a.T + SIGMA**2 * np.eye(len(a)))
    assert fit.evidence == pytest.approx(exact + CONSTANT * len(a), abs=1e-4)


def bent(problem):
    """The problem with a nonlinear signal, and with outliers."""
    def model(theta, active):
        linear = np.einsum('upn,up->un', problem.a, theta)
        r = (linear + 0.1 * linear**2 - problem.y) / SIGMA
        slopes = (1 + 0.2 * linear)[:, None] * problem.a / SIGMA
        return list(r), list(slopes)
    problem.y[:, ::11] += 6 * SIGMA
    return model


def test_units_of_one_recording_may_have_different_rates():
    problem = Linear(5)
    every = [1, 2, 1, 3, 1, 2]
    fit = solve(lambda theta, active: tuple([part[..., ::k] for part, k in zip(
        parts, every, strict=True)] for parts in problem(theta, active)), problem.base,
        design(SPREADS, LABELS, ALL), np.zeros(problem.fit().x.shape),
        [problem.block[::k] for k in every], -BOUND, BOUND)
    error = (fit.theta - problem.truth) / np.sqrt(np.diagonal(fit.spread(), axis1=1, axis2=2))
    assert fit.converged and np.sqrt(np.mean(error**2)) < 2


@pytest.mark.parametrize('seed', range(4, 8))
def test_left_out_blocks_are_predicted_no_better_than_fitted_ones(seed):
    problem = Linear(seed)
    problem.y[:, ::11] += 6 * SIGMA         # the same loss for both
    fit = problem.fit()
    assert -2 * fit.held.sum() > fit.chi2


@pytest.mark.parametrize('labels', [{'log': (0,)}, {'log': (0, 1)}, {'log': (0, 0, 1, 2)}])
def test_the_prior_of_a_value_does_not_depend_on_the_number_of_groups(labels):
    s = design([Spread(0.3, {'log': 0.4})], labels, ALL[:1])
    assert (s @ s.transpose(0, 2, 1))[:, 0, 0] == pytest.approx(0.5**2)


def test_the_gradient_of_loss_and_prior_vanishes_at_the_solution():
    problem = Linear(3)
    model = bent(problem)
    fit = problem.fit(model=model)
    assert fit.converged

    def cost(x):
        residuals, _ = model(problem.base + fit.s @ x, ALL)
        return sum(huber(HUBER, r).sum() for r in residuals) + x @ x / 2

    slope, start = (approx_fprime(x, cost, 1e-6) for x in (fit.x, 0 * fit.x))
    # No value is further from the minimum than a tenth of its standard deviation.
    assert slope @ np.linalg.solve(fit.information, slope) < 0.01
    assert np.linalg.norm(slope) < 0.01 * np.linalg.norm(start)


def test_errors_that_repeat_with_the_motion_inflate_the_noise():
    """A wrong form leaves the same error in each period, so that more periods add nothing."""
    once, inflations = Linear(7), []
    once.y += SIGMA * np.sin(4 * np.linspace(0, 2 * np.pi, COUNT))
    for periods in (4, 40):
        problem = Linear(7)
        problem.a, problem.y = (np.tile(each, periods) for each in (once.a, once.y))
        problem.block = np.tile(once.block, periods)
        inflations.append(problem.fit().inflation)
    assert inflations[1] == pytest.approx(10 * inflations[0], rel=0.2)


T, RATE = 6.0, 25.0     # [s], [Hz] of recordings with drift


class Drift:
    """Zeros and two gains of four channels [mrad]; white noise and a drift of a memory [s]."""

    def __init__(self, seed, memory, zero=0.0, period=2.2):
        rng, count = np.random.default_rng(seed), int(T * RATE)
        t, fade = np.arange(count) / RATE, np.exp(-1 / RATE / memory)
        kicks = rng.standard_normal((4, 4 * count)) * np.sqrt(1 - fade**2)
        drift = lfilter([1.0], [1.0, -fade], kicks)[:, -count:]
        phase = 2 * np.pi * t / np.interp(t, [0, T], [0.8 * period, 1.2 * period])
        self.signals = np.stack([np.ones(count), 1e3 * np.sin(phase), 1e3 * np.cos(phase)])
        self.y = zero + 1.2 * rng.standard_normal((4, count)) + 1.5 * drift
        self.block = (phase % (2 * np.pi) / (2 * np.pi) * BLOCKS).astype(int)
        self.noise, self.sigma = Drifting(count), np.full(4, 2.0)
        for _ in range(2):
            fit = self.fit()
            parts = [self.signals.T @ part for part in fit.s]
            self.noise, self.sigma = drifting(
                [r - part @ fit.x for r, part in zip(fit.theta @ self.signals - self.y, parts,
                                                     strict=True)], parts, 1)
        self.sigma = self.sigma * np.sqrt(self.fit().inflation)

    def __call__(self, theta, active):
        r = (theta @ self.signals - self.y) / self.sigma[:, None]
        return list(self.noise.whitened(r.T).T), [
            self.noise.whitened(self.signals.T / sigma).T for sigma in self.sigma]

    def fit(self, zero=True):
        spreads = (Spread(0.0, {'joint': 22.0}), *[Spread(0.02, {'joint': 0.02})] * 2)
        s = design(spreads, {'joint': (1, 2, 3, 4)}, np.array([zero, True, True]))
        return solve(self, np.zeros((4, 3)), s, np.zeros(s.shape[2]), [self.block] * 4, -BOUND,
                     BOUND)


@pytest.mark.parametrize('memory', [0.5, 3.0])
def test_a_needless_zero_is_seldom_certain_under_drift(memory):
    gains = [problem.fit().evidence - problem.fit(False).evidence
             for problem in (Drift(seed, memory) for seed in range(30))]
    assert np.mean(np.array(gains) > 5) <= 0.05
    needed = [problem.fit().evidence - problem.fit(False).evidence
              for problem in (Drift(seed, memory, 10.0) for seed in range(6))]
    assert np.mean(np.array(needed) > 5) >= 0.9


def test_intervals_hold_under_a_drift_over_a_fifth_of_the_recording():
    fits = [Drift(seed, T / 5, period=0.9).fit() for seed in range(2000, 2030)]
    inside = [np.abs(fit.theta) <= WIDTH * np.sqrt(np.diagonal(fit.spread(), axis1=1, axis2=2))
              for fit in fits]
    assert (np.mean(inside, axis=(0, 1)) >= 0.9).all()


class Bounded:
    """One unit with P positive values, of which the data want ``wanted`` +- ``sd``."""

    def __init__(self, wanted, sd, correlation=0.0):
        self.wanted, size = np.array(wanted), len(wanted)
        self.root = np.linalg.inv(np.linalg.cholesky(
            sd**2 * (np.full((size, size), correlation) + (1 - correlation) * np.eye(size))))

    def __call__(self, theta, active):
        return [self.root @ (theta[0] - self.wanted)], [self.root.T]

    def fit(self):
        size = len(self.wanted)
        s = design([Spread(1.0, {})] * size, {'unit': (0,)}, np.ones(size, dtype=bool))
        return solve(self, np.zeros((1, size)), s, np.ones(size), [np.arange(size)],
                     np.zeros(size), np.full(size, 50.0))

    def density(self, *theta):
        """Likelihood times the half-normal prior."""
        r = self.root @ (np.array(theta) - self.wanted)
        return np.exp(-r @ r / 2) * np.prod(2 * norm.pdf(theta))


@pytest.mark.parametrize(('wanted', 'sd'), [
    (-2.5, 1.0), (-1.0, 1.0), (0.0, 1.0), (2.0, 1.0), (-0.25, 0.1), (0.0, 0.1), (0.15, 0.1),
    (2.0, 0.1)])
def test_the_evidence_at_a_bound_is_that_of_quadrature(wanted, sd):
    problem = Bounded([wanted], sd)
    exact, _ = quad(problem.density, 0, 6, points=[max(wanted, 0.01)], epsabs=0, limit=200)
    fit = problem.fit()
    assert fit.evidence == pytest.approx(np.log(exact), abs=1e-4) and fit.theta[0, 0] >= 0


@pytest.mark.parametrize('correlation', [0.0, 0.6, -0.6])
@pytest.mark.parametrize('wanted', [(-0.5, -0.3), (-0.4, 0.8), (1.0, 0.1)])
def test_the_evidence_of_two_values_at_a_bound_is_that_of_quadrature(wanted, correlation):
    problem = Bounded(wanted, 0.4, correlation)
    exact, _ = dblquad(problem.density, 0, 4, 0, 4, epsabs=1e-12)
    fit = problem.fit()
    assert fit.evidence == pytest.approx(np.log(exact), abs=1e-3 if not correlation else 0.15)


def test_a_step_to_bounds_is_that_of_a_general_solver():
    rng = np.random.default_rng(0)
    for _ in range(20):
        root, rows = rng.standard_normal((4, 6)), rng.standard_normal((5, 4))
        h, g, room = root @ root.T, 3 * rng.standard_normal(4), rng.uniform(0, 0.5, 5)
        step = bounded_step(h, g, rows, room)
        best = minimize(lambda d: d @ h @ d / 2 + g @ d, 0 * g, jac=lambda d: h @ d + g,
                        method='SLSQP', constraints={'type': 'ineq', 'fun': lambda d: (
                            rows @ d + room)}, options={'ftol': 1e-12})
        assert step == pytest.approx(best.x, abs=1e-4)


def test_the_probability_of_an_orthant_is_that_of_a_normal_distribution():
    rng = np.random.default_rng(0)
    for size in (1, 2, 4):
        for _ in range(5):
            root, mean = rng.standard_normal((size, 2 * size)), rng.standard_normal(size)
            covariance = root @ root.T / size
            exact = multivariate_normal.logcdf(mean, np.zeros(size), covariance,
                                               rng=np.random.default_rng(0))
            assert log_orthant(mean, covariance) == pytest.approx(exact, abs=0.02 + 0.05 * size)
