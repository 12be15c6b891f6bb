"""Sentence, headline and tables from results."""

from types import SimpleNamespace

from flights import KEYS, ROBOT
import pytest

from beetle_omni_ros.identify.gap.results import parameters, summary
from beetle_omni_ros.robot.effects import CATALOGUE, treatment


def effect(names, value, interval, file, unit='N s/m', **member):
    return {'names': names, **member, 'evidence': {'delta_bic': 50.0}, 'parameters': {
        'x': {'value': value, 'interval': interval, 'file': file, 'unit': unit}}}


def made(*effects, closure=0.9, **more):
    return {'verdict': 'named', 'effects': list(effects), 'closure': closure, 'held_out': True,
            'partial': [], 'horizons': {'0.5 s': {
                'before': 5.0, 'after': 1.2, 'effects_alone': 1.3, 'placebo': 9.0,
                'closure': closure}}, 'where': [], 'candidates': [], **more}


@pytest.mark.parametrize('file, words', [(0.0, 'robot file: none'), (0.8, 'file: 0.8 N s/m')])
def test_the_sentence_states_the_value_of_the_robot_file(file, words):
    text = summary(made(effect(['rotor_drag'], 0.4, [0.3, 0.5], file)))
    assert text.startswith('Rotor drag of 0.4 +- 0.1 N s/m') and words in text
    assert 'explains the disagreement. Adding it closes 90%' in text


def test_a_truncated_interval_is_stated_by_both_ends():
    assert '0 (0 to 0.08) N s/m' in summary(made(effect(['rotor_drag'], 0.0, [0.0, 0.08], 0.8)))


@pytest.mark.parametrize('name, deviation, expected', [
    ('rotor_drag.coefficient', 0.03, [0.0, 0.13]), ('axial_inflow.per_rotor', 0.4, [0.3, 0.5])])
def test_intervals_exclude_impossible_values(name, deviation, expected):
    a = SimpleNamespace(keys=KEYS, widths={name: 0.1})
    entry, parameter = name.split('.')
    found = parameters(a, entry, (name,), {name: deviation}, ROBOT)[parameter]
    assert found['interval'] == pytest.approx(expected) and found['file'] == 0.0


@pytest.mark.parametrize('name', [n for n in CATALOGUE if treatment('gap', n).acts])
def test_every_entry_states_each_of_its_parameters(name):
    own = {key.name: key for key in KEYS.values() if key.effect == name}
    member = 1 if CATALOGUE[name].each else None
    free = tuple(key for key in own if member is None or key.endswith(f'[{member - 1}]')) or \
        tuple(own)
    a = SimpleNamespace(keys=KEYS, widths=dict.fromkeys(own, 0.1))
    stated = parameters(a, name, free, dict.fromkeys(own, 0.0), ROBOT)
    assert list(stated) == list(CATALOGUE[name].parameters)
    for entry in stated.values():
        assert set(entry) == {'value', 'unit', 'file', 'interval'}
