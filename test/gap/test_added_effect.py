"""The code of the how-to page on adding an effect works as printed."""

from dataclasses import replace
from pathlib import Path
import re

from flights import KEYS, Motion, P, solved
from flights import ROBOT as FLOWN
import numpy as np
import pytest
from test_consumers import OUTPUTS, plain, with_effect

from beetle_omni_ros.identify.gap.body import BodyModel
from beetle_omni_ros.identify.gap.candidates import candidates
from beetle_omni_ros.identify.gap.keys import all_keys, extra_keys
from beetle_omni_ros.identify.gap.residual import FlightModel
from beetle_omni_ros.robot import effects
from beetle_omni_ros.robot.effects import CATALOGUE, separating_experiment

PAGE = Path(__file__).resolve().parents[2] / 'docs/how-to/add_an_effect.md'
ENTRY, MEASURED, TEST = re.findall(r'```python\n(.*?)```', PAGE.read_text(), flags=re.S)
NAME = 'motor_heat'


@pytest.fixture(autouse=True)
def added(monkeypatch):
    """The catalogue with the page's entry."""
    made = {}
    exec(compile(ENTRY, str(PAGE), 'exec'), made)
    monkeypatch.setitem(CATALOGUE, NAME, made['CATALOGUE'][NAME])


def test_the_test_of_the_page_passes_only_with_the_new_entry(monkeypatch):
    made = {}
    exec(compile(TEST, str(PAGE), 'exec'), made)
    page_test = made['test_motors_of_50_degrees_take_thrust']
    assert page_test() is None
    monkeypatch.delitem(CATALOGUE, NAME)
    with pytest.raises((AssertionError, KeyError, ValueError)):
        page_test()


@pytest.mark.parametrize('consumer', ['nmpc', 'training', 'plant'])
def test_the_plant_applies_the_added_effect(consumer):
    assert effects.treatment(consumer, NAME).acts
    found = np.concatenate([np.ravel(part) for part in OUTPUTS[consumer](with_effect(NAME))])
    assert not np.array_equal(found, plain(consumer))


def test_the_page_lists_the_consumers():
    rows = re.findall(r'^\| `(\w+)` \| ([^|]+) \|$', PAGE.read_text().split('## Consumers')[1],
                      flags=re.M)
    assert dict(rows) == effects.CONSUMERS


def test_the_page_lists_the_measured_terms():
    table = PAGE.read_text().split('## An effect of a measured quantity')[1].split('```')[0]
    assert re.findall(r'^\| `(\w+)` \|', table, flags=re.M) == list(effects.MEASURED)


def test_the_added_effect_has_its_own_experiment():
    assert separating_experiment(['thrust_coefficient', NAME]) == CATALOGUE[NAME].separated_by
    assert separating_experiment(['mass', 'thrust_coefficient']) == CATALOGUE['mass'].separated_by


def test_the_gap_finder_identifies_the_added_effect(monkeypatch):
    robot = replace(FLOWN, effects={NAME: {'loss_per_kelvin': 0.0, 'temperature': 50.0}})
    keys, key = {**all_keys(robot), **extra_keys()}, f'{NAME}.loss_per_kelvin'
    monkeypatch.setitem(KEYS, key, keys[key])
    made = FlightModel(Motion(duration=10.0).flight(), robot, BodyModel(robot, keys, (0.0, 0.0)),
                       keys, P)
    warm = made.residual({key: 0.004}, 'B')
    assert np.abs(warm['B'] - made.residual({}, 'B')['B']).max() > 0.5
    assert solved(made, [key], 'B', base=warm)[key] == pytest.approx(0.004, rel=1e-6)
    assert [c.keys for c in candidates(keys, [made]) if c.name == NAME] == [(key,)]
