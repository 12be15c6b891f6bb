"""Forces outside the catalogue are found, not those of gusts; excitation of known ones."""

from dataclasses import replace

from flights import gusts, KEYS, model, Motion, P, pushed
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.analysis import Analysis
from beetle_omni_ros.identify.gap.candidates import candidates
from beetle_omni_ros.identify.gap.certainty import detectability, excitation
from beetle_omni_ros.identify.gap.fit import Problem
from beetle_omni_ros.identify.gap.keys import tolerances
from beetle_omni_ros.identify.gap.noise import Noise
from beetle_omni_ros.identify.gap.patterns import (
    patterns,
    spectral_line,
)
from beetle_omni_ros.identify.gap.verdict import hidden, not_met

MOTION = Motion(7, duration=60.0)
NAMES = [*(f'wind.force[{k}]' for k in range(3)),
         *(f'rotor_thrust_coefficient.scale[{k}]' for k in range(4))]


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


def test_a_local_jet_is_a_pattern_over_position():
    across = np.exp(-0.5 * (MOTION.position[:, 1] / 0.4)**2)       # where y is small
    found, calm = best(gust(1) + np.outer(across, [0.6, 0.2, 0.0])), best(gust(1))
    assert found['the place'].gain > P.least_pattern > calm['the place'].gain
    assert found['the place'].gain == max(p.gain for p in found.values())
    assert found['the place'].size[0] > P.least_force


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


@pytest.mark.parametrize('higher, seen', [(0.0, True), (30.0, False)])
def test_ground_effect_is_detectable_near_the_ground_only(higher, seen):
    motion = Motion(3, 24.0)
    motion.position[:, 2] += higher
    made = model(motion.flight())
    problem = Problem([made], KEYS, tolerances(P), P)
    state = problem.state({}, [name for name, key in KEYS.items() if not key.form])
    visible = detectability(problem, state, list(problem.priors), candidates(KEYS, [made]))
    assert {'ground_effect', 'tilt_thrust_loss', 'propeller_gyroscopic_torque'} <= set(visible)
    a = Analysis(detectability=visible)
    assert ('ground_effect' not in not_met(a, P)) == seen
    assert 'ground_effect' not in hidden(a, P)


def of(flight):
    return Problem([model(flight)], KEYS, tolerances(P), P)


def test_a_planned_motion_has_excitation_and_motion_by_gusts_has_not():
    motion = Motion(7)
    assert excitation(of(motion.flight())) > 3 * P.least_liveliness
    rng, kernel = np.random.default_rng(1), np.hanning(100)
    gust = np.stack([np.convolve(x, kernel / np.linalg.norm(kernel), 'same')
                     for x in rng.standard_normal((6, len(motion.t)))], axis=1)
    gust[:, 3:] *= 0.1      # rad/s, of which only the derivative is used
    flight = motion.flight(imu=0.1 * gust + [0, 0, 9.80665, 0, 0, 0])
    flight.pose[:] = [0, 0, 1, 0, 0, 0, 1]
    hover = of(flight)
    hover.noise = replace(hover.noise, sigma={
        **hover.noise.sigma, 'B': np.array([0.1] * 3 + [0.2] * 3)})
    assert excitation(hover) < P.least_liveliness
