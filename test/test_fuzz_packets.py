"""A small run of benchmarks/fuzz_packets.py: readers accept or refuse every message."""

import importlib.util
from pathlib import Path
import sys

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('pymavlink')
pytest.importorskip('dynamixel_sdk')


@pytest.fixture(scope='module')
def benchmark():
    path = Path(__file__).resolve().parents[1] / 'benchmarks' / 'fuzz_packets.py'
    spec = importlib.util.spec_from_file_location('fuzz_packets', path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize('kind', ['board', 'servos', 'messages'])
def test_malicious_packets_and_messages_are_accepted_or_refused(benchmark, kind):
    findings = benchmark.fuzz(benchmark.KINDS[kind], 1500, 1)
    assert not findings, findings


def test_an_exception_is_a_finding(benchmark):
    def reader(rng):
        raise KeyError('lost')

    findings = benchmark.fuzz(lambda: reader, 3, 0)
    assert findings.total() == 3 and next(iter(findings)).startswith('KeyError in ')
