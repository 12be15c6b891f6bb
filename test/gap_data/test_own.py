"""Cases of the campaign with the own simulator, and their score."""

from collections import Counter

import formulas
from gap_own import case_of, ENTRIES, judged, labels
import numpy as np
import pytest

from beetle_omni_ros.identify.flights.keys import all_keys
from beetle_omni_ros.model.effects import CATALOGUE
from beetle_omni_ros.model.parameters import RobotParameters

ROBOT = RobotParameters.load()


def draw(name, seed):
    return formulas.drawn(name, ROBOT, np.random.default_rng(seed))


@pytest.mark.parametrize('name', ENTRIES)
def test_an_effect_is_drawn_repeatably_with_one_to_two_typical_sizes(name):
    keys = {key.name: key for key in all_keys(ROBOT).values() if key.effect == name}
    for seed in range(20):
        made = draw(name, seed)
        assert made == draw(name, seed)
        away = []
        for parameter, value in made.items():
            spec = CATALOGUE[name].parameters[parameter]
            assert all(spec.low <= number <= spec.high for number in np.ravel(value))
            for k, number in enumerate(np.ravel(value)):
                key = keys[f'{name}.{parameter}' + f'[{k}]' * np.ndim(value)]
                away.append((np.log(number / key.base) if key.relative else number - key.base)
                            / key.typical)
        assert 0.999 < np.linalg.norm(away) / len(made)**0.5 < 2.001


def test_every_block_of_cases_hides_each_entry_once_alone_and_no_case_depends_on_another():
    cases = [case_of(3, number) for number in range(len(ENTRIES) + 24)]
    assert Counter(case.kind for case in cases) == {
        'singles': len(ENTRIES), 'pairs': 16, 'none': 8}
    assert {case.effects[0] for case in cases if case.kind == 'singles'} == {*ENTRIES}
    assert all(len(set(case.effects)) == 2 for case in cases if case.kind == 'pairs')
    assert case_of(3, 7) == cases[7] and case_of(3, 7 + len(cases)) != cases[7]


def test_flights_are_drawn_again_until_the_robot_is_possible_and_none_is_lost(
        tmp_path, monkeypatch):
    flown = []
    monkeypatch.setattr(formulas, 'fly', lambda *given: flown.append(given) or len(flown) > 1)
    plant, paths, _, lost = formulas.hidden(
        ['mass'], ROBOT, 'nmpc', ['hover'] * 2, np.random.default_rng(0), tmp_path)
    assert lost == 1 and len(flown) == 3 and len(paths) == 2
    assert flown[0][2].effects != plant.effects == flown[2][2].effects
    monkeypatch.setattr(formulas, 'drawn', lambda *_: {'inertia': (0.02, 0.02, 0.2)})
    with pytest.raises(RuntimeError, match='lost'):
        formulas.hidden(['inertia'], ROBOT, 'nmpc', [], np.random.default_rng(0), tmp_path)


def test_a_name_that_is_not_hidden_or_of_another_rotor_is_wrong():
    truth = {'rotor_thrust_coefficient': {'scale': (1.0, 1.0, 0.9, 1.0)}}
    case = case_of(0, 0)._replace(kind='singles')

    def effect(name, **place):
        return {'names': [name], 'members': [name], 'evidence': {'ln_bayes_factor': 9.0},
                'parameters': {'scale': {'value': 0.91, 'interval': [0.88, 0.94]}}, **place}

    right, other = (effect('rotor_thrust_coefficient', rotor=rotor) for rotor in (3, 2))
    for effects, good, wrong in (([right], True, 0), ([other], False, 1),
                                 ([effect('mass')], False, 1), ([right, effect('mass')], True, 1),
                                 ([], False, 0)):
        row = judged(case, truth, {'verdict': 'named', 'effects': effects, 'partial': []})
        assert (row['right'], len(row['wrong'])) == (good, wrong)
        assert [each['inside'] for each in row['parameters']] == [[True]] * good
    assert labels({'joint_offset': {'offset': (0.0, -0.04, 0.0, 0.0)}}) == [
        {'name': 'joint_offset', 'joint': 2, 'parameters': {'offset': -0.04}}]
    none = judged(case._replace(kind='none'), {}, {
        'verdict': 'named', 'effects': [effect('module_reaction')], 'partial': []})
    assert none['wrong'] == [['module_reaction']] and not none['right']
