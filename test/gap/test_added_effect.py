"""The code of the how-to page on adding an effect works as printed, in each consumer."""

from dataclasses import replace
from pathlib import Path
import re

from flights import model, Motion, ROBOT, solved
import numpy as np
import pytest
from rich.console import Console
from test_consumers import OUTPUTS, plain, with_effect

import beetle_omni_ros
from beetle_omni_ros.identify.flights.body import BodyModel
from beetle_omni_ros.identify.flights.command import gap_results
from beetle_omni_ros.identify.flights.keys import all_keys, entries_of, extra_keys
from beetle_omni_ros.identify.flights.treatment import TREATMENTS
from beetle_omni_ros.identify.flights.verdict import searched_torques
from beetle_omni_ros.model.effects import CATALOGUE, ignored

PAGE = Path(__file__).resolve().parents[2] / 'docs/how-to/add_an_effect.md'
ENTRY, TREATMENT, STATE, TEST = re.findall(r'```python\n(.*?)```', PAGE.read_text(), flags=re.S)
HEAT, WARMING = 'motor_heat', 'motor_warming'    # the second has a state


@pytest.fixture(autouse=True)
def added(monkeypatch):
    """The catalogue with the page's entries."""
    made = {}
    for text in (ENTRY, TREATMENT, STATE):
        exec(compile(text, str(PAGE), 'exec'), made)
        for name, entry in made['CATALOGUE'].items():
            monkeypatch.setitem(CATALOGUE, name, entry)
        for name, entry in made.get('TREATMENTS', {}).items():
            monkeypatch.setitem(TREATMENTS, name, entry)


def test_the_test_of_the_page_passes_only_with_the_new_entry(monkeypatch):
    made = {}
    exec(compile(TEST, str(PAGE), 'exec'), made)
    page_test = made['test_motors_of_50_degrees_take_thrust']
    assert page_test() is None
    monkeypatch.delitem(CATALOGUE, HEAT)
    with pytest.raises((AssertionError, KeyError, ValueError)):
        page_test()


@pytest.mark.parametrize('consumer', ['nmpc', 'training', 'plant'])
@pytest.mark.parametrize('name', [HEAT, WARMING])
def test_a_consumer_applies_the_added_effect_or_has_no_such_state(name, consumer):
    reason = ignored(consumer, name)
    found = np.concatenate([np.ravel(part) for part in OUTPUTS[consumer](with_effect(name))])
    assert (not reason) == (name == HEAT or consumer == 'plant')
    assert np.array_equal(found, plain(consumer)) == bool(reason)
    assert not reason or 'does not integrate' in reason


@pytest.mark.parametrize('name, values, value', [
    (HEAT, {'loss_per_kelvin': 0.0, 'temperature': 50.0}, 0.004), (WARMING, {'loss': 0.0}, 0.1)])
def test_the_gap_finder_identifies_the_added_effect(name, values, value):
    robot = replace(ROBOT, effects={name: values})
    keys, key = {**all_keys(robot), **extra_keys(robot)}, f'{name}.{next(iter(values))}'
    made = model(Motion(duration=10.0).flight(), robot, BodyModel(robot, keys, (0.0, 0.0)), keys)
    weak = made.residual({key: value}, 'B')
    assert np.abs(weak['B'] - made.residual({}, 'B')['B']).max() > 0.01
    assert solved(made, [key], 'B', base=weak)[key] == pytest.approx(value, rel=1e-6)
    entry, = entries_of({n: own for n, own in keys.items() if own.effect == name and not own.form})
    assert entry.keys[0] == key and set(entry.keys) == {
        f'{name}.{parameter}' for parameter in CATALOGUE[name].numbers}


def test_tables_show_an_added_effect_but_none_with_a_state():
    assert HEAT in searched_torques() and WARMING not in searched_torques()


def test_an_effect_without_a_treatment_acts_as_the_file_has_it(monkeypatch):
    def residual(loss):
        robot = replace(ROBOT, effects={HEAT: {'loss_per_kelvin': loss, 'temperature': 50.0}}
                        if loss else {})
        keys = {**all_keys(robot), **extra_keys(robot)}
        return model(Motion(duration=10.0).flight(), robot, BodyModel(
            robot, keys, (0.0, 0.0)), keys).residual({}, 'B')['B']
    treated, none = residual(0.004), residual(0.0)
    monkeypatch.delitem(TREATMENTS, HEAT)
    assert f'{HEAT}.loss_per_kelvin' not in all_keys(ROBOT)
    assert np.allclose(residual(0.004), treated) and np.allclose(residual(0.0), none)
    assert np.abs(treated - none).max() > 0.01


def test_a_wrong_time_constant_of_a_state_is_named_with_the_true_one(tmp_path):
    def file(name, time_constant):
        path = tmp_path / f'{name}.yaml'
        path.write_text(f'extends: robot.yaml\neffects: {{{WARMING}: {{loss: 0.08, '
                        f'time_constant: {time_constant}}}}}\n')
        return path
    beetle_omni_ros.simulate('nmpc', 'random6', seed=4, bag=tmp_path / 'flight',
                             plant=file('plant', 10.0))
    result = gap_results([tmp_path / 'flight'], robot=file('wrong', 60.0),
                         console=Console(quiet=True))
    assert [effect['names'] for effect in result['effects']] == [[WARMING]]
    low, high = result['effects'][0]['parameters']['time_constant']['interval']
    assert low < 10.0 < high < 25.0
