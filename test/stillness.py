"""
Detection of stalls of a shared computer, which may last tenths of a second.

Tests with limits of milliseconds are not valid then. As a program it sleeps on one core, and
prints begin and end of late wake-ups until its parent process ends.
"""

import os
import re
import sys
import time

PERIOD = 0.005      # s of each sleep
NOTED = 0.02        # s; later wake-ups are recorded
MOST = 16           # watched cores


def watch():
    """Record the wake-ups on each core; return the file and the processes."""
    from subprocess import Popen
    from tempfile import NamedTemporaryFile
    file = NamedTemporaryFile(prefix='stalls_')
    return file, [Popen([sys.executable, '-S', __file__, str(core)], stdout=file)
                  for core in sorted(os.sched_getaffinity(0))[:MOST]]


def stalls(watched, start, end):
    """Durations [s] of the stalls between two times of the monotonic clock."""
    time.sleep(2 * PERIOD)      # a stall that ends now is recorded soon
    with open(watched[0].name) as file:     # lines that were written at once are mixed
        times = re.findall(r'^(\d+\.\d+) (\d+\.\d+)$', file.read(), re.MULTILINE)
    return [float(ended) - float(began) - PERIOD for began, ended in times
            if float(began) < end and float(ended) > start]


if __name__ == '__main__':
    os.sched_setaffinity(0, [int(sys.argv[1])])
    parent = os.getppid()
    while os.getppid() == parent:
        begin = time.monotonic()
        time.sleep(PERIOD)
        end = time.monotonic()
        if end - begin > PERIOD + NOTED:
            print(repr(begin), repr(end), flush=True)
