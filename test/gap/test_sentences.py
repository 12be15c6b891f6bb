"""Sentence, headline and tables from results."""

from types import SimpleNamespace

from flights import KEYS, ROBOT
import pytest

from beetle_omni_ros.identify.gap.results import parameters
from beetle_omni_ros.robot.effects import CATALOGUE, treatment


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
