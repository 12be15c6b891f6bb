"""Forces outside the catalogue are found by their correlations, and not found in gusts."""

from dataclasses import replace
from types import SimpleNamespace

from flights import gusts, KEYS, model, Motion, P, pushed
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.analysis import Analysis
from beetle_omni_ros.identify.gap.candidates import Candidate, Found, TOO_SMALL, Trial
from beetle_omni_ros.identify.gap.fit import Problem
from beetle_omni_ros.identify.gap.keys import tolerances
from beetle_omni_ros.identify.gap.noise import Noise
from beetle_omni_ros.identify.gap.patterns import (
    Pattern,
    patterns,
    spectral_line,
    SpectralLine,
    SWINGING,
)
from beetle_omni_ros.identify.gap.unknown import Remainder
from beetle_omni_ros.identify.gap.verdict import decide

MOTION = Motion(7, duration=60.0)
NAMES = [*(f'wind.force[{k}]' for k in range(3)),
         *(f'rotor_thrust_coefficient.scale[{k}]' for k in range(4))]
NOTHING = Remainder(0.0, 0.0, [], [], 'body', {})


def problem(push):
    """Problem of a flight with a force that causes the acceleration ``push`` (N, 3) in world."""
    made = Problem([model(pushed(MOTION, push))], KEYS, tolerances(P), P)
    # Rotations do not follow from the thrusts, because only forces are tested.
    made.models[0]._mask = np.ones(len(made.models[0]._mask))
    made.noise = Noise.of([made.models[0].residual({})], P)
    made._label()
    return made, made.state({}, NAMES)


def gust(seed, size=0.1):
    return gusts(MOTION, seed, size)


def best(push):
    return {p.text: p for p in patterns(*problem(push), NAMES)}


def field():
    """A jet across the room, along x where y is small."""
    y = MOTION.position[:, 1]
    return np.outer(np.exp(-0.5 * (y / 0.4)**2), [0.6, 0.2, 0.0])


def test_a_local_jet_is_a_pattern_over_position():
    found = best(gust(1) + field())
    calm = best(gust(1))
    assert found['the place'].gain > P.least_pattern > calm['the place'].gain
    assert found['the place'].gain == max(p.gain for p in found.values())
    assert found['the place'].size[0] > P.least_force


def test_a_constant_wind_is_not_a_pattern():
    assert best(gust(1) + [0.5, -0.3, 0.0])['the place'].gain < P.least_pattern


def test_a_line_in_the_spectrum_is_found_with_its_size():
    wave = 0.3 * np.sin(2 * np.pi * 3.3 * MOTION.t + 0.4)
    made, _ = problem(gust(2) + np.outer(wave, [0.6, 0.8, 0.0]))
    line = spectral_line(made, {})
    assert line.frequency == pytest.approx(3.3, abs=0.03)
    assert line.size == pytest.approx(0.3 / np.sqrt(2), rel=0.15)
    assert line.ratio > 3 * P.least_line


@pytest.mark.parametrize('seed', range(3))
def test_gusts_have_no_line(seed):
    made, _ = problem(gust(seed, 0.2))
    assert spectral_line(made, {}).ratio < P.least_line


def decided(accepted=(), found=(), line=SpectralLine(0.0, 0.0, 0.0), left=0.0, trials=()):
    names = [n for t in accepted for n in t.candidate.keys]
    search = Found(accepted=list(accepted), state=SimpleNamespace(names=names),
                   cost=(1000.0, 1000.0 - 200.0 * len(names),
                         1000.0 - 200.0 * len(names) - left),
                   trials={t.candidate.label: t for t in trials})
    a = Analysis(keys=KEYS, found=search, remainder=NOTHING, patterns=list(found),
                 spectral_line=line)
    a.problem = SimpleNamespace(time=np.zeros(1000), priors={})
    decide(a, P)
    return a


def test_a_periodic_force_is_unknown():
    assert decided().verdict == 'no_gap'
    a = decided(line=SpectralLine(3.3, 500.0, 0.2))
    assert a.verdict == 'unknown' and '3.30 Hz' in a.reason
    assert decided(line=SpectralLine(3.3, 500.0, 0.5 * P.least_force)).verdict == 'no_gap'


def wind():
    return Trial(Candidate('wind', ('wind.force[0]',), label='wind'), 200.0,
                 {'wind.force[0]': 1.0}, True)


@pytest.mark.parametrize('reason, verdict', [(TOO_SMALL, 'named'), ('', 'unknown')])
def test_a_pattern_below_the_threshold_is_not_unknown(reason, verdict):
    key = 'joint_command_latency.delay'
    other = Trial(Candidate('joint_command_latency', (key,), label='latency'), 90.0,
                  {key: 8e-4}, True, reason=reason)
    assert decided([wind()], left=P.least_left + 30.0, trials=[other]).verdict == verdict


SURE = Pattern('the place', 90.0, 15.0, 1.0, (0.2, 0.0))


@pytest.mark.parametrize('pattern, verdict', [
    (SURE, 'unknown'), (replace(SURE, error=60.0), 'no_gap'),
    (replace(SURE, error=38.0), 'unknown'), (replace(SURE, error=38.0, positive=0.75), 'no_gap'),
    (replace(SURE, positive=0.5), 'no_gap'), (replace(SURE, gain=20.0, error=1.0), 'no_gap'),
    (replace(SURE, size=(0.9 * P.least_force, 0.9 * P.least_torque)), 'no_gap')])
def test_a_significant_large_pattern_is_unknown(pattern, verdict):
    assert decided(found=[pattern]).verdict == verdict


@pytest.mark.parametrize('gain, verdict', [(90.0, 'unknown'), (35.0, 'named')])
def test_a_name_is_withdrawn_if_a_pattern_explains_as_much(gain, verdict):
    a = decided([wind()], [replace(SURE, gain=gain, error=5.0)])
    assert a.verdict == verdict
    assert [t.candidate.name for t in a.partial] == (['wind'] if verdict == 'unknown' else [])


@pytest.mark.parametrize('text, size, verdict', [
    (SWINGING, 1.1, 'unknown'), (SWINGING, 0.9, 'named'), ('the place', 2.0, 'named')])
def test_a_swinging_mass_is_unknown_even_if_its_weight_explains_much(text, size, verdict):
    swing = Pattern(text, 2 * P.least_pattern, 5.0, 1.0, (size * P.swinging_force, 0.0))
    winds = [wind() for _ in range(4)]      # they explain nine times the remaining variance
    assert decided(winds, [swing]).verdict == verdict
