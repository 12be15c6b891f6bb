"""The page's effect of the charge drawn from the pack, a measured quantity, in each consumer."""

from dataclasses import replace
import io

from flights import Motion, P
from flown_once import THREE_POSES
import numpy as np
import pytest
from recordings import ROBOT
from rich.console import Console
from test_added_effect import ENTRY, MEASURED, PAGE
from test_consumers import OUTPUTS, plain
from test_ingest import recording

import beetle_omni_ros
from beetle_omni_ros.identify.gap.command import gap_results
from beetle_omni_ros.identify.gap.ingest import prepare
from beetle_omni_ros.identify.gap.signals import Signals
from beetle_omni_ros.robot import effects
from beetle_omni_ros.robot.effects import CATALOGUE

NAME, LOSS = 'charge_fade', 0.15
made: dict = {}
exec(compile(ENTRY + MEASURED, str(PAGE), 'exec'), made)
FADE = made['CATALOGUE'][NAME]


@pytest.fixture(autouse=True)
def declared(monkeypatch):
    monkeypatch.setitem(CATALOGUE, NAME, FADE)


def faded(loss=LOSS):
    return replace(ROBOT, effects={NAME: {'loss': loss}})


@pytest.mark.parametrize('consumer', ['nmpc', 'training'])
def test_a_consumer_without_the_quantity_leaves_the_effect_out_with_a_reason(consumer):
    treatment = effects.treatment(consumer, NAME)
    assert not treatment.acts and 'no charge was drawn' in treatment.reason
    found = np.concatenate([np.ravel(part) for part in OUTPUTS[consumer](faded())])
    np.testing.assert_array_equal(found, plain(consumer))


def test_the_plant_applies_it():
    assert effects.treatment('plant', NAME).acts
    found = np.concatenate([np.ravel(part) for part in OUTPUTS['plant'](faded(2.0))])
    assert not np.array_equal(found, plain('plant'))


@pytest.mark.parametrize('current', ['negative', 'positive', 'partly unknown'])
def test_the_charge_is_the_integral_of_the_current_since_the_first_message(current):
    made, motion = recording(), Motion()
    values = made.values['battery_state']
    values[:, 1] *= -1 if current == 'positive' else 1
    if current == 'partly unknown':
        values[10:20, 1] = np.nan
    flight = prepare(made, ROBOT, P)
    assert not flight.findings
    expected = np.interp(flight.start + flight.battery_t, motion.t, motion.charge)
    np.testing.assert_allclose(flight.battery[:, 1], expected, atol=1e-6)


def test_without_a_current_no_charge_is_drawn_and_the_voltage_is_kept():
    made = recording()
    made.values['battery_state'][:, 1] = np.nan
    flight = prepare(made, ROBOT, P)
    signals = Signals(flight, ROBOT, P)
    assert not flight.findings and not signals.charge.any()
    assert signals.voltage.max() < 1


def test_the_gap_finder_identifies_it_with_an_interval_that_covers_the_truth(tmp_path):
    beetle_omni_ros.simulate('hover', THREE_POSES[:2], plant=faded(), seed=1,
                             bag=tmp_path / 'flight')
    console = Console(file=io.StringIO(), width=200)
    found = gap_results([tmp_path / 'flight'], apply=tmp_path / 'new.yaml', console=console)
    assert found['verdict'] == 'named'
    effect, = found['effects']
    assert effect['names'] == [NAME]
    loss = effect['parameters']['loss']
    low, high = loss['interval']
    assert low < LOSS < high and high - low < LOSS, loss
