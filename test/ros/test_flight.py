"""
Flights of real processes, and consequences of a killed process.

Each test has its own ROS domain and folders, so that tests can run at the same
time. The robot is observed through ground_truth/odom, which does not depend on other nodes.
"""

from contextlib import closing
import os
from pathlib import Path
import re
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from synthetic_flights import fly, write_state, write_truth
from witness import HEADER, READY, running_graph

from beetle_omni_ros.bags.bag import read_bag
from beetle_omni_ros.bags.bag_writer import BagWriter
from beetle_omni_ros.bags.metrics import metrics
from beetle_omni_ros.control.tasks import make_task
from beetle_omni_ros.model.schema import RunError
from beetle_omni_ros.ros import fly as fly_module
from beetle_omni_ros.ros.graph import Graph, in_simulated_time

OBSERVER = f'{Path(__file__).parents[2]}/examples/own_component.py:WrenchObserver'
NODES = ('recorder_node', 'sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node', 'reference_node')


def test_recorder_reference_controller_and_estimator_are_lost_one_after_another(ros_domain,
                                                                                tmp_path):
    task, bag = tmp_path / 'poses.csv', tmp_path / 'bag'
    task.write_text(HEADER + '0,0,1.1,0,0,0\n0.3,0,1.1,15,0,0\n' * 20)
    parameters = {name: {} for name in NODES}
    parameters['recorder_node'] = {'bag': str(bag)}
    parameters['reference_node'] = {'task': str(task)}
    with running_graph(in_simulated_time(parameters), tmp_path, ros_domain,
                       groups={name: [name] for name in parameters},
                       ready=lambda one: one.ready and one.progress) as (graph, witness):
        witness.take_off()
        loses_one_node_after_another(graph, witness, bag)


def loses_one_node_after_another(graph, witness, bag):
    assert witness.stays_in_the_air(1.0)
    killed_at = witness.truth.stamp
    graph.kill('recorder_node')
    assert witness.stays_in_the_air(0.5)
    log = read_bag(bag)
    assert killed_at - 0.6 < log.imu.t[-1] < killed_at + 0.1
    assert len(log.imu.t) > 400 and len(log.command.t) > 100 and log.targets

    graph.kill('reference_node')
    assert witness.stays_in_the_air(0.5)
    assert witness.state == 'flying:nmpc'

    graph.kill('nmpc_node')
    assert witness.wait(lambda: witness.state == 'fallback', 2)
    assert witness.stays_in_the_air(1.5)
    assert np.linalg.norm(witness.truth.velocity) < 0.5
    assert witness.wait(lambda: 'nmpc_node silent' in graph.log('supervisor_node').read_text(), 5)

    graph.kill('ekf_node')
    assert witness.wait(lambda: witness.state == 'landing', 5), witness.states
    # the state is published before the line is logged
    assert witness.wait(lambda: 'ekf_node silent' in graph.log('supervisor_node').read_text(), 5)
    sinking = []
    assert witness.wait(lambda: sinking.append(witness.truth.velocity[2])
                        or witness.state == 'disarmed', 15)
    assert min(sinking) > -0.8                  # controlled, no fall
    witness.spin(1)
    assert witness.truth.position[2] < 0.4 and np.linalg.norm(witness.truth.velocity) < 0.1
    assert np.all(witness.last_command[1].thrust == 0)
    assert set(graph.dead()) == {'recorder_node', 'reference_node', 'nmpc_node', 'ekf_node'}
    flight = fly_module.Flight(graph, 'nmpc', make_task('hover'), print)
    with closing(flight), pytest.raises(RunError, match=r'ekf_node died \(ended by SIGKILL\)'):
        flight.spin(0.0)


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGKILL])
def test_a_signal_ends_a_flight_cleanly_and_the_bag_says_so(tmp_path, number):
    task, bag, temporary = tmp_path / 'poses.csv', tmp_path / 'bag', tmp_path / 'tmp'
    task.write_text(HEADER + '0,0,1.2,0,0,0\n' * 10)
    temporary.mkdir()
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros', 'fly', '--task', str(task), '--bag',
         str(bag), '--alone', '--clock', 'simulated', '--component', OBSERVER],
        stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, 'TMPDIR': str(temporary)})
    deadline = time.monotonic() + READY
    try:
        while not any(b'flying:nmpc' in file.read_bytes() for file in bag.glob('*.mcap')):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.2)
        for _ in range(2):
            process.send_signal(number)
            time.sleep(0.1)
        printed, error = process.communicate(timeout=60)    # also of the nodes
    finally:
        process.kill()
        process.communicate()
    kept, (first, *lines) = 'interrupted; kept what was flown', printed.splitlines()
    assert first.startswith('to watch: beetle_omni view --domain-id ')
    if number == signal.SIGTERM:
        assert not list(temporary.iterdir()) and process.returncode == 130
        assert 'interrupted at ' in printed and kept in lines
        assert lines[-4:-2] == [f'files: {bag}', f"files: {bag / 'nodes.log'}"]
        assert error == 'beetle_omni: error: interrupted\n'
    while not (bag / 'metadata.yaml').exists():     # the nodes outlive a killed `fly`
        assert time.monotonic() < deadline
        time.sleep(0.1)
    log = read_bag(bag)
    assert log.warnings == [kept] and log.states[-1] == 'flying:nmpc' and log.meta['interrupted']
    assert log.meta['task'] == str(task)
    assert any(b'/observer/force' in file.read_bytes() for file in bag.glob('*.mcap'))
    result = metrics(log, make_task(str(tmp_path / 'poses.csv')))
    assert not result['crashed'] and len(result['poses']) < 10


def test_bridges_stop_first_except_in_flight(tmp_path, monkeypatch):
    graph, ended = Graph({}, tmp_path, 0), []
    graph.processes = {'composed': None, 'bridges': None}
    monkeypatch.setattr(graph, '_end', lambda names: ended.extend(names) or [])
    graph.stop()
    graph.stop(in_flight=True)
    assert ended == ['bridges', 'composed', 'composed', 'bridges']


def test_warnings_are_in_the_order_of_time_each_once(tmp_path):
    graph = Graph({}, tmp_path, 0)
    graph.processes = {'one': None, 'two': None}
    graph.log('one').write_text('[WARN] [20.5] [a]: late\n[INFO] [21.0] [a]: no matter\n'
                                '[ERROR] [22.0] [b]: early\n'
                                '[WARN] [23.5] [a]: id 1: old, 62 ms\n')
    graph.log('two').write_text('[ERROR] [19.0] [b]: first\n[WARN] [23.0] [b]: late\n'
                                '[WARN] [24.0] [b]: id 1: old, 7.5 ms\n'
                                '[WARN] [25.0] [b]: id 2: old, 7.5 ms\n')
    assert graph.warnings() == ['[ERROR] [19.0] [b]: first', '[WARN] [20.5] [a]: late',
                                '[ERROR] [22.0] [b]: early',
                                '[WARN] [23.5] [a]: id 1: old, 62 ms',
                                '[WARN] [25.0] [b]: id 2: old, 7.5 ms']


@pytest.mark.parametrize('speed, actuators, advice', [
    (0.3, 'direct', 'try --clock simulated'),
    (3.0, 'emulated', 'close other programs, or try --actuators direct')])
def test_a_fall_in_the_landing_is_the_last_line_with_its_likely_cause(
        tmp_path, monkeypatch, capfd, speed, actuators, advice):
    bag = tmp_path / 'bag'

    def flown(graph, controller, task, *_):
        with BagWriter(bag) as writer:
            fly(writer, task)
            for t in np.arange(10, 11, 0.005):
                write_truth(writer, t, np.array([0, 0, 0.15]), np.array([0, 0, 0, 1.0]),
                            np.array([0, 0, -speed * (t == 10)]), np.zeros(3))
            write_state(writer, 10.5, 'disarmed')
        return '', 'this computer was too slow'

    monkeypatch.setattr(fly_module, '_fly', flown)
    assert fly_module.run_fly(task='random1', bag=bag, clock='system', standby=False,
                              actuators=actuators) == (speed > 1)
    out, err = capfd.readouterr()
    if speed > 1:
        assert err == ('beetle_omni fly: error: the robot fell in the landing; this computer was '
                       f'too slow: {advice}\n')
    else:
        assert not err and f'\nthis computer was too slow: {advice}\nfiles: ' in out
    assert 'landing [m/s]' in out


def test_a_full_disk_ends_the_flight_with_one_line_and_the_bag_is_readable(tmp_path):
    task, bag, limit = tmp_path / 'poses.csv', tmp_path / 'bag', 2 * 2**20
    task.write_text(HEADER + '0,0,1.2,0,0,0\n' * 10)
    done = subprocess.run(
        [sys.executable, '-m', 'beetle_omni_ros', 'fly', '--task', str(task), '--bag',
         str(bag), '--alone', '--clock', 'simulated', '--controller', 'hover'],
        capture_output=True, text=True, timeout=READY, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)))
    assert done.returncode == 1
    assert done.stderr == f'beetle_omni fly: error: {bag}: File too large\n'
    assert [line.partition(':')[0] for line in done.stdout.splitlines()] == [
        'to watch', 'files', 'files', 'next', 'next']
    times = re.findall(r'^\[\w+\] \[([0-9.]+)\]', (bag / 'nodes.log').read_text(), re.MULTILINE)
    assert len(times) > 9 and times == sorted(times)
    assert len(read_bag(bag).truth.t) > 100
