"""The hierarchical fit against closed forms of linear Gaussian problems."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.signal import lfilter
from scipy.special import huber
from scipy.stats import multivariate_normal

from beetle_omni_ros.identify.inference.hierarchy import design, solve, Spread, WIDTH
from beetle_omni_ros.identify.inference.robust import HUBER

JOINTS, LOGS = (1, 2, 3, 1, 2, 3), (0, 0, 0, 1, 1, 1)
LABELS = {'joint': JOINTS, 'log': LOGS}
SPREADS = (Spread(1.0, {'joint': 0.3}), Spread(0.5, {'joint': 0.1, 'log': 0.2}), Spread(0.7, {}))
SIGMA, COUNT, BLOCKS = 0.5, 60, 5
BOUND = np.full(3, 1e3)
ALL = np.ones(3, dtype=bool)


class Linear:
    """Units with the signals A (U, P, n) theta plus noise of deviation SIGMA."""

    def __init__(self, seed, active=ALL, noise=None, count=COUNT):
        rng = np.random.default_rng(seed)
        t, units = np.linspace(0, 2 * np.pi, count), len(JOINTS)
        phases = rng.uniform(0, 2 * np.pi, (units, 3, 1))
        self.a = np.sin(np.array([3.0, 5.0, 8.0])[:, None] * t + phases)
        self.base = np.tile([1.0, -2.0, 0.5], (units, 1))
        s = design(SPREADS, LABELS, active)
        self.truth = self.base + s @ rng.standard_normal(s.shape[2])
        noise = rng.uniform(-1.7, 1.7, (units, count)) if noise is None else noise(rng, units)
        self.y = np.einsum('upn,up->un', self.a, self.truth) + SIGMA * noise
        self.block = np.arange(count) * BLOCKS // count

    def __call__(self, theta, active):
        r = (np.einsum('upn,up->un', self.a, theta) - self.y) / SIGMA
        return list(r), list(self.a / SIGMA)

    def fit(self, active=ALL, model=None):
        s = design(SPREADS, LABELS, np.asarray(active))
        return solve(model or self, self.base, s, np.zeros(s.shape[2]), LOGS,
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


def white(rng, units):
    return rng.standard_normal((units, 300))


def correlated(rng, units, memory=0.8):
    """AR(1) of variance 1."""
    noise = rng.standard_normal((units, 300))
    for k in range(1, 300):
        noise[:, k] = memory * noise[:, k - 1] + np.sqrt(1 - memory**2) * noise[:, k]
    return noise


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


def test_a_block_is_predicted_from_the_others():
    problem = Linear(1)
    fit = problem.fit()
    for b in range(BLOCKS):
        out = problem.block == b
        theta, _ = problem.conditioned(~out)
        error = (np.einsum('upn,up->un', problem.a, theta) - problem.y)[:, out] / SIGMA
        assert fit.held[b] == pytest.approx((error**2).sum(), rel=1e-4)
        assert fit.theta + fit.s @ fit.deviations[b] == pytest.approx(theta, abs=1e-4)


@pytest.mark.parametrize('active', [(1, 1, 1), (1, 0, 1), (0, 0, 0)])
def test_the_evidence_is_the_marginal_likelihood(active):
    active = np.array(active, dtype=bool)
    problem = Linear(2, active)
    a, fit = problem.matrix(), problem.fit(active)
    exact = multivariate_normal.logpdf(
        problem.y.ravel(), a @ problem.base.ravel(),
        a @ problem.prior(active) @ a.T + SIGMA**2 * np.eye(len(a)))
    constant = -len(a) * np.log(np.sqrt(2 * np.pi) * SIGMA)
    assert fit.evidence(1.0) + constant == pytest.approx(exact, abs=1e-4)


def test_a_needless_parameter_lowers_the_evidence_and_a_needed_one_raises_it():
    fewer = np.array([True, False, True])
    gains = {truth: [problem.fit().evidence(1.0) - problem.fit(fewer).evidence(1.0)
                     for problem in (Linear(seed, active, white, 300) for seed in range(20))]
             for truth, active in (('needless', fewer), ('needed', ALL))}
    assert np.mean(np.array(gains['needless']) < 0) >= 0.9
    assert np.mean(np.array(gains['needed']) > 5) >= 0.9


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
        design(SPREADS, LABELS, ALL), np.zeros(problem.fit().x.shape), LOGS,
        [problem.block[::k] for k in every], -BOUND, BOUND)
    error = (fit.theta - problem.truth) / np.sqrt(np.diagonal(fit.spread(), axis1=1, axis2=2))
    assert fit.converged and np.sqrt(np.mean(error**2)) < 2


def test_left_out_blocks_are_predicted_no_better_than_fitted_ones():
    problem = Linear(4)
    problem.y[:, ::11] += 6 * SIGMA         # the same loss for both
    fit = problem.fit()
    assert fit.held.sum() > fit.chi2


def test_the_gradient_of_loss_and_prior_vanishes_at_the_solution():
    problem = Linear(3)
    model = bent(problem)
    fit = problem.fit(model=model)
    assert fit.converged and not solve(
        model, problem.base, fit.s, 0 * fit.x, LOGS, [problem.block] * len(JOINTS), -BOUND, BOUND,
        iterations=1).converged

    def cost(x):
        residuals, _ = model(problem.base + fit.s @ x, ALL)
        return sum(huber(HUBER, r).sum() for r in residuals) + x @ x / 2

    slope, start = (approx_fprime(x, cost, 1e-6) for x in (fit.x, 0 * fit.x))
    # No value is further from the minimum than a tenth of its standard deviation.
    assert slope @ np.linalg.solve(fit.information, slope) < 0.01
    assert np.linalg.norm(slope) < 0.01 * np.linalg.norm(start)


@pytest.mark.parametrize('noise', [white, correlated])
def test_intervals_hold_the_truth_in_95_of_100_cases(noise):
    inside = []
    for seed in range(100):
        problem = Linear(seed, noise=noise, count=300)
        fit = problem.fit()
        width = WIDTH * np.sqrt(np.diagonal(fit.spread(), axis1=1, axis2=2))
        inside.append(np.abs(fit.theta - problem.truth) <= width)
    assert 0.9 <= np.mean(inside) <= 0.995


def test_intervals_of_zeros_hold_under_an_error_that_drifts_as_long_as_a_fifth_of_the_recording():
    """Zeros of joints and of recordings have one signal, so that only their sum is determined."""
    count, memory = 300, np.exp(-1 / 60)
    spreads = (Spread(0.0, {'joint': 2.0, 'unit': 1.0}), Spread(1.0, {'joint': 0.3}))
    labels = {'joint': (1, 2, 3, 4), 'unit': (1, 2, 3, 4)}
    s = design(spreads, labels, ALL[:2])
    wave = np.sin(np.linspace(0.0, 40.0, count))
    slopes = [np.stack([np.ones(count), wave])] * 4
    inside = []
    for seed in range(2000, 2060):
        rng = np.random.default_rng(seed)
        truth = (s @ rng.standard_normal(s.shape[2]))
        drift = lfilter([1.0], [1.0, -memory], rng.standard_normal((4, 2 * count)))[:, count:]
        noise = rng.standard_normal((4, count)) + np.sqrt(1 - memory**2) * drift
        y = noise + truth[:, :1] + truth[:, 1:] * wave
        fit = solve(lambda theta, _, y=y: (list(theta[:, :1] + theta[:, 1:] * wave - y), slopes),
                    np.zeros((4, 2)), s, np.zeros(s.shape[2]), (0,) * 4,
                    [np.arange(count) * BLOCKS // count] * 4, -BOUND[:2], BOUND[:2])
        width = WIDTH * np.sqrt(np.diagonal(fit.spread(), axis1=1, axis2=2))
        inside.append(np.abs(fit.theta - truth) <= width)
    assert (np.mean(inside, axis=(0, 1)) >= 0.9).all()
