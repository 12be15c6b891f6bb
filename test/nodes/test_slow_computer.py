"""Flights on a computer that cannot keep real time."""

import io
from itertools import count
import time

import pytest
from rich.console import Console
from rich.progress import Progress

from beetle_omni_ros.nodes import fly
from beetle_omni_ros.nodes.fly import Flight, PACING, TooSlowError
from beetle_omni_ros.robot.schema import RunError
from beetle_omni_ros.runs.tasks import make_task

NODES = ('sim_node', 'ekf_node', 'nmpc_node')


class Nodes:
    """Stand-in for graph and operator of nodes that are ready and refuse to arm."""

    nodes, composed, simulated, controller = ('sim_node',), True, False, 'nmpc'
    ready, progress, state, states = True, 'waiting', 'disarmed', []
    diagnostics = {PACING: None}

    def __init__(self, lost=0.0):
        self._lost, self._looks = lost, count()

    def values(self, name):
        return {'lost_s': str(self._lost * next(self._looks))} if name == PACING else {}

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
        time.sleep(min(seconds, 0.05))


def flown(nodes, **options):
    with Progress(console=Console(file=io.StringIO())) as bars:
        Flight(nodes, nodes, make_task('hover'), bars, **options).fly()


class Paused(Nodes):
    """The same after a pause of the supervisor."""

    states = ['fallback:supervisor_paused', 'emergency_stop:crash']


@pytest.mark.real_time
@pytest.mark.parametrize(('nodes', 'may_be_slow', 'error', 'expected'), [
    (Nodes(lost=0.5), False, TooSlowError, 'the simulator fell 0.5 s behind in 2 s'),
    (Nodes(lost=0.5), True, RunError, 'refuses to arm: not level'),      # it is attempted
    (Nodes(), False, RunError, 'refuses to arm: not level$'),
    (Nodes(lost=0.1), False, TooSlowError, 'refuses to arm: not level; the simulator fell 0.2 s'),
    (Paused(), False, TooSlowError, 'and supervisor_node was not scheduled'),
    (Paused(), True, RunError, 'and supervisor_node was not scheduled')])
def test_a_failed_flight_reports_whether_the_computer_was_too_slow(nodes, may_be_slow, error,
                                                                   expected):
    with pytest.raises(RunError, match=expected) as raised:
        flown(nodes, may_be_slow=may_be_slow)
    assert raised.type is error


def busy(seconds):
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


@pytest.mark.parametrize(('wait', 'every', 'counts'), [
    (time.sleep, 1, False),     # other programs have the processor
    (busy, 10, False),          # single ticks are disturbed
    (busy, 1, True)])           # the computer is slow
def test_the_load_is_predicted_from_the_cpu_time_of_most_ticks(monkeypatch, wait, every, counts):
    step, ticks, before = fly.Simulator.step, count(), fly.needed_load(NODES)

    def slower(simulator):
        if next(ticks) % every == 0:
            wait(0.005)         # a whole core
        return step(simulator)

    monkeypatch.setattr(fly.Simulator, 'step', slower)
    more = (fly.needed_load(NODES) - before) / len(NODES)
    assert (more > 0.9 * fly.PER_NODE) == counts
    assert counts or abs(more) < 0.2 * fly.PER_NODE


@pytest.fixture
def attempts(monkeypatch):
    """Graphs that `fly` started on a computer that is too slow."""
    graphs = []

    def one(graph, controller, task, meta, console, faults, may_be_slow):
        graphs.append((graph, dict(meta), may_be_slow))
        if not may_be_slow and not graph.simulated:
            raise TooSlowError('the simulator fell 0.5 s behind')
        return 1        # flown, but without a bag

    monkeypatch.setattr(fly, '_fly', one)
    monkeypatch.setattr(fly, 'needed_load', lambda nodes: 0.99)
    return graphs


def test_fly_changes_to_simulated_time_without_serial_devices_and_reports_it(
        attempts, tmp_path, monkeypatch):
    def run(name):
        attempts.clear()
        text = io.StringIO()
        assert fly.run_fly(bag=tmp_path / name, domain_id=1,
                           console=Console(file=text, width=300)) == 1
        return text.getvalue()

    assert 'too slow for real time: the nodes would need 99% of a core' in run('a')
    (slow, slow_meta, may_be_slow), = attempts      # nothing was started in real time
    assert slow.simulated and slow_meta['actuators'] == 'direct' and may_be_slow
    assert slow_meta['clock'] == 'simulated'
    assert not {'joint_bridge_node', 'rotor_bridge_node'} & set(slow.nodes)
    monkeypatch.setattr(fly, 'needed_load', lambda nodes: 0.5)
    assert 'too slow for real time: the simulator fell 0.5 s behind' in run('b')
    (real, real_meta, _), (slow, _, _) = attempts
    assert not real.simulated and real_meta['actuators'] == 'emulated' and slow.simulated
    assert {'joint_bridge_node', 'rotor_bridge_node'} <= set(real.nodes)


@pytest.mark.parametrize(('options', 'simulated'), [
    ({'clock': 'system'}, False), ({'clock': 'simulated'}, True),
    ({'actuators': 'emulated'}, False)])
def test_a_requested_clock_is_kept_and_serial_devices_need_real_time(attempts, tmp_path, options,
                                                                     simulated):
    fly.run_fly(bag=tmp_path / 'bag', domain_id=1, console=Console(file=io.StringIO()), **options)
    assert [(graph.simulated, may) for graph, _, may in attempts] == [(simulated, True)]
