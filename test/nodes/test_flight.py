"""
Flights of real processes, and consequences of a killed process.

Each test has its own ROS domain and folders, so that tests can run at the same
time. The robot is observed through ground_truth/odom, which does not depend on other nodes.
"""

from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
from witness import HEADER, READY, running_graph

from beetle_omni_ros.nodes.graph import in_simulated_time
from beetle_omni_ros.runs.bag import read_bag

NODES = ('recorder_node', 'sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node',
         'reference_node')


def test_switches_and_the_loss_of_recorder_reference_controller_and_estimator(ros_domain,
                                                                              tmp_path):
    task, bag = tmp_path / 'poses.csv', tmp_path / 'bag'
    task.write_text(HEADER + '0,0,1.1,0,0,0\n0.3,0,1.1,15,0,0\n' * 20)
    parameters = {name: {} for name in (*NODES, 'rl_node')}
    parameters['recorder_node'] = {'bag': str(bag)}
    parameters['reference_node'] = {'task': str(task)}
    with running_graph(in_simulated_time(parameters), tmp_path, ros_domain,
                       groups={name: [name] for name in parameters},
                       ready=lambda one: one.ready and one.progress) as (graph, witness):
        witness.take_off()
        switches(witness)
        loses_one_node_after_another(graph, witness, bag)


def switches(witness):
    """Select each controller; test/evaluation checks that no command jumps."""
    names = ['rl', 'nmpc']
    for name in names:
        assert witness.stays_in_the_air(0.5)
        assert witness.wait(lambda name=name: witness.set(
            'supervisor_node', 'controller', name)[0], 10)
        assert witness.wait(lambda name=name: witness.state == f'flying:{name}', 2), witness.states
    assert not witness.set('supervisor_node', 'controller', 'pid')[0]
    first = witness.states.index('flying:nmpc')
    assert witness.states[first:] == ['flying:nmpc', *(f'flying:{name}' for name in names)]


def loses_one_node_after_another(graph, witness, bag):
    killed_at = witness.truth.stamp
    graph.kill('recorder_node')
    assert witness.stays_in_the_air(0.5)
    log = read_bag(bag)
    assert killed_at - 0.6 < log.imu_t[-1] < killed_at + 0.1
    assert len(log.imu_t) > 400 and len(log.command_t) > 100 and log.targets

    graph.kill('reference_node')
    assert witness.stays_in_the_air(0.5)
    assert witness.state == 'flying:nmpc'

    graph.kill('nmpc_node')
    assert witness.wait(lambda: witness.state == 'fallback', 2)
    assert witness.stays_in_the_air(1.5)
    assert np.linalg.norm(witness.truth.velocity) < 0.5
    assert 'nmpc_node silent' in graph.log('supervisor_node').read_text()

    graph.kill('ekf_node')
    assert witness.wait(lambda: witness.state == 'landing', 2)
    assert 'ekf_node silent' in graph.log('supervisor_node').read_text()
    sinking = []
    assert witness.wait(lambda: sinking.append(witness.truth.velocity[2])
                        or witness.state == 'disarmed', 15)
    assert min(sinking) > -0.8                  # controlled, no fall
    witness.spin(1)
    assert witness.truth.position[2] < 0.4 and np.linalg.norm(witness.truth.velocity) < 0.1
    assert np.all(witness.last_command[1].thrust == 0)
    assert set(graph.dead()) == {'recorder_node', 'reference_node', 'nmpc_node', 'ekf_node'}
    assert 'SIGKILL' in graph.dead()['ekf_node']


@contextmanager
def flying(tmp_path):
    """Fly by the command line; yield process and bag in flight."""
    task, bag, temporary = tmp_path / 'poses.csv', tmp_path / 'bag', tmp_path / 'tmp'
    task.write_text(HEADER + '0,0,1.2,0,0,0\n' * 10)
    temporary.mkdir()
    process = subprocess.Popen(
        [sys.executable, '-m', 'beetle_omni_ros.cli', 'fly', '--task', str(task), '--bag',
         str(bag), '--alone', '--clock', 'simulated'], stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL, text=True, env={**os.environ, 'TMPDIR': str(temporary)})
    deadline = time.monotonic() + READY
    try:
        while not any(b'flying:nmpc' in file.read_bytes() for file in bag.glob('*.mcap')):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.2)
        yield process, bag
    finally:
        process.kill()
        process.communicate()
    assert not list(temporary.iterdir())


def test_a_killed_process_is_named(tmp_path):
    with flying(tmp_path) as (process, bag):
        child, = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()
        os.kill(int(child), signal.SIGKILL)
        _, error = process.communicate(timeout=30)      # nobody waits for its answer
    assert process.returncode == 1
    assert 'composed died (ended by SIGKILL)' in error


def test_sigterm_ends_a_flight_cleanly_and_the_bag_is_complete(tmp_path):
    with flying(tmp_path) as (process, bag):
        for _ in range(2):
            process.send_signal(signal.SIGTERM)
            time.sleep(0.1)
        _, error = process.communicate(timeout=60)
    assert error.startswith('beetle_omni fly: error: interrupted; everything is stopped\n')
    assert process.returncode == 130
    log = read_bag(bag)
    assert not log.warnings and 'flying:nmpc' in log.states and log.meta['interrupted']
