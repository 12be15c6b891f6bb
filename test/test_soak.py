"""The growth criteria of benchmarks/soak.py."""

import importlib.util
import os
from pathlib import Path
import sys

import numpy as np
import pytest

pytest.importorskip('rclpy')


@pytest.fixture(scope='module')
def soak():
    path = Path(__file__).parents[1] / 'benchmarks' / 'soak.py'
    spec = importlib.util.spec_from_file_location('soak', path)
    module = importlib.util.module_from_spec(spec)
    sys.modules['soak'] = module
    spec.loader.exec_module(module)
    return module


def samples(soak, slope, threads=(9, 9), files=(30, 30)):
    random = np.random.default_rng(0)
    return [soak.Sample(t, 150 + (20 if t < 60 else 0) + slope * t / 3600 + random.normal(0, 0.05),
                        threads[int(t >= 300)], files[int(t >= 300)])
            for t in np.arange(0.0, 3600.0, 10.0)]


@pytest.mark.parametrize('changed, grows', [
    ({'slope': 0.0}, False), ({'slope': 4.5}, False), ({'slope': 5.5}, True),
    ({'slope': 0.0, 'threads': (9, 10)}, True), ({'slope': 0.0, 'files': (30, 31)}, True),
    ({'slope': -3.0, 'files': (30, 29)}, False)])
def test_memory_threads_and_files_that_grow_are_found(soak, changed, grows):
    found = soak.growth('composed', samples(soak, **changed), 60.0)
    assert found.grows is grows
    assert found.memory_MB_per_hour == pytest.approx(changed['slope'], abs=0.1)


def test_too_few_samples_give_no_finding(soak):
    assert soak.growth('composed', samples(soak, 0.0), 3580.0) is None


def test_a_process_is_sampled_until_it_ends(soak):
    own = soak.read_sample(os.getpid(), 1.0)
    assert own.memory > 10 and own.threads >= 1 and own.files >= 3
    assert soak.read_sample(999_999_999, 1.0) is None
