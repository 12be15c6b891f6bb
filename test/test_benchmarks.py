"""Short runs of the programs in benchmarks/ that search for defects, and their criteria."""

import importlib.util
from pathlib import Path
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]


def load(name):
    """Import a program of benchmarks/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / 'benchmarks' / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


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
