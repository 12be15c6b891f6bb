"""Set-up of all tests: checked ROS message fields, helper modules, tests in real time."""

import gc
import os
from pathlib import Path
import re
import signal
import sys
import time

import pytest

# Jazzy writes a scalar field of a wrong type as garbage unless this is set before the import.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
# A shell starts background jobs with interrupts ignored. Programs started by tests would inherit
# this and could not be interrupted.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
WORKER = 'PYTEST_XDIST_WORKER' in os.environ
if WORKER:     # each has one core
    os.environ.setdefault('OMP_NUM_THREADS', '1')

# Appended, so that no helper can shadow an installed module.
for folder in sorted(Path(__file__).parent.iterdir()):
    if folder.is_dir() and folder.name != '__pycache__':
        sys.path.append(str(folder))
sys.path.append(str(Path(__file__).parent))
import stillness  # noqa: E402

# Tests that depend on the system clock have the mark real_time: nodes, buses and devices, some
# with limits of milliseconds. A short stall of a shared computer fails them without a defect of
# the code. They are repeated alone, which the summary shows (R); a defect fails twice. If the
# computer stalls in the repetition too, the test is skipped with the length of the stall.
RERUNS = 1
STALL = 0.05        # s; the limits of silence in these tests are 50 to 80 ms
MARKS = {'alone': re.compile(r'\bmark\.alone\b'),      # part of the suite -> in a file of it
         'real_time': re.compile(r'\bmark\.(real_time|alone)\b')}
# Files of tests that wait for other processes, with timeouts; all others only compute.
PROCESSES = re.compile(r'/(ros|tutorials|show)/test_\w+\.py$|/test_start\.py$')
LANES = 'processes', 'computing'
# Rooms with the longest tests, which begin first: at the end they would leave other workers idle.
LONGEST = 'tutorials', 'gap_data', 'gap', 'flights', 'identify', 'flight'
BEAT, BEGIN = pytest.StashKey(), pytest.StashKey[float]()


def pytest_ignore_collect(collection_path, config):
    """Do not load files without a test of the requested part, which saves seconds."""
    part = config.getoption('markexpr').partition(' ')[0]
    if collection_path.match('test_*.py') and (
            part in MARKS and not _has_mark(collection_path, part)
            or part in LANES and part != _lane(collection_path)):
        return True
    return None


def _lane(path):
    return LANES[PROCESSES.search(Path(path).as_posix()) is None]


def _has_mark(path, part):
    return MARKS[part].search(Path(path).read_text(encoding='utf-8')) is not None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Permit a repetition of tests in real time, and watch for stalls."""
    real_time = [item for item in items if item.get_closest_marker('alone')
                 or item.get_closest_marker('real_time')]
    for item in real_time:
        item.add_marker(pytest.mark.real_time)
    for item in set(items).difference(real_time):
        item.add_marker(_lane(item.path))
    if config.getoption('markexpr').startswith('real_time'):
        # First devices, which mostly wait; then processes of nodes, which compute.
        items.sort(key=lambda item: item.path.parent.name == 'ros')
    else:
        items.sort(key=lambda item: item.path.parent.name not in LONGEST)
    # A repetition beside other tests is of little use in real time; .ci/test repeats alone.
    for item in () if WORKER else real_time:
        item.add_marker(pytest.mark.flaky(reruns=RERUNS))
    if real_time and not WORKER and not config.getoption('markexpr').endswith('not real_time') \
            and not config.getoption('numprocesses', None):
        config.stash[BEAT] = stillness.watch()


def pytest_xdist_make_scheduler(config, log):
    """Distribute files, whose tests share fixtures that are slow to make; tutorials one by one."""
    if config.getvalue('dist') != 'loadfile':
        return None
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return nodeid if '/tutorials/' in nodeid else super()._split_scope(nodeid)

    return ByFile(config, log)


def pytest_collection_finish():
    """Leave the loaded modules out of garbage collections: a flight takes 13 % less CPU time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture(scope='session', autouse=True)
def shared_folder(tmp_path_factory):
    """Folder of the flights that several files use, the same for all workers."""
    import flown_once
    root = tmp_path_factory.getbasetemp()
    flown_once.folder = (root.parent if WORKER else root) / 'flown_once'
    flown_once.folder.mkdir(exist_ok=True)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Skip a real-time test that failed during a stall, with the reason."""
    if call.when == 'setup':
        item.stash[BEGIN] = call.start
    report = yield
    last = getattr(item, 'execution_count', RERUNS + 1) > RERUNS
    if report.failed and last and BEAT in item.config.stash \
            and item.get_closest_marker('real_time'):
        offset = time.monotonic() - time.time()
        stalls = stillness.stalls(
            item.config.stash[BEAT], item.stash[BEGIN] + offset, call.stop + offset)
        if (longest := max(stalls, default=0.0)) >= STALL:
            report.outcome = 'skipped'
            report.longrepr = (str(item.path), item.location[1] + 1,
                               f'Skipped: the computer stood still for {1e3 * longest:.0f} ms, '
                               f'{len(stalls)} stalls; {call.excinfo.exconly()[:200]}')
    return report
