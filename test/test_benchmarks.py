"""Short runs of the programs in benchmarks/ that search for defects, and their criteria."""

import importlib.util
from pathlib import Path
import re
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
DAMAGED = {'yaml': 80, 'faults': 40, 'csv': 60, 'mcap': 25, 'messages': 6, 'metadata': 15,
           'onnx': 15}


def load(name):
    """Import a program of benchmarks/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / 'benchmarks' / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize('kind', DAMAGED)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, kind):
    fuzz_inputs = load('fuzz_inputs')
    refused, findings = fuzz_inputs.fuzz(fuzz_inputs.KINDS[kind], DAMAGED[kind], 1, tmp_path)
    assert not findings, '\n'.join(findings)
    assert refused or kind in ('mcap', 'messages', 'metadata')   # read up to the damage


@pytest.mark.parametrize('kind', ['board', 'servos', 'messages'])
def test_malicious_packets_and_messages_are_accepted_or_refused(kind):
    for module in ('rclpy', 'pymavlink', 'dynamixel_sdk'):
        pytest.importorskip(module)
    fuzz_packets = load('fuzz_packets')
    findings = fuzz_packets.fuzz(fuzz_packets.KINDS[kind], 1500, 1)
    assert not findings, findings


@pytest.mark.parametrize('slope, threads, files, grows', [
    (4.5, (9, 9), (30, 30), False), (5.5, (9, 9), (30, 30), True), (0.0, (9, 10), (30, 30), True),
    (0.0, (9, 9), (30, 31), True), (-3.0, (9, 9), (30, 29), False)])
def test_memory_threads_and_files_that_grow_are_found(slope, threads, files, grows):
    pytest.importorskip('rclpy')
    soak, random = load('soak'), np.random.default_rng(0)
    samples = [soak.Sample(
        t, 150 + (20 if t < 60 else 0) + slope * t / 3600 + random.normal(0, 0.05),
        threads[int(t >= 300)], files[int(t >= 300)]) for t in np.arange(0.0, 3600.0, 10.0)]
    found = soak.growth('composed', samples, 60.0)
    assert found.grows is grows
    assert found.memory_MB_per_hour == pytest.approx(slope, abs=0.1)


def test_the_flight_path_on_aarch64_has_its_wheels_and_tests():
    aarch64 = load('aarch64')
    names = {re.split(r'[\[<>=;!~ ]', one)[0] for group in aarch64.requirements().values()
             for one in group}
    assert {'casadi', 'mujoco', 'onnxruntime', 'rosbags', 'pymavlink', 'pyserial'} <= names
    assert not names & {'torch', 'pytest', 'ros-jazzy-rclpy'}
    assert all((ROOT / test).is_file() for test in aarch64.TESTS)
