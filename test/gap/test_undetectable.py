"""Undetectable effects are listed, also those of one regime."""

from types import SimpleNamespace

from flights import KEYS, model, Motion, P
import numpy as np
import pytest

from beetle_omni_ros.identify.gap.analysis import Analysis
from beetle_omni_ros.identify.gap.candidates import candidates
from beetle_omni_ros.identify.gap.certainty import detectability
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


def test_an_entry_detectable_in_one_form_is_not_undetectable():
    a = Analysis(detectability={name: SimpleNamespace(sigma=sigma) for name, sigma in (
        ('rotor_drag', 1.0), ('joint_offset[1]', 1.0), ('joint_offset[2]', 90.0),
        ('ground_effect', 1.0), ('mass', np.inf))})
    assert hidden(a, P) == ['rotor_drag'] and not_met(a, P) == ['ground_effect']
