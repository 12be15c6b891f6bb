"""Processes of nodes: one-line refusals, one instance, clean ends."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.real_time
ROOT = Path(__file__).parents[2]


def start(node, *arguments, **popen):
    return subprocess.Popen([sys.executable, '-m', 'beetle_omni_ros.start', node, *arguments],
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **popen)


def finish(process, timeout=20):
    try:
        _, error = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return process.returncode, error


def wait_until_it_spins(process):
    """Wait until a node publishes; from then on it handles signals."""
    from beetle_omni_ros.ros.clients import Operator
    operator = Operator(int(os.environ['ROS_DOMAIN_ID']))
    try:
        assert operator.wait(lambda: operator.diagnostics, 15), 'no diagnostics'
    finally:
        operator.close()
    assert process.poll() is None


@pytest.mark.parametrize('node, arguments, named', [
    ('ekf_node', ['-p', 'imu.rat:=100.0'], "'imu.rat': unknown key; did you mean 'rate'"),
    ('ekf_node', ['--params-file', 'broken.yaml'], 'line 3'),
    ('composed absent.module:My', [], "no module 'absent'")])
def test_unusable_parameters_end_in_one_line_and_status_2(ros_domain, tmp_path, node, arguments,
                                                          named):
    (tmp_path / 'broken.yaml').write_text(
        '/**/ekf_node:\n  ros__parameters:\n    imu: {rate: [}\n')
    status, error = finish(start(*node.split(), '--ros-args', *arguments, cwd=tmp_path,
                                 env={**os.environ, 'PYTHONPATH': str(ROOT)}))
    assert status == 2
    line, = error.strip().splitlines()
    assert line.startswith(f'{node.split()[-1]}: error: ') and named in line


def test_a_diverged_plant_ends_the_process_in_one_line(ros_domain):
    script = ('import sys, beetle_omni_ros.sim.plant as plant\n'
              'from beetle_omni_ros.start import run\n'
              'plant.DIVERGED = 0.0\n'
              'sys.exit(run("composed"))\n')
    status, error = finish(subprocess.Popen(
        [sys.executable, '-c', script, 'sim_node', 'ekf_node'], stderr=subprocess.PIPE, text=True))
    assert status == 1
    *logged, line = error.strip().splitlines()
    assert line.startswith('composed: error: the simulated plant diverged: position [')
    assert all(each.startswith('[INFO]') for each in logged)


def test_a_node_names_missing_inputs_is_unique_and_ends_cleanly(ros_domain):
    first = start('ekf_node')
    try:
        wait_until_it_spins(first)
        status, error = finish(start('ekf_node'))
        assert status == 1
        assert len(error.strip().splitlines()) == 1
        assert '/ekf_node runs already' in error
        first.send_signal(signal.SIGINT)
        first.send_signal(signal.SIGINT)     # as a launch system does
        status, error = finish(first)
        assert status == 0
        line, = error.splitlines()
        assert '[ekf_node]' in line and line.endswith('Waits for imu/data_raw, mocap/pose.')
    finally:
        first.kill()
        first.communicate()


def test_a_node_ends_with_the_process_that_started_its_graph(ros_domain):
    script = ('import os, subprocess, sys, time\n'
              'os.environ["BEETLE_OMNI_PARENT"] = str(os.getpid())\n'
              'command = [sys.executable, "-m", "beetle_omni_ros.start", "ekf_node"]\n'
              'print(subprocess.Popen(command).pid, flush=True)\n'
              'time.sleep(60)\n')
    parent = subprocess.Popen([sys.executable, '-c', script], stdout=subprocess.PIPE, text=True)
    state = Path(f'/proc/{int(parent.stdout.readline())}/stat')
    wait_until_it_spins(parent)
    parent.kill()
    parent.communicate()
    deadline = time.monotonic() + 10
    while state.exists() and ') Z' not in state.read_text():
        assert time.monotonic() < deadline, 'the node outlived its starter'
        time.sleep(0.05)
