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
from sensor_msgs.msg import Imu, JointState
from witness import HEADER, READY, Witness

from beetle_omni_ros.control.base import Command
from beetle_omni_ros.messages import conversions
from beetle_omni_ros.messages.topics import COMMAND, SENSOR
from beetle_omni_ros.nodes import wire
from beetle_omni_ros.nodes.graph import Graph
from beetle_omni_ros.runs.bag import read_bag
from beetle_omni_ros.runs.metrics import metrics
from beetle_omni_ros.runs.tasks import make_task

NODES = ('recorder_node', 'sim_node', 'ekf_node', 'nmpc_node', 'supervisor_node',
         'reference_node')


@pytest.fixture
def flight(ros_domain, tmp_path):
    """Separate processes, flying a long pose task; (graph, witness, bag)."""
    task, bag = tmp_path / 'poses.csv', tmp_path / 'bag'
    task.write_text(HEADER + '0,0,1.1,0,0,0\n0.3,0,1.1,15,0,0\n' * 20)
    parameters = {name: {} for name in NODES}
    parameters['recorder_node'] = {'bag': str(bag)}
    parameters['reference_node'] = {'task': str(task)}
    graph = Graph(parameters, tmp_path, ros_domain, composed=False, simulated=True)
    witness = None
    try:
        graph.start()
        witness = Witness(ros_domain)
        assert witness.wait(lambda: witness.ready and witness.progress, READY), graph.dead()
        witness.take_off(lambda: witness.progress.startswith('flying'))
        yield graph, witness, bag
    finally:
        stubborn = graph.stop()
        if witness:
            witness.close()
    assert not stubborn


def logged(graph, name):
    return graph.log(name).read_text()


@pytest.mark.simulated_time
def test_the_loss_of_recorder_reference_controller_and_estimator(flight):
    graph, witness, bag = flight
    witness.spin(2)
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


@pytest.mark.simulated_time
def test_the_loss_of_the_supervisor_stops_the_rotors_within_100_ms(flight):
    graph, witness, bag = flight
    witness.spin(1)
    assert witness.truth.position[2] > 0.8
    graph.kill('supervisor_node')
    witness.spin(1.5)
    assert graph.dead().keys() == {'supervisor_node'}
    assert not witness.call('land', timeout=0.5)[0]
    assert not graph.stop()
    log = read_bag(bag)
    last = log.command_received[-1]
    # From 0.1 s after the last command the rotors slow down with a time constant of 0.094 s.
    falling = (log.imu_t > last + 0.1) & (log.imu_t < last + 0.6)
    force = np.linalg.norm(log.imu_specific_force[falling], axis=1)
    before = (log.imu_t > last - 0.5) & (log.imu_t < last)
    assert np.linalg.norm(log.imu_specific_force[before], axis=1).min() > 7
    assert force.min() < 2.0
    drop = log.truth_velocity[(log.truth_t > last + 0.1) & (log.truth_t < last + 0.5), 2]
    assert drop.min() < -1.0


def test_bad_messages_are_refused_counted_and_change_nothing(ros_domain, tmp_path):
    graph = Graph({'sim_node': {}, 'ekf_node': {}}, tmp_path, ros_domain)
    witness = None
    try:
        graph.start()
        witness = Witness(ros_domain)
        poses = witness._node.create_publisher(Imu, 'imu/data_raw', wire.profile(SENSOR))
        commands = witness._node.create_publisher(JointState, 'command', wire.profile(COMMAND))
        assert witness.wait(lambda: 'ekf_node: estimator' in witness.diagnostics
                            and poses.get_subscription_count() > 0
                            and commands.get_subscription_count() > 1, 20)
        broken = Imu()
        conversions.set_time(broken.header.stamp, time.time())
        broken.linear_acceleration.x = float('nan')
        stale = Imu()
        conversions.set_time(stale.header.stamp, time.time() - 30)
        late = wire.message('command', Command(time.time() - 1, np.zeros(4), np.full(4, 20.0)))
        for _ in range(5):
            poses.publish(broken)
            poses.publish(stale)
            commands.publish(late)
            witness.spin(0.02)

        def counted(status, key):
            return int(witness.values(status).get(key, 0))

        refused = 'imu/data_raw rejected: '
        assert witness.wait(lambda: counted(
            'ekf_node: inputs', f'{refused}linear_acceleration is not finite') == 5, 5)
        assert witness.wait(lambda: counted('ekf_node: inputs', f'{refused}stale stamp') >= 5, 5)
        assert witness.wait(lambda: counted(
            'sim_node: inputs', 'command rejected: stale stamp') == 5, 5)
        assert witness.diagnostics['ekf_node: estimator'].message == 'tracking'
        assert not graph.dead()
    finally:
        graph.stop()
        if witness:
            witness.close()


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


@pytest.mark.simulated_time
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


@pytest.mark.real_time
@pytest.mark.parametrize('arrangement', ['composed', 'separate'])
def test_an_interrupt_stops_every_process(tmp_path, arrangement):
    process, _, _ = fly(tmp_path, '0,0,1,0,0,0\n', arrangement)
    expected = 1 if arrangement == 'composed' else len(NODES)
    deadline = time.monotonic() + 30
    try:
        while len(nodes := children(process.pid)) < expected:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        time.sleep(1)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=30)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 130 and 'interrupted' in error
    assert not any(Path(f'/proc/{pid}').exists() for pid in nodes.values())


@pytest.mark.parametrize('argument, value, named', [
    ('bag', '/tmp', '/tmp: exists already'),
    ('task', 'somersault', 'somersault'),
    ('robot', '/nowhere.yaml', '/nowhere.yaml'),
    ('json_path', '/nowhere/result.json', '/nowhere/result.json'),
    ('controller', 'hoover', "controller 'hoover': expected one of nmpc, rl, rl_memory"),
    ('clock', 'sundial', "clock 'sundial': expected auto or system or simulated"),
    ('actuators', 'strings', "actuators 'strings': expected emulated or direct"),
    ('discovery', 'off', '--discovery OFF: the nodes of a flight would not find each other'),
])
def test_unusable_input_is_refused_before_anything_starts(capsys, argument, value, named):
    from beetle_omni_ros.nodes.fly import run_fly
    assert run_fly(**{argument: value}) == 2
    error = capsys.readouterr().err
    assert named in error and len(error.strip().splitlines()) == 1
