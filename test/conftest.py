"""What every test shares: checked ROS message fields, helper modules, tests in real time."""

import os
from pathlib import Path
import sys
import time

import pytest

# Jazzy writes a scalar field of a wrong type as garbage unless this is set before the import.
os.environ.setdefault('ROS_PYTHON_CHECK_FIELDS', '1')
if 'PYTEST_XDIST_WORKER' in os.environ:     # each worker has one core
    os.environ.setdefault('OMP_NUM_THREADS', '1')

# Appended, so that no helper can shadow an installed module.
for folder in sorted(Path(__file__).parent.iterdir()):
    if folder.is_dir() and folder.name != '__pycache__':
        sys.path.append(str(folder))
sys.path.append(str(Path(__file__).parent))

# Flights, buses and devices in real time, some with limits of milliseconds: a computer that stops
# for a moment, as shared ones do, fails them for no fault of the code. They get a second chance,
# which the summary names (R); what is broken fails twice. Where the computer was seen to stand
# still in the second chance too, the test is skipped with the length of the stall: it could not
# be judged. On a computer that keeps time, nothing is skipped.
REAL_TIME = ('nodes', 'drivers', 'bringup', 'sim')
RERUNS = 1
STALL = 0.05        # s; the limits of silence in these tests are 50 to 80 ms
BEAT, BEGIN = pytest.StashKey(), pytest.StashKey[float]()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark what runs in real time, give it a second chance, watch the computer meanwhile."""
    real_time = [item for item in items if Path(item.path).parent.name in REAL_TIME]
    for item in real_time:
        item.add_marker(pytest.mark.real_time)
        item.add_marker(pytest.mark.flaky(reruns=RERUNS))
    if real_time and config.getoption('markexpr') != 'not real_time':
        from stillness import Heartbeat
        config.stash[BEAT] = Heartbeat()


def pytest_unconfigure(config):
    """Stop watching."""
    if BEAT in config.stash:
        config.stash[BEAT].close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Skip what failed in real time on a computer that stood still, with the reason."""
    if call.when == 'setup':
        item.stash[BEGIN] = call.start
    report = yield
    last = getattr(item, 'execution_count', RERUNS + 1) > RERUNS
    if report.failed and last and item.get_closest_marker('real_time'):
        offset = time.monotonic() - time.time()
        stalls = item.config.stash[BEAT].stalls(item.stash[BEGIN] + offset, call.stop + offset)
        if (longest := max(stalls, default=0.0)) >= STALL:
            report.outcome = 'skipped'
            report.longrepr = (str(item.path), item.location[1] + 1,
                               f'Skipped: the computer stood still for {1e3 * longest:.0f} ms, '
                               f'{len(stalls)} stalls; {call.excinfo.exconly()[:200]}')
    return report
