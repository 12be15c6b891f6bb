"""Calls on several cores have the results of one core, even if a worker dies."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from beetle_omni_ros.identify.gap import workers
from beetle_omni_ros.identify.gap.workers import Workers

pytestmark = pytest.mark.skipif(sys.platform != 'linux', reason='forks on Linux only')
PARENT = os.getpid()
SCRIPT = """
import os, sys, time
from pathlib import Path
from beetle_omni_ros.identify.gap import workers
from beetle_omni_ros.identify.gap.workers import Workers

def work(folder, k):
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(600)

workers.width = lambda: 3
with Workers(sys.argv[1]) as shared:
    shared.map(work, range(3))
"""


def children():
    return {process for tasks in Path('/proc/self/task').glob('*/children')
            for process in tasks.read_text().split()}


@pytest.fixture(params=[1, 3])
def cores(request, monkeypatch):
    monkeypatch.setattr(workers, 'width', lambda: request.param)
    return request.param


def columns(big, k, add=0.0):
    return k, big[:, :k] + add


def process(subject, k):
    time.sleep(0.05)        # so that no worker ends before the others have begun
    return os.getpid()


def bad(subject, k, which):
    if k == which:
        raise ValueError(f'item {k}')
    return k


def dies(subject, k):
    if os.getpid() != PARENT:
        os.kill(os.getpid(), signal.SIGKILL)
    return k * k


def test_results_come_in_the_order_of_the_items(cores):
    big = np.random.default_rng(0).normal(size=(200, 5000))      # more than a pipe holds
    with Workers(big) as shared:
        for add in (0.0, 1.5):
            made = shared.map(columns, range(7), add)
            assert [k for k, _ in made] == list(range(7))
            assert all(np.array_equal(array, big[:, :k] + add) for k, array in made)
        assert shared.map(columns, []) == []


def test_workers_do_the_work_and_end(cores):
    before = children()
    with Workers() as shared:
        by = set(shared.map(process, range(6)))
        assert len(by) == cores and (os.getpid() in by) == (cores == 1)
    assert children() == before
    assert shared.map(process, range(2)) == [PARENT] * 2        # afterwards as on one core


@pytest.mark.parametrize('which', [0, 2])
def test_an_error_of_any_item_is_raised_and_no_worker_is_left(cores, which):
    before = children()
    with pytest.raises(ValueError, match=f'item {which}'), Workers() as shared:
        shared.map(bad, range(6), which)
    assert children() == before


def test_work_of_a_dead_worker_is_done_by_the_parent(cores):
    before = children()
    with Workers() as shared:
        assert shared.map(dies, range(5)) == [0, 1, 4, 9, 16]
        assert shared.map(process, range(2)) == [PARENT] * 2 or cores == 1
    assert children() == before


@pytest.mark.parametrize('end', [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_at_once_with_the_first_process(tmp_path, end):
    busy = subprocess.Popen([sys.executable, '-c', SCRIPT, str(tmp_path)],
                            stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 60
        while len(list(tmp_path.iterdir())) < 3 and time.monotonic() < deadline:
            time.sleep(0.05)
        started = [Path('/proc') / file.name for file in tmp_path.iterdir()]
        assert len(started) == 3
        busy.send_signal(end)
        assert busy.wait(20) != 0
        while any(process.exists() for process in started) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not any(process.exists() for process in started)
        assert ('KeyboardInterrupt' in busy.stderr.read()) == (end == signal.SIGINT)
    finally:
        busy.kill()
        busy.wait()
