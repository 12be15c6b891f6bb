"""Gates of a gain, its implausible tolerances, and the rivals of an effect."""

from dataclasses import replace
from types import SimpleNamespace

from flights import KEYS, P, ROBOT
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.candidates import Candidate, Found, Trial
from beetle_omni_ros.identify.gap.fit import Problem, State
from beetle_omni_ros.identify.gap.gates import at_bound, confirmed
from beetle_omni_ros.identify.gap.keys import all_keys, tolerances
from beetle_omni_ros.identify.gap.search import Search

LAG, OTHER = 'rotor_lag.time_constant', 'inertia.inertia[0]'


class Straight(Problem):
    """A residual that is linear in two tolerances."""

    def __init__(self, truth, overlap):
        self.keys, self.p = KEYS, P
        self.priors = {name: tolerances(P)[name] for name in (LAG, OTHER)}
        rng = np.random.default_rng(0)
        one, two = rng.standard_normal((2, 2000))
        self.columns = 30 * np.stack([one, overlap * one + (1 - overlap) * two], axis=1)
        self.noise, self.truth = rng.standard_normal(2000), truth

    def residual(self, theta):
        return self.noise + self.columns @ [theta.get(LAG, 0.0) - self.truth,
                                            theta.get(OTHER, 0.0)]


def before(truth, overlap=0.0):
    """Objective without effects: as fitted, and with plausible tolerances only."""
    problem = Straight(truth, overlap)
    search = Search.__new__(Search)
    search.p = P
    search.problem, search.always = problem, [LAG, OTHER]
    start = State({}, problem.residual({}), problem.columns, [LAG, OTHER])
    state, cost = problem.refine(start, search.always, frozenset())
    return cost, search._plausible_cost(state, cost)


@pytest.mark.parametrize('lag, overlap, least, most', [
    # The prior of the tolerance costs eight deviations, 70 of chi2; the data give thousands.
    (0.25, 0.0, 1000 * 30**2 * (0.25 - 0.09)**2, np.inf),
    (0.25, 0.99, 1000, np.inf),     # nor is it absorbed by the tolerance of another parameter
    (0.05, 0.0, 0.0, 0.0)])
def test_a_lag_far_beyond_tolerance_is_not_absorbed_by_the_tolerance(lag, overlap, least, most):
    fitted, believable = before(lag, overlap)
    assert fitted < 2300 and least <= believable - fitted <= most


def agreed(agreement):
    """Cross-validation that confirms the gain with so many standard errors."""
    def cross_validated(self, trial, accepted):
        trial.held = SimpleNamespace(total=trial.gain, error=trial.gain / agreement, positive=1.0,
                                     without_best=0.9 * trial.gain)
    return cross_validated


@pytest.mark.parametrize('gain, left, agreement, prior_gain, named', [
    (60.0, 70.0, 4.0, 0.0, True), (60.0, 170.0, 4.0, 0.0, False), (60.0, 170.0, 10.0, 0.0, True),
    (60.0, 600.0, 10.0, 0.0, False), (600.0, 1700.0, 4.0, 0.0, True),
    (600.0, 1700.0, 2.5, 0.0, False), (30.0, 31.0, 10.0, 20.0, False),
    (30.0, 31.0, 10.0, 28.0, True), (20.0, 21.0, 10.0, 40.0, False),
    (60.0, 600.0, 10.0, 60.0, True)])
def test_a_small_gap_above_noise_must_be_explained_mostly_by_the_effect(monkeypatch, gain, left,
                                                                        agreement, prior_gain,
                                                                        named):
    drag = Candidate('rotor_drag', ('rotor_drag.coefficient',), label='rotor_drag')
    trial = Trial(drag, gain, {'rotor_drag.coefficient': 0.4}, refined=True,
                  prior_gain=prior_gain)

    monkeypatch.setattr(Search, '_cross_validate', agreed(agreement))
    monkeypatch.setattr(Search, '_closed_loop_bias', lambda self, trial, accepted: False)
    search = Search.__new__(Search)
    search.p = P
    search.problem = type('Problem', (), {'keys': KEYS})()
    assert (search._select([trial], 1000.0 + left, 1000.0, []) is trial) == named


@pytest.mark.parametrize('gain, error, positive, prior_gain, held', [
    (100.0, 40.0, 0.6, 0.0, True), (100.0, 80.0, 1.0, 0.0, False), (1000.0, 800.0, 1.0, 0.0, True),
    (1000.0, 800.0, 0.75, 0.0, False), (100.0, 80.0, 1.0, 90.0, True),
    (100.0, 80.0, 0.75, 90.0, False), (100.0, 80.0, 1.0, 10.0, False)])
def test_a_small_gain_must_be_even_over_the_blocks(gain, error, positive, prior_gain, held):
    drag = Candidate('rotor_drag', ('rotor_drag.coefficient',), label='rotor_drag')
    blocks = SimpleNamespace(total=gain, error=error, positive=positive, without_best=0.5 * gain)
    assert confirmed(Trial(drag, gain, {}, held=blocks, prior_gain=prior_gain), P) == held


@pytest.mark.parametrize('key, x, delays, impossible', [
    # a reading is not newer than its stamp, and no command acts before its stamp
    ('imu_filter_lag.delay', -0.003, (), True), ('joint_feedback_delay.delay', -0.003, (), True),
    ('joint_feedback_delay.delay', 0.003, (), False),
    ('mocap_time_offset.delay', -0.003, (), False),
    ('command_latency.delay', -0.01, (-0.002, 0.01), True),
    ('rotor_dead_time.delay', -0.01, (-0.002, 0.01), True),
    ('rotor_dead_time.delay', -0.01, (0.0, 0.0), False),
    # an effect of the robot file may be fitted to zero
    ('rotor_drag.coefficient', 'low', (), False),
    ('rotor_thrust_coefficient.scale[0]', 'low', (), True)])
def test_an_impossible_value_is_no_effect(key, x, delays, impossible):
    own = all_keys(replace(ROBOT, effects={'rotor_drag': {'coefficient': 0.8}}))
    trial = Trial(Candidate(key.partition('.')[0], (key,), label='x'), 100.0,
                  {key: own[key].low if x == 'low' else x})
    assert at_bound(own, trial, delays) == impossible


DEAD, SLOW, SAG = ('rotor_dead_time.delay', 0.02), (LAG, 0.4), ('voltage_sag.exponent', 0.8)


def trial(entry, gain):
    key, size = entry
    name = key.partition('.')[0]
    return Trial(Candidate(name, (key,), label=name), gain, {key: size}, refined=True)


def rivals(monkeypatch, accepted, other, beside, instead):
    """Members of the set of ``accepted`` (220 of chi2), given the gains of ``other``."""
    own = trial(accepted, 220.0)
    found = Found(accepted=[own], trials={own.candidate.label: own})
    left = trial(other, beside)
    found.trials[left.candidate.label] = left
    state = State({}, np.zeros(4), np.zeros((4, 1)), [accepted[0]])
    search = Search.__new__(Search)
    search.p = P
    signals = SimpleNamespace(delays=lambda theta: (0.01, 0.01))
    search.problem = SimpleNamespace(keys=KEYS, residual=lambda theta: np.zeros(4),
                                     models=[SimpleNamespace(signals=signals)])
    monkeypatch.setattr(Search, '_refit', lambda self, start, others, n: (start, 1220.0))
    monkeypatch.setattr(Search, '_propose', lambda *rest: [trial(other, instead)])
    monkeypatch.setattr(Search, '_cross_validate', agreed(10.0))
    search._find_rivals(found, state, 1000.0)
    return [t.candidate.keys[0] for t in found.rivals[own.candidate.label]]


@pytest.mark.parametrize('accepted, other', [(DEAD, SLOW), (SLOW, DEAD)])
@pytest.mark.parametrize('beside, meant', [(33.0, True), (5.0, False)])
def test_a_lag_of_second_order_is_dead_time_or_lag(monkeypatch, accepted, other, beside, meant):
    assert rivals(monkeypatch, accepted, other, beside, 120.0) == [other[0]] * meant


def test_rivals_of_another_kind_must_explain_as_much(monkeypatch):
    assert rivals(monkeypatch, DEAD, SAG, 33.0, 120.0) == []
    assert rivals(monkeypatch, DEAD, SAG, 0.0, 215.0) == [SAG[0]]
