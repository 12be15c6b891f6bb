"""Flights on a computer that cannot keep real time."""

import io
from itertools import count
import time

import pytest
from rich.console import Console
from rich.progress import Progress

from beetle_omni_ros.nodes import fly
from beetle_omni_ros.nodes.fly import Flight, PACING
from beetle_omni_ros.robot.schema import RunError
from beetle_omni_ros.runs.tasks import make_task


class Nodes:
    """Stand-in for graph and operator of nodes that are ready and refuse to arm."""

    nodes, simulated, controller = ('sim_node',), False, 'nmpc'
    ready, progress, state, states = True, 'waiting', 'disarmed', []
    diagnostics = {PACING: None}

    def __init__(self, lost=0.0):
        self._lost, self._looks = lost, count()

    def values(self, name):
        return {'lost_s': str(self._lost * next(self._looks))}

    def countdown(self, seconds):
        yield from range(3)

    def dead(self):
        return {}

    def waits_for(self, bridges):
        return ''

    def call(self, name):
        return False, 'not level'

    def time(self):
        return time.monotonic()

    def spin(self, seconds):
        pass


@pytest.mark.parametrize(('lost', 'expected'), [
    (0.0, 'refuses to arm: not level$'),
    (0.5, 'refuses to arm: not level; this computer was too slow, the simulator fell 0.5 s')])
def test_a_failed_flight_reports_whether_the_computer_was_too_slow(lost, expected):
    nodes = Nodes(lost)
    with Progress(console=Console(file=io.StringIO())) as bars, \
            pytest.raises(RunError, match=expected):
        Flight(nodes, nodes, make_task('hover'), bars).fly()


def busy(seconds):
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


@pytest.mark.parametrize(('wait', 'every', 'counts'), [
    (time.sleep, 1, False),     # other programs have the processor
    (busy, 10, False),          # single ticks are disturbed
    (busy, 1, True)])           # the computer is slow
def test_the_load_is_predicted_from_the_cpu_time_of_most_ticks(monkeypatch, wait, every, counts):
    step, ticks, before = fly.Simulator.step, count(), fly.needed_load()

    def slower(simulator):
        if next(ticks) % every == 0:
            wait(0.005)         # a whole core
        return step(simulator)

    monkeypatch.setattr(fly.Simulator, 'step', slower)
    more = fly.needed_load() - before
    assert (more > 0.9 * fly.RELATIVE_LOAD) == counts
    assert counts or abs(more) < 0.2 * fly.RELATIVE_LOAD


@pytest.mark.parametrize(('load', 'options', 'simulated'), [
    (0.99, {}, True), (0.5, {}, False), (0.99, {'clock': 'system'}, False),
    (0.5, {'clock': 'simulated'}, True), (0.99, {'actuators': 'emulated'}, False)])
def test_fly_leaves_real_time_only_if_asked_or_needed_and_reports_it(monkeypatch, tmp_path, load,
                                                                     options, simulated):
    flown = []
    monkeypatch.setattr(fly, '_fly', lambda graph, controller, task, meta, console, faults:
                        flown.append((graph, meta)) or 1)    # flown, but without a bag
    monkeypatch.setattr(fly, 'needed_load', lambda: load)
    text = io.StringIO()
    assert fly.run_fly(bag=tmp_path / 'bag', domain_id=1, console=Console(file=text, width=300),
                       **options) == 1
    (graph, meta), = flown
    assert graph.simulated == simulated and meta['clock'] == (
        'simulated' if simulated else 'system')
    assert ({'joint_bridge_node', 'rotor_bridge_node'} <= set(graph.nodes)) != simulated
    assert ('the nodes would need 99% of a core' in text.getvalue()) == (
        simulated and not options)
