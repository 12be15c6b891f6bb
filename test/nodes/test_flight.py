"""
Flights of real processes, and consequences of a killed process.

Each test has its own ROS domain and folders, so that tests can run at the same
time. The robot is observed through ground_truth/odom, which does not depend on other nodes.
"""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from witness import HEADER, READY, running_graph

from beetle_omni_ros.nodes.graph import in_simulated_time
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.metrics import metrics
from beetle_omni_ros.runs.tasks import make_task

NODES = ('recorder_node', 'sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node',
         'reference_node')


def logged(graph, name):
    return graph.log(name).read_text()


def test_switches_and_the_loss_of_recorder_reference_controller_and_estimator(ros_domain,
                                                                              tmp_path):
    task, bag = tmp_path / 'poses.csv', tmp_path / 'bag'
    task.write_text(HEADER + '0,0,1.1,0,0,0\n0.3,0,1.1,15,0,0\n' * 20)
    parameters = {name: {} for name in (*NODES, 'rl_node')}
    parameters['recorder_node'] = {'bag': str(bag)}
    parameters['reference_node'] = {'task': str(task)}
    with running_graph(in_simulated_time(parameters), tmp_path, ros_domain, composed=False,
                       ready=lambda one: one.ready and one.progress) as (graph, witness):
        witness.take_off(lambda: witness.progress.startswith('flying'))
        switches(witness)
        loses_one_node_after_another(graph, witness, bag)


def switches(witness):
    """Select each controller some times; test/evaluation checks that no command jumps."""
    names = ['rl', 'nmpc'] * 3
    for name in names:
        assert witness.stays_in_the_air(0.5)
        assert witness.wait(lambda name=name: witness.set(
            'supervisor_node', 'controller', name)[0], 10)
        assert witness.wait(lambda name=name: witness.state == f'flying:{name}', 2), witness.states
    assert not witness.set('supervisor_node', 'controller', 'pid')[0]
    first = witness.states.index('flying:nmpc')
    assert witness.states[first:] == ['flying:nmpc', *(f'flying:{name}' for name in names)]


def loses_one_node_after_another(graph, witness, bag):
    """Kill a node, and observe how the others go on."""
    killed_at = witness.time()
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
    assert 'nmpc_node silent' in logged(graph, 'supervisor_node')

    graph.kill('ekf_node')
    assert witness.wait(lambda: witness.state == 'landing', 2)
    assert 'ekf_node silent' in logged(graph, 'supervisor_node')
    sinking = []
    assert witness.wait(lambda: sinking.append(witness.truth.velocity[2])
                        or witness.state == 'disarmed', 15)
    assert min(sinking) > -0.8                  # controlled, no fall
    witness.spin(1)
    assert witness.truth.position[2] < 0.4 and np.linalg.norm(witness.truth.velocity) < 0.1
    assert np.all(witness.last_command[1].thrust == 0)
    assert set(graph.dead()) == {'recorder_node', 'reference_node', 'nmpc_node', 'ekf_node'}
    assert 'SIGKILL' in graph.dead()['ekf_node']


FLY = ('import sys\nfrom pathlib import Path\nfrom beetle_omni_ros.nodes.fly import run_fly\n'
       'composed = sys.argv[4] == "composed"\n'
       'sys.exit(run_fly(task=sys.argv[1], bag=Path(sys.argv[2]), json_path=Path(sys.argv[3]), '
       'composed=composed, standby=composed, clock=sys.argv[5]))')


def fly(tmp_path, poses, arrangement, clock='auto'):
    """Start a flight by the command line; (process, bag, result file)."""
    task, bag, result = tmp_path / 'poses.csv', tmp_path / 'run', tmp_path / 'result.json'
    task.write_text(HEADER + poses)
    environment = dict(os.environ)
    environment.pop('ROS_DOMAIN_ID', None)
    return subprocess.Popen(
        [sys.executable, '-c', FLY, str(task), str(bag), str(result), arrangement, clock],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment), bag, result


def children(pid):
    """Node name -> process id of the nodes that a flight started."""
    found = {}
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            parent = int(entry.joinpath('stat').read_text().rsplit(')', 1)[1].split()[1])
            words = entry.joinpath('cmdline').read_text().split('\0')
        except OSError:
            continue
        if parent == pid and '-m' in words:
            found[words[words.index('-m') + 2]] = int(entry.name)
    return found


@pytest.mark.alone
def test_one_call_flies_and_the_bag_gives_the_printed_numbers(tmp_path):
    process, bag, result = fly(tmp_path, '0.3,0,1,20,0,0\n', 'composed')
    output, error = process.communicate(timeout=READY)
    assert process.returncode == 0, error
    results = json.loads(result.read_text())
    # A slow computer flies in simulated time, in which latencies have no meaning.
    real = results['meta']['clock'] == 'system'
    assert 'CPU' in output and ('latency' if real else 'of real time') in output
    assert results['nmpc']['success_rate'] == 1.0 and len(results['nmpc']['poses']) == 1
    assert results['meta']['graph']['cpu_percent'] > 0
    again = metrics(read_bag(bag), make_task(str(tmp_path / 'poses.csv')))
    assert again['poses'] == results['nmpc']['poses']
    assert again['compute_ms'] == results['nmpc']['compute_ms']
    assert read_bag(bag).meta['task'] == str(tmp_path / 'poses.csv')


def test_a_killed_node_is_named_and_all_processes_end(tmp_path):
    process, bag, _ = fly(tmp_path, '0,0,1.2,0,0,0\n' * 10, 'separate', 'simulated')
    deadline, nodes = time.monotonic() + READY, {}
    try:
        while not (bag.is_dir() and b'flying:nmpc' in newest(bag)):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.2)
        nodes = children(process.pid)
        assert set(NODES) == set(nodes)
        os.kill(nodes['nmpc_node'], signal.SIGKILL)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 1
    assert 'nmpc_node died (ended by SIGKILL)' in error
    assert not any(Path(f'/proc/{pid}').exists() for pid in nodes.values())
    states = read_bag(bag).states
    assert [state.partition(':')[0] for state in states[-2:]] == ['landing', 'disarmed']


def newest(bag):
    """Return the raw bytes of a bag so far."""
    return b''.join(file.read_bytes() for file in bag.glob('*.mcap'))
