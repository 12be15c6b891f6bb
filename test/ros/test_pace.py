"""A flight in real time on a computer that is too slow is flown again in simulated time."""

import os
from types import SimpleNamespace

import pytest
from synthetic_flights import fly

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.model.mode import Mode
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.ros import fly as fly_module

FELL, LATE = 'emergency', 'this computer was too slow, it says'


@pytest.mark.parametrize('options, outcome, clocks', [
    ({}, (FELL, LATE), ['system', 'simulated']), ({}, ('', LATE), ['system']),
    ({}, (FELL, ''), ['system']), ({'clock': 'simulated'}, (FELL, LATE), ['simulated']),
    ({'clock': 'system'}, (FELL, LATE), ['system']),
    ({'actuators': 'emulated'}, (FELL, LATE), ['system'])])
def test_a_late_flight_is_kept_and_flown_again_where_the_clock_is_free(
        tmp_path, monkeypatch, capfd, options, outcome, clocks):
    bag, flown = tmp_path / 'bag', []

    def flight(graph, controller, task, console, clock, choice):
        flown.append(clock)
        assert ('joint_bridge_node' in graph.nodes) is (clock == 'system')
        with BagWriter(bag) as writer:
            fly(writer, task)
        return outcome if len(flown) == 1 else ('', '')

    monkeypatch.setattr(fly_module, '_fly', flight)
    monkeypatch.setattr(fly_module, 'viewer_process', lambda *_: open(os.devnull))
    status = fly_module.run_fly(task='random2', bag=bag, view=True, **options)
    out = capfd.readouterr().out
    assert flown == clocks and status == bool(outcome[0] and len(clocks) == 1)
    assert read_bag(bag).meta['clock'] == clocks[-1]
    assert (f'{LATE}: flown again in simulated time' in out) is (len(clocks) > 1)
    assert (tmp_path / 'bag_late').exists() is (len(clocks) > 1)
    assert f'files: {bag / "flight.html"}' in out.splitlines()
    assert '__VISER_EMBED_DATA__' in (bag / 'flight.html').read_text()


@pytest.mark.parametrize('states, lost, values, answer, text', [
    (['fallback:commands_late'], 0.0, {'fault.commands_late': '3.0'}, '', 'came late'),
    (['fallback'], 0.0, {'nmpc.refused.stale stamp': 4}, '', 'came late'),
    (['fallback'], 0.0, {'nmpc.refused.jump': 4}, '', ''),
    (['flying:nmpc'], 0.0, {'nmpc.refused.stale stamp': 4}, '', ''),
    (['fallback'], 0.2, {}, '', 'the simulator fell 0.2 s behind'),
    (['disarmed'], 0.0, {}, 'ekf_node late: the computer is too slow', 'came late')])
@pytest.mark.parametrize('choice', [True, False])
def test_a_fallback_with_late_messages_ends_a_flight_that_may_be_flown_again(
        states, lost, values, answer, text, choice):
    flight = fly_module.Flight(SimpleNamespace(domain=77, nodes={}, dead=dict), 'nmpc', None,
                               lambda text: None, choice)
    try:
        flight._lost_before, flight._answer = 1.0, answer
        flight.states = [Mode(state) for state in states]
        flight.state = flight.states[-1]
        for name, found in ((fly_module.PACING, {'lost_s': 1.0 + lost}),
                            (fly_module.SUPERVISOR_STATUS, values)):
            flight.diagnostics[name] = SimpleNamespace(values=found, level=0)
        assert flight.slow().endswith(text) and bool(flight.slow()) is bool(text)
        if choice and text and states[0].startswith('fallback'):
            with pytest.raises(RunError, match=text):
                flight.spin(0.0)
        else:
            flight.spin(0.0)
    finally:
        flight.close()
