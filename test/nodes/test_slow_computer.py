"""Flights on a computer that cannot keep real time."""

import io
from itertools import count
import subprocess
import sys
import time

import pytest
from rich.console import Console
from rich.progress import Progress

from beetle_omni_ros.nodes import fly, speed
from beetle_omni_ros.nodes.flight import Flight, PACING, TooSlowError
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


@pytest.mark.real_time
def test_a_simulator_that_falls_behind_is_detected_before_arming():
    with pytest.raises(TooSlowError, match='the simulator fell 0.5 s behind in 2 s'):
        flown(Nodes(lost=0.5), may_be_slow=False)
    with pytest.raises(RunError, match='refuses to arm: not level') as raised:
        flown(Nodes(lost=0.5))              # with may_be_slow, it is attempted
    assert raised.type is RunError


@pytest.mark.real_time
def test_a_failed_flight_reports_the_time_that_the_simulator_lost():
    with pytest.raises(RunError, match='refuses to arm: not level$') as raised:
        flown(Nodes(), may_be_slow=False)
    assert raised.type is RunError
    with pytest.raises(TooSlowError, match='refuses to arm: not level; the simulator fell 0.2 s'):
        flown(Nodes(lost=0.1), may_be_slow=False)


@pytest.mark.real_time
@pytest.mark.parametrize('may_be_slow', [True, False])
def test_a_flight_that_fails_after_a_pause_reports_the_pause(may_be_slow):
    class Paused(Nodes):
        states = ['fallback:supervisor_paused', 'emergency_stop:crash']

    with pytest.raises(RunError, match='refuses to arm: not level; the simulator fell 0.0 s '
                       'behind in .* s, and supervisor_node was not scheduled') as raised:
        flown(Paused(), may_be_slow=may_be_slow)
    assert (raised.type is TooSlowError) != may_be_slow


@pytest.mark.real_time
def test_a_fault_that_prevents_take_off_ends_the_attempt_at_once():
    class Jammed(Nodes):
        states, waited = [], 0

        def call(self, name):
            return True, ''

        def spin(self, seconds):
            super().spin(seconds)
            self.waited += 1
            self.states.append('disarmed:joint1_jammed')

        def countdown(self, seconds):
            yield from range(100)

    nodes = Jammed()
    with pytest.raises(RunError, match='no take-off in 3 attempts'):
        flown(nodes)
    assert nodes.waited < 20


def busy(seconds):
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


@pytest.mark.parametrize(('wait', 'every', 'counts'), [
    (time.sleep, 1, False),     # other programs have the processor
    (busy, 10, False),          # single ticks are disturbed
    (busy, 1, True)])           # the computer is slow
def test_the_load_is_predicted_from_the_cpu_time_of_most_ticks(monkeypatch, wait, every, counts):
    step, ticks, before = speed.Simulator.step, count(), speed.load(NODES)

    def slower(simulator):
        if next(ticks) % every == 0:
            wait(0.005)         # a whole core
        return step(simulator)

    monkeypatch.setattr(speed.Simulator, 'step', slower)
    more = (speed.load(NODES) - before) / len(NODES)
    assert (more > 0.9 * speed.PER_NODE) == counts
    assert counts or abs(more) < 0.2 * speed.PER_NODE


def test_a_slow_computer_is_detected_within_five_seconds_of_the_command(tmp_path):
    # CPU time of the whole command until the first process of a graph would start.
    done = subprocess.run(
        [sys.executable, '-c', 'import sys, time\n'
         'from beetle_omni_ros import cli\n'
         'from beetle_omni_ros.nodes import fly, speed\n'
         'speed.MAX_LOAD = 0.0\n'
         'def start(*_):\n'
         '    print(time.process_time(), flush=True)\n'
         '    raise KeyboardInterrupt\n'
         'fly.Graph.start = start\n'
         f'sys.exit(cli.main(["fly", "--bag", {str(tmp_path / "bag")!r}]))'],
        capture_output=True, text=True, timeout=120, check=False)
    line, used = done.stdout.replace('\n', ' ').strip().rsplit(' ', 1)
    assert 'too slow for real time: the nodes would need' in line
    assert float(used) < 5.0


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
    monkeypatch.setattr(speed, 'load', lambda nodes: 0.99)
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
    monkeypatch.setattr(speed, 'load', lambda nodes: 0.5)
    assert 'too slow for real time: the simulator fell 0.5 s behind' in run('b')
    (real, real_meta, _), (slow, _, _) = attempts
    assert not real.simulated and real_meta['actuators'] == 'emulated' and slow.simulated
    assert {'joint_bridge_node', 'rotor_bridge_node'} <= set(real.nodes)


@pytest.mark.parametrize('clock', ['system', 'simulated'])
def test_a_requested_clock_is_kept(attempts, tmp_path, clock):
    fly.run_fly(clock=clock, bag=tmp_path / 'bag', domain_id=1,
                console=Console(file=io.StringIO()))
    assert [(graph.simulated, may) for graph, _, may in attempts] == [
        (clock == 'simulated', True)]


def test_requested_serial_devices_need_real_time(attempts, tmp_path):
    fly.run_fly(actuators='emulated', bag=tmp_path / 'bag', domain_id=1,
                console=Console(file=io.StringIO()))
    assert [(graph.simulated, may) for graph, _, may in attempts] == [(False, True)]


def test_simulated_time_with_serial_devices_is_refused(capsys):
    assert fly.run_fly(clock='simulated', actuators='emulated') == 2
    assert "actuators 'emulated': serial devices keep real time" in capsys.readouterr().err
