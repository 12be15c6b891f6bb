"""The in-process flight: determinism, complete results, reported failures."""

from dataclasses import replace
import io
import json
import re
import resource
import signal
import subprocess
import sys
from textwrap import indent

import numpy as np
import pytest
from rich.console import Console

import beetle_omni_ros
from beetle_omni_ros import cli
from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control.tasks import make_task, Task
from beetle_omni_ros.flight import evaluate as command
from beetle_omni_ros.flight import loop
from beetle_omni_ros.flight.campaign import own_files
from beetle_omni_ros.model.parameters import RobotParameters
from beetle_omni_ros.model.schema import ParameterError
from beetle_omni_ros.sim.parameters import SimulatorParameters

ROBOT = RobotParameters.load()
CAPACITY = 0.0975   # [A h] of a pack that does not last for two poses


def evaluate(task, controllers=('nmpc',), **options):
    return command.run_evaluate(controllers=list(controllers),
                                task=task if isinstance(task, Task) else str(task),
                                console=Console(file=io.StringIO()), **options)


@pytest.fixture(scope='module')
def poses(tmp_path_factory):
    """A pose file with one near pose, for a short flight."""
    path = tmp_path_factory.mktemp('task') / 'poses.csv'
    path.write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0.3,0.2,1.1,30,-20,40\n')
    return path


@pytest.fixture(scope='module')
def flown(poses, tmp_path_factory):
    """Results and folder of one flight of two controllers: bags and result.json in it."""
    folder = tmp_path_factory.mktemp('flown')
    return evaluate(poses, ('nmpc', 'hover'), seed=3, bag=folder / 'bags',
                    json_path=folder / 'result.json'), folder


def test_the_json_has_the_keys_of_the_interface(flown):
    result = json.loads((flown[1] / 'result.json').read_text())
    assert {'task', 'conditions', 'seed', 'robot', 'version'} <= set(result['meta'])
    assert {'median', 'p99', 'max', 'deadline_misses'} <= set(result['nmpc']['compute_ms'])
    assert result['nmpc']['poses'][0]['reached']


def test_each_controller_has_a_bag_that_gives_the_numbers_of_its_flight(poses, flown):
    results, folder = flown
    assert set(results) == {'meta', 'nmpc', 'hover'}
    for name in ('nmpc', 'hover'):
        assert read_bag(folder / 'bags' / name).controllers() == [name]
    again = metrics(read_bag(folder / 'bags' / 'nmpc'), make_task(str(poses)))
    for key in ('mean', 'hover_command_change_rms'):
        for name, value in results['nmpc'][key].items():
            assert again[key][name] == pytest.approx(value, rel=1e-5, abs=1e-6)
    assert again['success_rate'] == results['nmpc']['success_rate'] == 1.0


def own(folder, step, name='Own', fields='pass'):
    """Reference to a class in a file of its own: hover, with ``step`` before each step."""
    path = folder / f'{name.lower()}.py'
    path.write_text('import os, signal\n'
                    'from beetle_omni_ros.control.hover import HoverController\n'
                    f'class {name}(HoverController):\n    high = None\n    {fields}\n'
                    f'    def step(self, state, target):\n{indent(step, 8 * " ")}\n'
                    '        return super().step(state, target)\n')
    return f'{path}:{name}'


def run(result, controllers, task, *more):
    """Status of the command."""
    return cli.main(['evaluate', '--controllers', controllers, '--task', str(task), '--json',
                     str(result), *more])


def test_a_crash_ends_the_command_with_status_1_after_the_results(poses, tmp_path):
    falls, result = own(tmp_path, """
command = super().step(state, target)
if target.position[2] == 1.1:       # of the task
    command.thrust[:] = 1.0 + 1e-3 * (state.stamp % 1)
return command"""), tmp_path / 'result.json'
    assert run(result, falls, poses) == 1
    assert json.loads(result.read_text())['own']['crashed']
    assert own_files(falls) == (tmp_path / 'own.py',) and own_files('nmpc') == ()


def test_an_exception_in_flight_falls_back_and_is_in_the_results(tmp_path):
    task = make_task('hover')
    task = replace(task, segments=(replace(task.segments[0], duration=4.0),))
    bad = own(tmp_path, """if target.position[2] == 1.0:       # of the task
    self.high = self.high or state.stamp
    if 1.0 < state.stamp - self.high < 1.2:
        return self.absent""", 'Bad')
    results = evaluate(task, [bad], bag=tmp_path / 'bag')['bad']
    states = read_bag(tmp_path / 'bag').states
    at = states.index('fallback:controller_silent')
    assert states[at - 1] == states[at + 1] == 'flying:bad'
    assert 'ended' not in results and not results['crashed']
    assert results['controller_error'].startswith(
        "controller 'bad': step raised AttributeError: 'Bad' object has no attribute 'absent' "
        '(bad.py:10)')


@pytest.fixture
def interruptible():
    """Ctrl-C as in a program of its own, whatever the test's process does with it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler


def test_ctrl_c_keeps_what_was_flown_and_marks_it(poses, tmp_path, capsys, interruptible):
    result, bags = tmp_path / 'result.json', tmp_path / 'bags'
    stops = own(tmp_path, """if target.position[2] == 1.1 and state.position[0] > 0.2:
    target.position[2] = 1.2    # once
    os.kill(os.getpid(), signal.SIGINT)""")
    assert run(result, f'hover,{stops}', poses, '--bag', str(bags)) == 130
    printed = capsys.readouterr()
    assert re.search(r'poses reached +1 of 1 +0 of 0 *\n', printed.out)
    assert printed.out.splitlines()[-6:-2] == [
        'interrupted; kept what was flown',
        *(f'files: {file}' for file in (bags / 'hover', bags / 'own', result))]
    assert printed.err == 'beetle_omni: error: interrupted\n'
    first, second = (read_bag(bags / name) for name in ('hover', 'own'))
    assert not first.warnings and second.warnings == ['interrupted; kept what was flown']
    assert 'interrupted' not in first.meta and second.meta['interrupted']
    results = json.loads(result.read_text())
    assert results['meta']['interrupted'] and results['hover']['success_rate'] == 1
    for of in (results['own'], metrics(second, make_task(str(poses)))):
        assert of['poses'] == [] and of['ended'].startswith('interrupted at ')
    page = beetle_omni_ros.read_run(bags / 'own').report(tmp_path / 'page.html').read_text()
    assert of['ended'] in page
    with pytest.raises(KeyboardInterrupt):
        beetle_omni_ros.simulate(stops, str(poses), bag=tmp_path / 'bag')
    assert read_bag(tmp_path / 'bag').meta['interrupted']


def test_a_full_disk_is_one_line_and_what_was_written_is_readable(poses, tmp_path):
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros', 'evaluate', '--controllers', 'hover',
         '--task', str(poses), '--bag', str(tmp_path / 'bag')], capture_output=True, text=True,
        check=False, preexec_fn=lambda: resource.setrlimit(
            resource.RLIMIT_FSIZE, (3 * 2**20, 3 * 2**20)))
    line, = done.stderr.splitlines()
    assert done.returncode == 1 and line.startswith(f"beetle_omni: error: {tmp_path / 'bag'}: ")
    log = read_bag(tmp_path / 'bag')
    assert len(log.truth.t) > 300 and 'cut off' in log.warnings[0]


def test_an_empty_pack_is_swapped_at_the_next_target(monkeypatch):
    monkeypatch.setattr(loop, 'SWAP_CHARGE', 0.0)   # by the warning of the supervisor only
    small = SimulatorParameters.load()
    small = replace(small, battery_capacity=CAPACITY)
    monkeypatch.setattr(SimulatorParameters, 'load', lambda: small)
    task = make_task('random2')
    log = command.fly('nmpc', task, robot=ROBOT, plant=ROBOT)
    assert not log.meta['crashed']
    assert metrics(log, task)['success_rate'] == 1.0
    drawn = -np.sum(log.battery.current[:-1] * np.diff(log.battery.t)) / 3600
    assert drawn > CAPACITY     # more than one pack holds


def test_faults_of_a_file_act_and_are_listed_in_the_results(tmp_path):
    task = make_task('random1')
    task = replace(task, segments=(replace(task.segments[0], duration=3.0),))
    path = tmp_path / 'faults.yaml'
    path.write_text('faults: {two: {strike: [{kind: mocap_lost, at: 1.0, duration: 0.1}, '
                    '{kind: controller_silent}]}}')
    results = evaluate(task, ('hover',), faults=path, bag=tmp_path / 'bag')
    listed = ['mocap_lost at=1 duration=0.1', 'controller_silent at=0']
    assert results['meta']['faults'] == listed
    log = read_bag(tmp_path / 'bag')
    assert log.meta['faults'] == listed
    assert 'fallback:controller_silent' in log.states


def test_a_task_beyond_the_declared_reach_of_a_controller_is_refused(tmp_path):
    far, near = tmp_path / 'far.csv', own(tmp_path, 'pass', fields='name, reach = "own", 3.0')
    far.write_text('x_m,y_m,z_m,roll_deg,pitch_deg,yaw_deg\n0,0,1,0,0,0\n4,0,1,0,0,0\n')
    with pytest.raises(ParameterError, match='row 3: 4 m from the pose before, .* at most 3 m'):
        evaluate(far, [near])
    with pytest.raises(ParameterError, match='pose 2: 4 m from the pose before, .* at most 3 m'):
        command.fly(near, make_task(str(far)), robot=ROBOT, plant=ROBOT)
