"""A small run of benchmarks/fuzz_inputs.py: damaged input files are refused in one line."""

import importlib.util
from pathlib import Path
import sys

import pytest

COUNTS = {'yaml': 80, 'faults': 40, 'csv': 60, 'mcap': 25, 'messages': 6, 'metadata': 15,
          'onnx': 15}


def load_benchmark():
    path = Path(__file__).resolve().parents[1] / 'benchmarks' / 'fuzz_inputs.py'
    spec = importlib.util.spec_from_file_location('fuzz_inputs', path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def benchmark():
    return load_benchmark()


@pytest.mark.parametrize('kind', COUNTS)
def test_a_damaged_file_is_refused_in_one_line(benchmark, tmp_path, kind):
    refused, findings = benchmark.fuzz(benchmark.KINDS[kind], COUNTS[kind], 1, tmp_path)
    assert not findings, '\n'.join(findings)
    assert refused or kind in ('mcap', 'messages', 'metadata')   # read up to the damage


def test_an_input_without_refusal_is_a_finding(benchmark, tmp_path):
    def read(path, _name):
        return int(path.read_text())

    kind = benchmark.Kind('.txt', lambda _: {'a': b'12'}, lambda rng, data: b'x', read)
    refused, findings = benchmark.fuzz(kind, 2, 0, tmp_path)
    assert refused == 0 and len(findings) == 2 and 'ValueError' in findings[0]
