"""Treatment of real-time tests by the suite: skipped only after a stall of the computer."""

import os
from pathlib import Path
import shutil
import subprocess
import sys
import time

import pytest
from stillness import Heartbeat

HERE = Path(__file__).parent
INNER = """
import os, signal, time
from pathlib import Path

def beats():
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            parent = int((entry / 'stat').read_text().rsplit(')', 1)[1].split()[1])
            if parent == os.getpid() and 'heartbeat_' in (entry / 'cmdline').read_text():
                yield int(entry.name)
        except OSError:
            pass

def stand_still(seconds):
    found = list(beats())
    assert found
    for pid in found:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    for pid in found:
        os.kill(pid, signal.SIGCONT)
    time.sleep(0.02)

def test_good():
    stand_still(0.3)

def test_held_up():
    stand_still(0.3)
    assert False, 'late'

def test_broken():
    assert False, 'broken'
"""


@pytest.fixture
def outcomes(tmp_path):
    """Outcome of each inner test, in a file of tests in real time and in another one."""
    for name in ('conftest.py', 'flown_once.py', 'stillness.py'):
        shutil.copy(HERE / name, tmp_path)
    for folder in ('nodes', 'robot'):
        (tmp_path / folder).mkdir()
        mark = 'import pytest; pytestmark = pytest.mark.real_time' if folder == 'nodes' else ''
        (tmp_path / folder / f'test_{folder}.py').write_text(f'{mark}\n{INNER}')
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-rA', '-p', 'no:cacheprovider', '-c', '/dev/null',
         '--rootdir', str(tmp_path), '--import-mode=importlib', str(tmp_path)],
        capture_output=True, text=True, timeout=120, check=False,
        env={name: value for name, value in os.environ.items()     # no worker of an outer run
             if not name.startswith('PYTEST_XDIST')})
    return done.stdout


def test_only_failures_during_a_stall_of_the_computer_are_skipped(outcomes):
    lines = [line for line in outcomes.splitlines()
             if line.startswith(('PASSED', 'FAILED', 'SKIPPED'))]
    kinds = sorted((line.split()[0], line) for line in lines)
    assert sum(kind == 'PASSED' for kind, _ in kinds) == 2, outcomes
    skipped = [line for kind, line in kinds if kind == 'SKIPPED']
    assert all('nodes' in line and 'stood still' in line for line in skipped), outcomes
    assert any('late' in line for line in skipped), outcomes
    failed = ' '.join(line for kind, line in kinds if kind == 'FAILED')
    assert 'robot.py::test_held_up' in failed and 'robot.py::test_broken' in failed
    assert 'nodes.py::test_held_up' not in failed
    # Only a true stall at that time skips the test.
    assert ('nodes.py::test_broken' in failed) != (len(skipped) == 2)


def test_a_stall_is_detected_with_its_duration():
    heart = Heartbeat()
    try:
        time.sleep(0.5)
        begin = time.monotonic()
        for process in heart._processes:
            process.send_signal(19)     # SIGSTOP
        time.sleep(0.4)
        for process in heart._processes:
            process.send_signal(18)     # SIGCONT
        time.sleep(0.1)
        assert 0.3 < max(heart.stalls(begin, time.monotonic())) < 2
        assert not [s for s in heart.stalls(begin - 0.3, begin - 0.05) if s > 0.3]
    finally:
        heart.close()
    assert all(process.poll() is not None for process in heart._processes)
