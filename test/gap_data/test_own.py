"""Cases of the campaign with the own simulator, and their score."""

from collections import Counter
from dataclasses import replace

import formulas
from gap_own import case_of, ENTRIES, judged
import numpy as np
import pytest

from beetle_omni_ros.identify.flights.keys import all_keys
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT, RNG = RobotParameters.load(), np.random.default_rng(0)


@pytest.mark.parametrize('name', ENTRIES)
def test_an_effect_is_drawn_repeatably_in_its_range_with_one_to_two_typical_sizes(name):
    made, again = (formulas.drawn(name, ROBOT, np.random.default_rng(1)) for _ in range(2))
    effect = name.removesuffix(formulas.OF_ONE)
    assert made == again and replace(ROBOT, effects={effect: made})     # which checks the range
    keys = [key for key in all_keys(ROBOT).values() if key.effect == effect and not key.form]
    numbers = np.concatenate([np.ravel(value) for value in made.values()])
    if name != effect:      # three joints are as in the file
        each = numbers.reshape(-1, 4) - np.array([[key.base] for key in keys])
        assert (np.count_nonzero(each, axis=1) == 1).all()
        numbers = each.sum(axis=1) + [key.base for key in keys]
    away = [(np.log(number / key.base) if key.relative else number - key.base) / key.typical
            for number, key in zip(numbers, keys, strict=True)]
    assert 0.999 < np.linalg.norm(away) / len(made)**0.5 < 2.001


def test_65_cases_hide_each_entry_once_alone_and_depend_on_seed_and_number_alone():
    cases = [case_of(3, number) for number in range(65)]
    assert Counter(case.kind for case in cases) == {'singles': 41, 'pairs': 16, 'none': 8}
    assert {case.effects[0] for case in cases if case.kind == 'singles'} == {*ENTRIES}
    assert case_of(3, 7) == cases[7] != case_of(4, 7)


def test_effects_are_drawn_again_for_impossible_robots_and_lost_flights(tmp_path, monkeypatch):
    inertia, flown = iter([0.9, 0.1, 0.1]), iter([True, False, True, True])
    monkeypatch.setattr(formulas, 'fly', lambda *given: next(flown))
    monkeypatch.setattr(formulas, 'drawn', lambda *_: {'inertia': (0.07, 0.07, next(inertia))})
    *_, lost = formulas.hidden(['inertia'], ROBOT, 'rl', ['hover'] * 2, RNG, tmp_path)
    assert lost == 2


@pytest.mark.parametrize(('named', 'right', 'wrong'), [
    ([('rotor_thrust_coefficient', 3)], True, 0), ([('rotor_thrust_coefficient', 2)], False, 1),
    ([('mass', 3)], False, 1), ([('rotor_thrust_coefficient', 3), ('mass', 3)], True, 1),
    ([], False, 0)])
def test_a_name_that_is_not_hidden_or_of_another_rotor_is_wrong(named, right, wrong):
    scale = {'value': 0.91, 'interval': [0.88, 0.94]}
    effects = [{'names': [name], 'rotor': rotor, 'evidence': {'ln_bayes_factor': 9.0},
                'parameters': {'scale': scale}} for name, rotor in named]
    row = judged(case_of(0, 0)._replace(kind='singles'), {
        'rotor_thrust_coefficient': {'scale': (1.0, 1.0, 0.9, 1.0)}}, {
            'verdict': 'named', 'effects': effects, 'partial': []})
    assert (row['right'], len(row['wrong'])) == (right, wrong)
    assert [each['inside'] for each in row['parameters']] == [[True]] * right
