"""Low excitation: closed-loop bias by gusts must not be taken for an effect."""

from dataclasses import replace
from types import SimpleNamespace

from flights import KEYS, model, Motion, P
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.analysis import Analysis
from beetle_omni_ros.identify.gap.candidates import Candidate, Found, Trial
from beetle_omni_ros.identify.gap.certainty import Detectability, excitation
from beetle_omni_ros.identify.gap.fit import Problem
from beetle_omni_ros.identify.gap.keys import tolerances
from beetle_omni_ros.identify.gap.noise import Noise
from beetle_omni_ros.identify.gap.search import Search
from beetle_omni_ros.identify.gap.unknown import Remainder
from beetle_omni_ros.identify.gap.verdict import decide

MOTION = Motion(7)
NOTHING = Remainder(0.0, 0.0, [], [], 'body', {})


def trial(name, key, gain=300.0):
    return Trial(Candidate(name, (key,), label=name), gain, {key: 0.1}, True)


def thrust():
    return trial('thrust_coefficient', 'thrust_coefficient.scale')


def servo():
    return trial('joint_command_latency', 'joint_command_latency.delay')


def decided(accepted, still, rivals=(), everything=700.0):
    """An analysis with a verdict after a search."""
    names = [n for t in accepted for n in t.candidate.keys]
    state = SimpleNamespace(names=names)
    found = Found(accepted=list(accepted), state=state, cost=(1000.0, 700.0, everything),
                  low_excitation=still, rivals={t.candidate.label: list(rivals) for t in accepted})
    detectability = {'mass': Detectability(50.0, {}), 'rotor_drag': Detectability(1.0, {})}
    a = Analysis(keys=KEYS, found=found, remainder=NOTHING, detectability=detectability)
    a.problem = SimpleNamespace(time=np.zeros(1000), priors={})
    decide(a, P)
    return a


def problem(flight):
    return Problem([model(flight)], KEYS, tolerances(P), P)


def hovering(push=0.0):
    """Readings of a hovering robot in a slow gust [m/s^2]."""
    rng = np.random.default_rng(1)
    kernel = np.hanning(100)
    gust = np.stack([np.convolve(x, kernel / np.linalg.norm(kernel), 'same')
                     for x in rng.standard_normal((6, len(MOTION.t)))], axis=1)
    gust[:, 3:] *= 0.1      # rad/s, of which only the derivative is used
    flight = MOTION.flight(imu=push * gust + [0, 0, 9.80665, 0, 0, 0])
    pose = flight.pose.copy()
    pose[:] = [0, 0, 1, 0, 0, 0, 1]
    return replace(flight, pose=pose)


def test_a_planned_motion_has_excitation():
    assert excitation(problem(MOTION.flight())) > 3 * P.least_liveliness


def test_motion_by_gusts_is_low_excitation():
    hover = problem(hovering(push=0.1))
    hover.noise = replace(hover.noise, sigma={
        **hover.noise.sigma, 'B': np.array([0.1] * 3 + [0.2] * 3)})
    assert excitation(hover) < P.least_liveliness


def test_excitation_falls_with_the_gusts():
    made = problem(MOTION.flight())
    calm = excitation(made)
    made.noise = replace(made.noise, sigma={**made.noise.sigma, 'B': 10 * made.noise.sigma['B']})
    assert excitation(made) == pytest.approx(calm / 10)


def test_spread_is_that_of_the_coloured_noise():
    taps = {'B': np.array([[1.0, -0.9]])}
    assert Noise(taps, {'B': np.array([2.0])}).spread['B'][0] == pytest.approx(
        2.0 / np.sqrt(1 - 0.9**2), rel=0.02)


def test_low_excitation_names_no_force_and_proposes_an_experiment():
    rival = trial('mass', 'mass.mass')
    a = decided([thrust()], True, [rival])
    assert (a.verdict, a.accepted) == ('not_decidable', [])
    assert 'thrust_coefficient' in a.reason and 'mass' in a.reason
    assert [t.candidate.name for t in a.partial] == ['thrust_coefficient']
    assert 'large turns' in a.experiment and 'weigh the robot' in a.experiment


def test_residuals_of_gusts_in_low_excitation_are_not_unknown():
    assert decided([thrust()], True, everything=100.0).verdict == 'not_decidable'
    assert decided([thrust()], False, everything=100.0).verdict == 'unknown'


def test_the_same_finding_with_excitation_is_named():
    a = decided([thrust()], False)
    assert (a.verdict, len(a.accepted)) == ('named', 1)


def test_encoders_decide_about_servos_in_low_excitation_too():
    a = decided([servo()], True)
    assert (a.verdict, a.accepted[0].candidate.name) == ('named', 'joint_command_latency')
    both = decided([thrust(), servo()], True)
    assert both.verdict == 'not_decidable'
    assert [t.candidate.name for t in both.accepted] == ['joint_command_latency']


def test_low_excitation_without_a_finding_is_not_decidable():
    a = decided([], True)
    assert a.verdict == 'not_decidable' and 'large turns' in a.experiment


@pytest.mark.parametrize('lively, expected', [(5.0, 2), (0.5, 1)])
def test_low_excitation_is_explained_once(monkeypatch, lively, expected):
    first, second = thrust(), trial('wind', 'wind.force[2]')
    search = Search(problem(MOTION.flight()), [first.candidate, second.candidate])
    search._proposals = SimpleNamespace(fit_more=list)
    state = SimpleNamespace(theta={}, r=np.zeros(1), slopes=np.zeros((1, 0)), names=[])
    module = 'beetle_omni_ros.identify.gap.search.'
    monkeypatch.setattr(module + 'excitation', lambda problem: lively)
    monkeypatch.setattr(module + 'State', lambda *rest: state)
    monkeypatch.setattr(Search, '_fit_with_noise', lambda self, theta, rest: (state, 100.0))
    monkeypatch.setattr(Search, '_cost_of_all', lambda self, state: 0.0)
    monkeypatch.setattr(Search, '_refit', lambda self, *rest: (state, 100.0))
    monkeypatch.setattr(Search, '_prune', lambda self, found, state, cost: (state, cost))
    monkeypatch.setattr(Search, '_find_rivals', lambda *rest: None)
    monkeypatch.setattr(Search, '_propose', lambda self, state, cost, taken: [
        t for t in (first, second) if t.candidate in self.candidates
        and t.candidate not in taken])
    monkeypatch.setattr(Search, '_select', lambda self, trials, *rest: next(iter(trials), None))
    found = search.run()
    assert (len(found.accepted), found.low_excitation) == (expected, lively < 1)
    assert len(search.candidates) == 2      # all of them are fitted as rivals
