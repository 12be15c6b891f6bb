"""The pace of a computer, measured before a flight, and the clock that follows from it."""

import os
import time
from types import SimpleNamespace

import pytest
from synthetic_flights import fly

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.ros import fly as fly_module
from beetle_omni_ros.ros import fly as pace
from beetle_omni_ros.ros.graph import plan


@pytest.mark.parametrize('cost, cores, text', [
    (0.2, {0, 1}, ''), (0.2, {0}, 'real time needs 2 cores, this computer has 1'),
    (0.3, {0, 1}, 'needs 120 % of a core, expected at most 95 %')])
def test_a_slow_computer_or_one_core_is_named_and_a_stall_does_not_count(
        monkeypatch, cost, cores, text):
    clock, stalls = [0.0], [5.0]

    def run(duration):
        clock[0] += cost * duration + (stalls.pop() if stalls else 0.0)

    monkeypatch.setattr(pace, '_loop', lambda *_: SimpleNamespace(take_off=lambda: None, run=run))
    monkeypatch.setattr(time, 'perf_counter', lambda: clock[0])
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: cores)
    share, reason = pace.too_slow({}, None)
    assert share == pytest.approx(pace.GRAPH * cost)
    assert reason.endswith(text) and bool(reason) is bool(text)


def test_the_pace_of_this_computer_is_measured_and_its_priority_restored():
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    share, _ = pace.too_slow(plan('hover', task='hover', standby=False)[0], None)
    assert 0 < share < 10
    assert (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority) == before


@pytest.mark.parametrize('actuators, slow, clock, said', [
    (None, 'slow', 'simulated', 'slow; simulated time is used'),
    (None, '', 'system', 'real time: the flight needs 50 % of a core'),
    ('emulated', 'slow', 'system', 'slow; emulated devices have real time only')])
def test_a_flight_says_its_clock_before_it_starts_and_leaves_a_film(
        tmp_path, monkeypatch, capfd, actuators, slow, clock, said):
    bag, printed = tmp_path / 'bag', []

    def flown(graph, controller, task, *_):
        printed.append(capfd.readouterr().out)
        assert ('joint_bridge_node' in graph.nodes) is (clock == 'system')
        with BagWriter(bag) as writer:
            fly(writer, task)
        return '', ''

    monkeypatch.setattr(fly_module, '_fly', flown)
    monkeypatch.setattr(fly_module, 'too_slow', lambda *_: (1.2 if slow else 0.5, slow))
    monkeypatch.setattr(fly_module, 'viewer_process', lambda *_: open(os.devnull))
    fly_module.run_fly(task='random2', bag=bag, actuators=actuators, view=True)
    assert printed == [said + '\n']
    assert read_bag(bag).meta['clock'] == clock
    assert f'files: {bag / "flight.html"}' in capfd.readouterr().out.splitlines()
    assert '__VISER_EMBED_DATA__' in (bag / 'flight.html').read_text()
