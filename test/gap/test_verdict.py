"""The verdict from what a search found, its patterns, and the excitation of the flights."""

from dataclasses import replace
from types import SimpleNamespace

from flights import KEYS, P
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.analysis import Analysis
from beetle_omni_ros.identify.gap.candidates import Candidate, Found, TOO_SMALL, Trial
from beetle_omni_ros.identify.gap.certainty import Detectability
from beetle_omni_ros.identify.gap.patterns import Pattern, SpectralLine, SWINGING
from beetle_omni_ros.identify.gap.unknown import Remainder
from beetle_omni_ros.identify.gap.verdict import decide, disagreement, hidden, not_met


def trial(name, key, size=1.0, **more):
    return Trial(Candidate(name, (key,), label=name), 200.0, {key: size}, True, **more)


THRUST = trial('thrust_coefficient', 'thrust_coefficient.scale', 0.1)
SERVO = trial('joint_command_latency', 'joint_command_latency.delay', 0.1)
WIND = trial('wind', 'wind.force[0]')


def decided(accepted=(), still=False, left=0.0, rivals=(), found=(), trials=(),
            line=SpectralLine(0.0, 0.0, 0.0)):
    """An analysis with a verdict after a search."""
    accepted = [replace(t) for t in accepted]
    names = [n for t in accepted for n in t.candidate.keys]
    cost = 1000.0 - 200.0 * len(names)
    search = Found(accepted=accepted, state=SimpleNamespace(names=names),
                   cost=(1000.0, cost, cost - left), low_excitation=still,
                   rivals={t.candidate.label: list(rivals) for t in accepted},
                   trials={t.candidate.label: t for t in trials})
    a = Analysis(keys=KEYS, found=search, remainder=Remainder(0.0, 0.0, [], [], 'body', {}),
                 patterns=list(found), spectral_line=line,
                 detectability={'mass': Detectability(50.0, {})})
    a.problem = SimpleNamespace(time=np.zeros(1000), priors={}, p=P)
    decide(a, P)
    return a


def named(trials):
    return [t.candidate.name for t in trials]


def test_low_excitation_names_no_force_and_proposes_an_experiment():
    a = decided([THRUST], True, rivals=[trial('mass', 'mass.mass', 0.1)])
    assert (a.verdict, a.accepted) == ('not_decidable', [])
    assert 'thrust_coefficient' in a.reason and 'mass' in a.reason
    assert named(a.partial) == ['thrust_coefficient']
    assert 'large turns' in a.experiment and 'weigh the robot' in a.experiment


@pytest.mark.parametrize('accepted, still, left, verdict, left_over', [
    ([THRUST], True, 600.0, 'not_decidable', []), ([THRUST], False, 600.0, 'unknown', []),
    ([THRUST], False, 0.0, 'named', ['thrust_coefficient']), ([], True, 0.0, 'not_decidable', []),
    ([SERVO], True, 0.0, 'named', ['joint_command_latency']),       # encoders decide
    ([THRUST, SERVO], True, 0.0, 'not_decidable', ['joint_command_latency'])])
def test_residuals_of_gusts_in_low_excitation_are_no_effect(accepted, still, left, verdict,
                                                            left_over):
    a = decided(accepted, still, left)
    assert (a.verdict, named(a.accepted)) == (verdict, left_over)


def test_a_periodic_force_is_unknown():
    assert decided().verdict == 'no_gap'
    a = decided(line=SpectralLine(3.3, 500.0, 0.2))
    assert a.verdict == 'unknown' and '3.30 Hz' in a.reason
    assert decided(line=SpectralLine(3.3, 500.0, 0.5 * P.least_force)).verdict == 'no_gap'


@pytest.mark.parametrize('reason, verdict', [(TOO_SMALL, 'named'), ('', 'unknown')])
def test_a_pattern_below_the_threshold_is_not_unknown(reason, verdict):
    other = trial('joint_command_latency', 'joint_command_latency.delay', 8e-4, reason=reason)
    other.gain = 90.0
    assert decided([WIND], left=P.least_left + 30.0, trials=[other]).verdict == verdict


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
    a = decided([WIND], found=[replace(SURE, gain=gain, error=5.0)])
    assert a.verdict == verdict
    assert named(a.partial) == (['wind'] if verdict == 'unknown' else [])


@pytest.mark.parametrize('text, size, verdict', [
    (SWINGING, 1.1, 'unknown'), (SWINGING, 0.9, 'named'), ('the place', 2.0, 'named')])
def test_a_swinging_mass_is_unknown_even_if_its_weight_explains_much(text, size, verdict):
    swing = Pattern(text, 2 * P.least_pattern, 5.0, 1.0, (size * P.swinging_force, 0.0))
    # four winds explain nine times the remaining variance
    assert decided([WIND] * 4, found=[swing]).verdict == verdict


@pytest.mark.parametrize('gap, verdict', [(1.2, 'no_gap'), (80.0, 'unknown'),
                                          (np.nan, 'unknown')])
def test_no_gap_needs_free_runs_that_agree(gap, verdict):
    a = Analysis(verdict='no_gap', problem=SimpleNamespace(p=P))
    disagreement(a, gap)
    assert a.verdict == verdict


def test_an_entry_detectable_in_one_form_is_not_undetectable():
    a = Analysis(detectability={name: SimpleNamespace(sigma=sigma) for name, sigma in (
        ('rotor_drag', 1.0), ('joint_offset[1]', 1.0), ('joint_offset[2]', 90.0),
        ('ground_effect', 1.0), ('mass', np.inf))})
    assert hidden(a, P) == ['rotor_drag'] and not_met(a, P) == ['ground_effect']
