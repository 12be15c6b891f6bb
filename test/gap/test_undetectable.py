"""Effects are detectable in some regimes, and forces with excitation only."""

from dataclasses import replace

from flights import KEYS, model, Motion, P
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.analysis import Analysis
from beetle_omni_ros.identify.gap.candidates import candidates
from beetle_omni_ros.identify.gap.certainty import detectability, excitation
from beetle_omni_ros.identify.gap.fit import Problem
from beetle_omni_ros.identify.gap.keys import tolerances
from beetle_omni_ros.identify.gap.verdict import hidden, not_met


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


def problem(flight):
    return Problem([model(flight)], KEYS, tolerances(P), P)


def test_a_planned_motion_has_excitation_and_motion_by_gusts_has_not():
    motion = Motion(7)
    assert excitation(problem(motion.flight())) > 3 * P.least_liveliness
    rng, kernel = np.random.default_rng(1), np.hanning(100)
    gust = np.stack([np.convolve(x, kernel / np.linalg.norm(kernel), 'same')
                     for x in rng.standard_normal((6, len(motion.t)))], axis=1)
    gust[:, 3:] *= 0.1      # rad/s, of which only the derivative is used
    flight = motion.flight(imu=0.1 * gust + [0, 0, 9.80665, 0, 0, 0])
    flight.pose[:] = [0, 0, 1, 0, 0, 0, 1]
    hover = problem(flight)
    hover.noise = replace(hover.noise, sigma={
        **hover.noise.sigma, 'B': np.array([0.1] * 3 + [0.2] * 3)})
    assert excitation(hover) < P.least_liveliness
