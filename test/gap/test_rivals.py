"""Two approximations of one response form a set if the response has neither form."""

from types import SimpleNamespace

from flights import KEYS, P
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.candidates import Candidate, Found, Trial
from beetle_omni_ros.identify.gap.fit import State
from beetle_omni_ros.identify.gap.search import Search

DEAD, LAG = ('rotor_dead_time', 'rotor_dead_time.delay'), ('rotor_lag', 'rotor_lag.time_constant')
SAG = ('voltage_sag', 'voltage_sag.exponent')


SIZES = {'rotor_dead_time': 0.02, 'rotor_lag': 0.4, 'voltage_sag': 0.8}


def trial(entry, gain):
    name, key = entry
    return Trial(Candidate(name, (key,), label=name), gain, {key: SIZES[name]}, refined=True)


def rivals(monkeypatch, accepted, other, beside, instead):
    """Members of the set of ``accepted`` (220 of chi2), given the gains of ``other``."""
    own = trial(accepted, 220.0)
    found = Found(accepted=[own], trials={own.candidate.label: own})
    left = trial(other, beside)
    found.trials[left.candidate.label] = left
    state = State({}, np.zeros(4), np.zeros((4, 1)), [accepted[1]])
    search = Search.__new__(Search)
    search.p = P
    signals = SimpleNamespace(delays=lambda theta: (0.01, 0.01))
    search.problem = SimpleNamespace(keys=KEYS, residual=lambda theta: np.zeros(4),
                                     models=[SimpleNamespace(signals=signals)])
    monkeypatch.setattr(Search, '_refit', lambda self, start, others, n: (start, 1220.0))
    monkeypatch.setattr(Search, '_propose', lambda *rest: [trial(other, instead)])

    def agreed(self, trial, accepted):
        trial.held = SimpleNamespace(total=trial.gain, error=0.1 * trial.gain, positive=1.0,
                                     without_best=0.9 * trial.gain)

    monkeypatch.setattr(Search, '_cross_validate', agreed)
    search._find_rivals(found, state, 1000.0)
    return [t.candidate.name for t in found.rivals[own.candidate.label]]


@pytest.mark.parametrize('accepted, other', [(DEAD, LAG), (LAG, DEAD)])
@pytest.mark.parametrize('beside, meant', [(33.0, True), (5.0, False)])
def test_a_lag_of_second_order_is_dead_time_or_lag(monkeypatch, accepted, other, beside, meant):
    assert rivals(monkeypatch, accepted, other, beside, 120.0) == [other[0]] * meant


def test_rivals_of_another_kind_must_explain_as_much(monkeypatch):
    assert rivals(monkeypatch, DEAD, SAG, 33.0, 120.0) == []
    assert rivals(monkeypatch, DEAD, SAG, 0.0, 215.0) == ['voltage_sag']
