"""What every test shares: checked ROS message fields, helper modules, tests in real time."""

import os
from pathlib import Path
import re
import signal
import sys
import time

import pytest

# Jazzy writes a scalar field of a wrong type as garbage unless this is set before the import.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
# A shell starts its background jobs with interrupts ignored, and programs that tests start inherit
# that: none could then be interrupted.
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

# What runs by the system clock is marked real_time: nodes, buses, devices, some with limits of
# milliseconds. Flights in simulated time wait for who is late and are marked so. A computer that
# stops for a moment, as shared ones do, fails the former for no fault of the code. They get a
# second chance with nothing beside them, which the summary names (R); what is broken fails twice.
# Where the computer was seen to stand still in the second chance too, the test is skipped with
# the length of the stall: it could not be judged. On a computer that keeps time, nothing is.
RERUNS = 1
STALL = 0.05        # s; the limits of silence in these tests are 50 to 80 ms
MARKS = {'alone': re.compile(r'\bmark\.alone\b'),      # part of the suite -> in a file of it
         'real_time': re.compile(r'\bmark\.(real_time|alone)\b|\bros_domain\b')}
BEAT, BEGIN = pytest.StashKey(), pytest.StashKey[float]()


def pytest_ignore_collect(collection_path, config):
    """Do not load files without a test of the part that is asked for: that takes seconds."""
    part = config.getoption('markexpr').partition(' ')[0]
    if part in MARKS and collection_path.match('test_*.py') \
            and not _says_so(collection_path, part):
        return True
    return None


def _says_so(path, part):
    return MARKS[part].search(Path(path).read_text(encoding='utf-8')) is not None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark who has a ROS domain, give a second chance, watch the computer meanwhile."""
    waiting = [item for item in items if item.get_closest_marker('simulated_time')]
    real_time = [item for item in items if item.get_closest_marker('alone')
                 or item.get_closest_marker('real_time')
                 or ('ros_domain' in item.fixturenames and item not in waiting)]
    for path, part in {(item.path, 'alone' if item.get_closest_marker('alone') else 'real_time')
                       for item in real_time}:
        if not _says_so(path, part):      # it would be in neither part
            raise pytest.UsageError(f'{path}: has tests in real time: name the mark in the file')
    for item in real_time:
        item.add_marker(pytest.mark.real_time)
    if config.getoption('markexpr').startswith('real_time'):
        # Devices, which wait, with each other; then processes of nodes, which compute.
        items.sort(key=lambda item: item.path.parent.name == 'nodes')
    else:       # The longest file first: a worker that takes it last leaves the others idle.
        items.sort(key=lambda item: item.path.parent.name != 'tutorials')
    # In real time a second chance is worth little beside others; .ci/test gives it alone.
    for item in [*waiting, *(() if WORKER else real_time)]:
        item.add_marker(pytest.mark.flaky(reruns=RERUNS))
    if real_time and not WORKER and config.getoption('markexpr') != 'not real_time' \
            and not config.getoption('numprocesses', None):
        from stillness import Heartbeat
        config.stash[BEAT] = Heartbeat()


def pytest_unconfigure(config):
    """Stop watching."""
    if BEAT in config.stash:
        config.stash[BEAT].close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Devices answer from threads, by the clock: a test that uses them has to say so."""
    if item.get_closest_marker('real_time'):
        return (yield)
    from beetle_omni_ros.sim.emulated.pseudo_terminal import PseudoTerminal
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PseudoTerminal, 'plug', _refuse)
        return (yield)


def _refuse(_):
    raise RuntimeError('an emulated device runs by the clock: mark the test real_time')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Skip what failed in real time on a computer that stood still, with the reason."""
    if call.when == 'setup':
        item.stash[BEGIN] = call.start
    report = yield
    last = getattr(item, 'execution_count', RERUNS + 1) > RERUNS
    if report.failed and last and BEAT in item.config.stash \
            and item.get_closest_marker('real_time'):
        offset = time.monotonic() - time.time()
        stalls = item.config.stash[BEAT].stalls(item.stash[BEGIN] + offset, call.stop + offset)
        if (longest := max(stalls, default=0.0)) >= STALL:
            report.outcome = 'skipped'
            report.longrepr = (str(item.path), item.location[1] + 1,
                               f'Skipped: the computer stood still for {1e3 * longest:.0f} ms, '
                               f'{len(stalls)} stalls; {call.excinfo.exconly()[:200]}')
    return report
